"""What runs say of each fault: its prior, its sizes, its change point."""
