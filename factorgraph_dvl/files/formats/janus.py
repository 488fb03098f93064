"""Velocities of four-beam Janus instruments: beam, instrument, ship and Earth axes.

Source: Teledyne, ADCP Coordinate Transformation (P/N 951-6079-00), and the Pathfinder
DVL Guide (April 2018). Instrument axes of one that looks down, its beam 3 forward, are starboard,
forward, up; one that looks up is rolled by 180 degrees. Nothing here depends on whether
velocities are those of the bottom or of the vehicle, as long as beams are positive
towards the transducer in the first case and outward in the second.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, rotate

BEAM, INSTRUMENT, SHIP, EARTH = range(4)


def beam_directions(beam_angle: float) -> Array:
    """Return outward directions (4, 3) of beams in the axes of a downward instrument."""
    s, c = np.sin(beam_angle), np.cos(beam_angle)
    return np.array([[-s, 0.0, -c], [s, 0.0, -c], [0.0, s, -c], [0.0, -s, -c]])


def from_beams(beams: Array, beam_angle: ArrayLike, convex: ArrayLike = True) -> Array:
    """Return X, Y, Z and error velocity (N, 4) in instrument axes.

    Parameters
    ----------
    beams : ndarray, shape (N, 4)
        Velocities along beams. One that is nan is replaced by what makes the error velocity zero;
        the error velocity is then nan.
    beam_angle : array_like, shape (N,) or (), rad
        Beam angle from the vertical.
    convex : array_like of bool, shape (N,) or ()
        Whether beams point outwards.
    """
    lost = np.isnan(beams)
    one_lost = lost.sum(axis=1) == 1
    sign = np.array([1.0, 1.0, -1.0, -1.0])
    rest = np.where(lost, 0.0, beams) @ sign
    filled = np.where(lost & one_lost[:, None], -rest[:, None] * sign, beams)
    angle = np.broadcast_to(np.asarray(beam_angle, float), len(beams))
    across = np.where(np.asarray(convex, bool), 1.0, -1.0) / (2.0 * np.sin(angle))
    b1, b2, b3, b4 = filled.T
    error = (b1 + b2 - b3 - b4) / (2.0 * np.sqrt(2.0) * np.sin(angle))
    return np.stack(
        [
            across * (b1 - b2),
            across * (b4 - b3),
            (b1 + b2 + b3 + b4) / (4.0 * np.cos(angle)),
            np.where(one_lost, np.nan, error),
        ],
        axis=1,
    )


def instrument_to_outer(
    coordinates: ArrayLike,
    roll: Array,
    pitch: Array,
    heading: Array,
    alignment: ArrayLike,
    tilts_used: ArrayLike = True,
    up: ArrayLike = False,
) -> Array:
    """Return rotations (N, 3, 3) from instrument axes to those that a file is in.

    Parameters
    ----------
    coordinates : ndarray, shape (N,)
        `BEAM`, `INSTRUMENT`, `SHIP` or `EARTH`. The first two give unity.
    roll, pitch, heading : ndarray, shape (N,), rad
        Roll, pitch and heading of the instrument. Heading counts for `EARTH` only.
    alignment : ndarray, shape (N,), rad
        EA, beam 3 clockwise from the bow; counts for `SHIP` only, as the heading is beam 3's.
    tilts_used : ndarray of bool, shape (N,)
        Whether the instrument applied roll and pitch; an instrument that looks up is turned over
        all the same.
    up : ndarray of bool, shape (N,)
        Whether it looks up.
    """
    count = len(roll)
    system = np.broadcast_to(np.asarray(coordinates), count)
    used = np.broadcast_to(np.asarray(tilts_used, bool), count)
    inner: NDArray[np.bool_] = (system == BEAM) | (system == INSTRUMENT)
    turn = np.where(system == EARTH, heading, np.broadcast_to(np.asarray(alignment), count))
    over = np.where(np.broadcast_to(np.asarray(up, bool), count), np.pi, 0.0)
    rph = np.stack([np.where(used, roll, 0.0) + over, np.where(used, pitch, 0.0), turn], axis=1)
    rotation = rotation_from_rph(np.where(inner[:, None], 0.0, rph), "RFU")
    return np.asarray(np.where(inner[:, None, None], np.eye(3), rotation))


def to_instrument(velocity: Array, rotation: Array) -> Array:
    """Return velocities (N, 3) in instrument axes, of those that `rotation` turned out of them."""
    return rotate(np.swapaxes(rotation, 1, 2), velocity)
