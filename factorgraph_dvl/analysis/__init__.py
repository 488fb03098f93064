"""Analyses of trials and solutions."""
