"""Many trials: each solved, one joint calibration of all, and what changed between them."""
