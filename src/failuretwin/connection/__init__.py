"""Connection and updating: links to robots, live shadow, calibration."""
