"""The Kalman point-set approach: SINS/GNSS first, then the DVL against it."""
