"""How a DVL is mounted, in words that are right for turns of any size."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.notation import fixed

_NAMES = ("x", "y", "z")
# By bearing: where an axis points, and what lies clockwise and counterclockwise of it.
_SIDES = (
    ("mount.bow", "mount.to_starboard", "mount.to_port"),
    ("mount.starboard", "mount.to_stern", "mount.to_bow"),
    ("mount.stern", "mount.to_port", "mount.to_starboard"),
    ("mount.port", "mount.to_bow", "mount.to_stern"),
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


def mount_in_words(axes: Array) -> list[Message]:
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
        looks = message("mount.sideways", where=direction(axes[2]))
    else:
        tilt = float(np.degrees(np.arccos(min(abs(down), 1.0))))
        off = "" if tilt < _ALIGNED else message("mount.off", tilt=fixed(tilt, 2))
        looks = message("mount.looks_down", off=off, way=_vertical(down))
    rest = (message("mount.axis", axis=_NAMES[k], where=direction(axes[k])) for k in (0, 1))
    return [looks, *rest]


def direction(axis: Array) -> Message:
    """Return where an axis points, (3,) in forward, starboard, down, as a phrase."""
    forward, starboard, down = (float(value) for value in axis)
    if abs(down) > np.cos(1.0 * DEG):
        return _vertical(down)
    bearing = np.degrees(np.arctan2(starboard, forward)) % 360.0
    side = round(bearing / 90.0)
    off = bearing - 90.0 * side
    name, clockwise, counterclockwise = _SIDES[side % 4]
    elevation = -float(np.degrees(np.arcsin(np.clip(down, -1.0, 1.0))))
    height: Message | str = ""
    if abs(elevation) >= _ALIGNED:
        which = "mount.above" if elevation > 0.0 else "mount.below"
        height = message(which, angle=fixed(abs(elevation), 2))
    if abs(off) < _ALIGNED:
        return message("mount.straight", side=message(name), height=height)
    return message(
        "mount.from" if side % 2 else "mount.of",
        angle=fixed(abs(off), 2),
        turned=message(clockwise if off > 0.0 else counterclockwise),
        side=message(name),
        height=height,
    )


def _vertical(down: float) -> Message:
    return message("mount.down" if down > 0.0 else "mount.up")
