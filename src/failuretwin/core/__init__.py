"""Values that every part of failuretwin shares."""
