"""What a large scale error of a velocity log comes from: another beam angle, reversed signs."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.message import Message, message

# Angles of beams from the vertical, deg, that are taken for each other.
_ANGLES = (20.0, 25.0, 30.0)
# Share by which a ratio of speeds may be off. Chosen: what a good log is off by, and half of what
# two such ratios differ by.
_NEAR = 0.02
# A scale error so near to -2 is a sign. Chosen: a log has 5 %.
_NEAR_REVERSED = 0.1


def beam_angles(ratio: float) -> tuple[float, float] | None:
    """Return the angles of beams, deg, that make a ratio of measured to true speeds.

    Doppler shifts along beams at θ from the vertical are v sin θ; who divides them by sin θ' has
    speeds of sin θ / sin θ' times the true one.

    Returns
    -------
    tuple of float or None
        True and assumed angle from the vertical, the nearest pair; None if no pair is near.
    """
    pairs = [pair for pair in permutations(_ANGLES, 2) if 30.0 in pair]
    off = [abs(ratio * np.sin(b * DEG) / np.sin(a * DEG) - 1.0) for a, b in pairs]
    best = int(np.argmin(off))
    return pairs[best] if off[best] < _NEAR else None


def scale_cause(scale_error: float) -> Message | None:
    """Return what a scale error, as a number, is a sign of; None if nothing is known."""
    if abs(scale_error + 2.0) < _NEAR_REVERSED:
        return message("impossible_scale.reversed")
    angles = beam_angles(1.0 + scale_error)
    if angles is None:
        return None
    return message("impossible_scale.beam_angle", right=angles[0], assumed=angles[1])
