"""Attitude of a SINS by itself, and velocity of GNSS by itself: motion that no filter has joined.

What the patent of Cao, Sun, Liu, Zhang and Liu (Harbin Engineering University) starts from. The
attitude follows the gyros from the first one on, its errors grow, and its covariance is that of
the first attitude.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.navigation import NavigationMotion, earth_rate
from factorgraph_dvl.baselines.strapdown import at_times, compose, exp_small, prepare
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import rotation_from_rph, rph_jacobian
from factorgraph_dvl.geometry.vectors import Array, interpolate, rotate
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.trial import Trial


def separate_motion(trial: Trial, time: Array) -> NavigationMotion:
    """Return attitude by the gyros alone, and velocity by GNSS alone, at times (M,).

    Parameters
    ----------
    trial : Trial
        Trial with `initial_attitude`, IMU without gaps, and GNSS with velocities.
    time : ndarray, shape (M,), s
        Within the records of both.

    Raises
    ------
    DataError
        If the trial has no attitude to start from, no velocity of GNSS, or a gap of the IMU.
    """
    inc, _ = increments(trial.inertial)
    gnss, start = trial.gnss, trial.initial_attitude
    if start is None or gnss is None or np.isnan(gnss.velocity).all() or len(inc.arcs) > 1:
        raise DataError(
            "a SINS by itself needs an attitude to start from, an IMU without gaps, and the "
            "velocities of GNSS",
            where="trial.yaml",
            expected="initial.attitude, and velocities in the record of GNSS",
        )
    samples = prepare(inc, trial.inertial.settings)
    known = ~np.isnan(gnss.velocity[:, 0])
    antenna = interpolate(time, gnss.time[known], gnss.velocity[known])
    variance = interpolate(time, gnss.time[known], gnss.velocity_std[known] ** 2)
    place = interpolate(time, gnss.time[known], gnss.geodetic[known])
    frame_rate = _frame_rate(place, antenna)

    steps = compose(samples, np.concatenate([inc.start[:1], time[:-1]]), time)
    turn_of_n = exp_small(-steps.duration[:, None] * frame_rate)
    C, nRb = rotation_from_rph(start.rph, trial.body_axes), np.empty((time.size, 3, 3))
    J = C @ np.linalg.inv(rph_jacobian(start.rph, trial.body_axes))
    for k in range(time.size):
        C = turn_of_n[k] @ C @ steps.turn[k]
        nRb[k] = C
    _, signal = at_times(samples, time)
    omega_b = signal.omega - rotate(nRb.transpose(0, 2, 1), earth_rate(place[:, 0]))
    velocity = antenna - _of_antenna(gnss, time, nRb, omega_b)
    covariance = np.zeros((time.size, 9, 9))
    covariance[:, [3, 4, 5], [3, 4, 5]] = variance
    covariance[:, 6:, 6:] = J @ np.diag(start.std**2) @ J.T
    return NavigationMotion(
        time=time,
        geodetic=place,
        velocity=velocity,
        nRb=nRb,
        covariance=covariance,
        omega_b=omega_b,
        omega_sigma=signal.omega_sigma,
        covered=np.ones(time.size, dtype=bool),
    )


def _frame_rate(place: Array, velocity: Array) -> Array:
    """Return the rate of east, north, up in inertial space, in these axes, (M, 3), rad/s."""
    lat, height = place[:, 0], place[:, 2]
    meridian, east = radii(lat)
    x, y = velocity[:, 0] / (east + height), velocity[:, 1] / (meridian + height)
    return earth_rate(lat) + np.column_stack([-y, x, x * np.tan(lat)])


def _of_antenna(gnss: Gnss, time: Array, nRb: Array, omega: Array) -> Array:
    """Return the velocity of the antenna relative to the IMU, (M, 3), m/s."""
    lever_arm, omega_cb_b = gnss.lever_arm(time)
    return rotate(nRb, np.cross(omega - omega_cb_b, lever_arm))
