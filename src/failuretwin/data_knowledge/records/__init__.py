"""The store: what robots went through, what people found, and what was repaired."""
