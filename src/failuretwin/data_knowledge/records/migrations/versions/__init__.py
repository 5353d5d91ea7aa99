"""Revisions of the schema, one module each; a released revision never changes."""
