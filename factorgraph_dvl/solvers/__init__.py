"""Minimisation, covariance and summary."""
