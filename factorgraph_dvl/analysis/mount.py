"""How a DVL is mounted, in words that are right for turns of any size."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import fixed

_NAMES = ("x", "y", "z")
# By bearing: where an axis points, and what lies clockwise and counterclockwise of it.
_SIDES = (
    ("the bow", "to starboard", "to port"),
    ("starboard", "towards the stern", "towards the bow"),
    ("the stern", "to port", "to starboard"),
    ("port", "towards the bow", "towards the stern"),
)
# Angles that are written as 0, deg.
_ALIGNED = 0.005
# Tilt of a DVL, deg, from which on it does not look down. Chosen: halfway to the horizontal.
_SIDEWAYS = 45.0


def looks_down(attitude: Array) -> bool:
    """Return whether a DVL looks down along its z axis.

    Parameters
    ----------
    attitude : ndarray, shape (3, 3)
        C_d^b in forward, starboard, down.
    """
    return bool(attitude[2, 2] > np.cos(_SIDEWAYS * DEG))


def mount_in_words(axes: Array) -> list[str]:
    """Return a sentence for the direction in which a DVL looks, and one for each other axis.

    A DVL that measures the bottom looks down along its z axis or against it: makers differ.

    Parameters
    ----------
    axes : array_like, shape (3, 3)
        Axes x, y, z of the DVL, a row each, in forward, starboard, down of the vehicle.
    """
    axes = np.asarray(axes, float)
    down = axes[2, 2]
    if abs(down) < np.cos(_SIDEWAYS * DEG):
        looks = f"The DVL is mounted sideways: its z axis points {direction(axes[2])}."
        return [looks, *(f"Its {_NAMES[k]} axis points {direction(axes[k])}." for k in (0, 1))]
    way = "down" if down > 0.0 else "up"
    tilt = np.degrees(np.arccos(min(abs(down), 1.0)))
    off = "" if tilt < _ALIGNED else f", {fixed(float(tilt), 2)} deg off the vertical"
    looks = f"The DVL looks down{off}; its z axis points {way}."
    return [looks, *(f"Its {_NAMES[k]} axis points {direction(axes[k])}." for k in (0, 1))]


def direction(axis: Array) -> str:
    """Return where an axis points, (3,) in forward, starboard, down, as a phrase."""
    forward, starboard, down = (float(value) for value in axis)
    if abs(down) > np.cos(1.0 * DEG):
        return "down" if down > 0.0 else "up"
    bearing = np.degrees(np.arctan2(starboard, forward)) % 360.0
    side = round(bearing / 90.0)
    off = bearing - 90.0 * side
    name, clockwise, counterclockwise = _SIDES[side % 4]
    elevation = -float(np.degrees(np.arcsin(np.clip(down, -1.0, 1.0))))
    if abs(off) < _ALIGNED:
        text = f"to {name}"
    else:
        turned = clockwise if off > 0.0 else counterclockwise
        text = f"{fixed(abs(off), 2)} deg {turned} {'from' if side % 2 else 'of'} {name}"
    if abs(elevation) >= _ALIGNED:
        which = "above" if elevation > 0.0 else "below"
        text += f", {fixed(abs(elevation), 2)} deg {which} the horizontal"
    return text
