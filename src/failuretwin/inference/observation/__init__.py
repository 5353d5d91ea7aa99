"""What was observed: readings, settled positions, lost commands, and what a healthy arm does."""
