"""The failure behaviour model: fault modes, their injection, random movements."""
