"""Wrong set-ups of a log, and what undoes each."""
