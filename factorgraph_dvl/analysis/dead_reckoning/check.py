"""What a calibration does to the residuals of a DVL and to dead reckoning, on data of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from factorgraph_dvl.analysis.dead_reckoning.before_after import (
    BeforeAfter,
    before_after,
    with_calibration,
)
from factorgraph_dvl.analysis.dead_reckoning.integration import (
    OrientationAt,
    body_velocity,
    mounting_of,
)
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.rotations import frd_from_body, rotation_from_rph, theta_by_rph
from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.attitude_history import AttitudeHistory, Orientation
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

Data = Literal["second half", "same data"]
# Chosen: attitude is not known where a trajectory has no epoch for so long, s.
_LONGEST = 2.5


@dataclass(frozen=True)
class Check:
    """Residuals of a DVL, and dead reckoning, before and after a calibration.

    Parameters
    ----------
    data : {'second half', 'same data'}
        Data that were used: those of the second half with the calibration of the first, or those
        that the calibration is from.
    time : ndarray, shape (M,), s
        Times of the pings.
    before, after : ndarray, shape (M, 3), m/s
        Predicted minus measured velocity, forward, starboard, down.
    tracks : BeforeAfter
        Dead reckoning of the same data.
    """

    data: Data
    time: Array
    before: Array
    after: Array
    tracks: BeforeAfter


def check_calibration(
    trial: Trial, solution: Solution, values: Mapping[str, Array], data: Data
) -> Check:
    """Compare the DVL with the trajectory of a solution, before and after a calibration.

    The attitude is that of the solution for both, so that the difference is the calibration's.
    Before it, the mounting is that of trial.yaml.

    Parameters
    ----------
    trial : Trial
        Data to check with; a part of what was solved, or all of it.
    solution : Solution
        Solution of all data: motion of the vehicle.
    values : mapping of str to ndarray
        Calibration by name, in reported units.
    data : {'second half', 'same data'}
        Data that `trial` has.

    Raises
    ------
    DataError
        As `before_after`, and with fewer than two pings within the trajectory.
    """
    orientation_at = _orientation(trial, solution)
    frd = frd_from_body(trial.body_axes)
    rejected = np.concatenate(
        [np.zeros(0), *(r.time for r in solution.rejected if r.label.startswith("DVL"))]
    )

    def residuals(of: Trial, values: Mapping[str, Array] | None) -> tuple[Array, Array]:
        mounting = mounting_of(of, values)
        time, v_b, nRb = body_velocity(of, mounting, orientation_at)
        v_n = _velocity(solution.trajectory, time)
        used = np.isfinite(v_n).all(axis=1) & ~np.isin(time + mounting.time_offset, rejected)
        predicted = rotate(nRb.transpose(0, 2, 1), v_n)
        return time[used], ((predicted - v_b) @ frd.T)[used]

    corrected, _ = with_calibration(trial, values)
    tracks = before_after(trial, values, orientation_at)
    time, after = residuals(corrected, values if corrected is trial else None)
    stamp, before = residuals(trial, None)
    if min(time.size, stamp.size) < 2:
        raise DataError(
            "fewer than two pings to compare with the trajectory",
            where="DVL",
            expected="pings with a lock within the trajectory",
        )
    return Check(
        data=data,
        time=time,
        before=interpolate(time, stamp, before),
        after=after,
        tracks=tracks,
    )


def _velocity(trajectory: Trajectory, time: Array) -> Array:
    """Return velocities (M, 3), m/s, at times; nan beyond the trajectory."""
    known = np.isfinite(trajectory.velocity).all(axis=1)
    if known.sum() < 2:
        return np.full((time.size, 3), np.nan)
    spline = CubicSpline(trajectory.time[known], trajectory.velocity[known], extrapolate=False)
    return np.asarray(spline(time))


def _orientation(trial: Trial, solution: Solution) -> OrientationAt:
    """Return the attitude of a solution at any time, by the gyros where there are any."""
    trajectory = solution.trajectory
    if trial.imu is None:
        return _splined(trajectory, solution)
    bias = np.zeros(3)
    if "gyro_bias_deg_h" in {e.name for e in solution.estimates}:
        bias = solution.estimate("gyro_bias_deg_h").value * DEG_PER_HOUR
    return AttitudeHistory(trial.imu, trajectory, solution.body_axes, bias).at


def _splined(trajectory: Trajectory, solution: Solution) -> OrientationAt:
    known = np.isfinite(trajectory.rph).all(axis=1)
    own = trajectory.time[known]
    spline = CubicSpline(own, np.unwrap(trajectory.rph[known], axis=0))
    rate = spline.derivative()

    def at(time: Array) -> Orientation:
        rph = np.asarray(spline(time))
        after = np.clip(np.searchsorted(own, time), 1, own.size - 1)
        inside = (time >= own[0]) & (time <= own[-1])
        omega = rotate(theta_by_rph(rph, solution.body_axes), np.asarray(rate(time)))
        near = own[after] - own[after - 1] < _LONGEST
        return Orientation(rotation_from_rph(rph, solution.body_axes), omega, inside & near)

    return at
