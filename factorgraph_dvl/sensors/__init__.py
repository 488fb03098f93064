"""One module per sensor: its settings, its record, its parameters and its equation."""
