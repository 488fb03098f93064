"""Observability: which parameters the data of a trial determine."""
