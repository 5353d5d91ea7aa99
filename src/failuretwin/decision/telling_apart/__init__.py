"""What a motion can tell apart at all, before anything has happened."""
