"""Fixtures of the command line's tests."""

from running import run

__all__ = ["run"]
