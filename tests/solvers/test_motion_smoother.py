"""Trials without IMU: a ship with compass, GNSS and a log; an INS; what comes out and how sure."""
