"""The store: what robots went through, what people found, and what was repaired."""

CHECK_DAYS = 30.0
"""Time without a run after which a robot is due for a check [days]."""
