"""What a calibration is worth in dead reckoning."""
