"""Runs of one robot judged together: folders, lives, streams."""
