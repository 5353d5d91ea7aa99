"""Diagnosis of streams, of one robot or of thousands at once: an answer at every sample."""
