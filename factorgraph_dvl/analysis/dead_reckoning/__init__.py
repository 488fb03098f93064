"""Effect of a calibration on dead reckoning."""
