"""A trial as a factor graph."""
