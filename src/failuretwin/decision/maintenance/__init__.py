"""Maintenance: what to do about an arm at least expected cost, and how long a motor will last."""
