"""Decision and control: diagnosis, metrics, words."""
