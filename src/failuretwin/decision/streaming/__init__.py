"""Diagnosis of streams, of one robot or of thousands at once: an answer at every sample."""

STREAMED = ("tool", "tool+encoders", "tool+goals", "tool+encoders+goals")
"""Sensors that a stream can use."""
