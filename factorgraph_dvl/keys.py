"""GTSAM's symbols, made here and nowhere else."""

from __future__ import annotations

from gtsam.symbol_shorthand import B, C, X


def node(k: int) -> int:
    """Return the key of the navigation state at node k."""
    return int(X(k))


def bias(k: int) -> int:
    """Return the key of IMU bias k."""
    return int(B(k))


def calibration(i: int) -> int:
    """Return the key of calibration parameter i."""
    return int(C(i))
