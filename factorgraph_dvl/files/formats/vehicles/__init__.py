"""Logs of vehicles, and of one instrument, that libraries of their makers and users read."""
