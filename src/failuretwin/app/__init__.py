"""The command line and its pictures."""
