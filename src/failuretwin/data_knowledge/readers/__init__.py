"""Readers of logs: what each file type claims to be, its columns, and the run set made of it."""
