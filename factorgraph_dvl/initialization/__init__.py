"""Start values from the data alone."""
