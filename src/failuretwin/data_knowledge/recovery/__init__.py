"""Motor commands recovered from desired tool paths."""
