"""Phases of a motion: what heading and vertical speed do, averaged over seconds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import median_filter

from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray, rotate, spread
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.trial import Trial

# The heading stays, turns, begins or ends to turn; the vertical speed changes.
STAYS, TURNS, BEGINS, CLIMBS = range(4)
PHASES = 4
# Turn rate, averaged over seconds, from which on a vessel turns. Chosen: above yaw in a seaway.
_TURNING = 0.4 * DEG
TURN_SPAN = 10.0
# Change of the vertical speed, averaged likewise, from which on a vessel begins or ends to climb,
# m/s. Chosen: above heave in a seaway, of which `configs/ship.yaml` leaves 0.08.
_CLIMBING = 0.1
# Pings that a wrong one is judged by, and deviations from their median from which on it is one.
# Chosen: two in a row may be wrong.
_NEIGHBOURS, _WRONG = 5, 5.0
# Component of the acceleration that is vertical, of three angular ones and three others.
_VERTICAL = 5


def phases(
    record: AttitudeRecord, time: Array, trial: Trial, mounting: Array, late: float
) -> IntArray:
    """Return the phase of each component of the acceleration, (M, 6).

    Axes that turn with the average of the heading are behind it where it begins or ends to turn.
    A dive has few climbs, in which the vertical speed changes by much: with one density for all
    of it, the motion follows the noise of the DVL, which then seems half of what it is.

    Parameters
    ----------
    record : AttitudeRecord
        Attitudes.
    time : ndarray, shape (M,), s
        Stamps of the attitude.
    trial : Trial
        Whose DVL shows climbs; without one, none is known.
    mounting : ndarray, shape (3, 3)
        Body to the axes of the DVL.
    late : float, s
        Stamps of the attitude less those of the DVL.
    """
    # The average of the heading reaches two spans ahead and behind.
    shifts = TURN_SPAN * np.arange(-2, 3)
    heading = np.stack([record.rph_at(time + shift)[:, 2] for shift in shifts])
    rate = np.diff(heading, axis=0) / TURN_SPAN
    turns = np.abs(rate[1] + rate[2]) > 2.0 * _TURNING
    of_heading = np.where(_changes(rate, _TURNING), BEGINS, np.where(turns, TURNS, STAYS))
    out = np.tile(of_heading[:, None], (1, 6))
    log = trial.log
    if log is not None and log.locked.sum() > 1:
        pings = np.flatnonzero(log.locked)
        stamp = log.time[pings] + late
        v_b = log.velocity[pings] @ mounting
        up = rotate(rotation_from_rph(record.rph_at(stamp), record.body_axes), v_b)[:, 2]
        # A wrong ping is no climb.
        near = median_filter(up, _NEIGHBOURS)
        up = np.where(np.abs(up - near) > _WRONG * spread(up - near), near, up)
        climbed = cumulative_trapezoid(up, stamp, initial=0)
        height = np.stack([np.interp(time + shift, stamp, climbed) for shift in shifts])
        climbs = _changes(np.diff(height, axis=0) / TURN_SPAN, _CLIMBING)
        out[climbs, _VERTICAL] = CLIMBS
    return out


def each_phase(phase: IntArray) -> Iterator[tuple[int, int, BoolArray]]:
    """Yield the phases (K - 1, 6) that there are: which, of which component, and where."""
    for i in range(phase.shape[1]):
        for kind in np.unique(phase[:, i]).tolist():
            yield kind, i, np.asarray(phase[:, i] == kind)


def _changes(rate: Array, limit: float) -> BoolArray:
    """Whether rates (4, M) of spans that follow each other differ by more than a limit."""
    return np.any(np.abs(np.diff(rate, axis=0)) > limit, axis=0)
