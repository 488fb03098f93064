"""GTSAM's symbols, made here and nowhere else."""

from __future__ import annotations

from gtsam import symbol
from gtsam.symbol_shorthand import B, X


def node(k: int) -> int:
    """Return the key of the navigation state at node k."""
    return int(X(k))


def bias(k: int) -> int:
    """Return the key of IMU bias k."""
    return int(B(k))


def calibration(i: int) -> int:
    """Return the key of calibration parameter i, which has a letter of its own.

    iSAM2's thresholds go by letters, and must have the dimension of the variable.
    """
    return int(symbol(chr(ord("A") + i), 0))
