"""The console: a local web page on the store, the fleet and live robots."""
