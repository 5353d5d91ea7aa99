"""What the movements of a robot share and nobody has measured: its posterior by hypothesis."""
