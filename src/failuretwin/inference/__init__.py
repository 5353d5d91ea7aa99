"""Inference: from readings to the posterior over hypotheses, and to what can be told apart."""
