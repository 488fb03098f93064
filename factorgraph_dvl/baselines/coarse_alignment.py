"""Coarse attitude at the start of an arc, from the IMU and GNSS velocities.

In axes that do not turn, the velocity that the specific force adds up to, resolved in the
body axes at the start, and the same velocity from GNSS and gravity differ by one rotation
(Wu and Pan, IEEE Trans. AES 49(2), 2013). A gyro bias rotates the first of them over time, so
only a window is used: the one that determines the heading best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.baselines.strapdown import Steps
from factorgraph_dvl.geometry.earth import RATE, enu_from_ecef, normal_gravity
from factorgraph_dvl.geometry.rotations import BodyAxes, best_rotation, exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, MICRO_G, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.imu import ImuSettings

# Chosen: error of the integrated velocity, m/s, that the gyro bias may cause within a window.
_WINDOW_ERROR = 0.2
# Chosen: limits of the window, s.
_WINDOW_LIMITS = (30.0, 300.0)
# Chosen: speed, m/s, from which on a course counts.
_LEAST_SPEED = 0.5
# Chosen: standard deviations of an undetermined heading, and of a course taken for the heading;
# drift angles of vessels stay within it.
_NO_HEADING = 60.0 * DEG
_COURSE = 15.0 * DEG
# Chosen: standard deviation of the heading from which on the course is better.
_HEADING_LIMIT = 20.0 * DEG


@dataclass(frozen=True)
class CoarseAttitude:
    """Attitude at the start of an arc.

    Parameters
    ----------
    nRb : ndarray, shape (3, 3)
        Local-level.
    covariance : ndarray, shape (3, 3), rad²
        Covariance of phi in Exp(phi) nRb.
    note : Message, optional
        Note for the user.
    """

    nRb: Array
    covariance: Array
    note: Message | None = None


def coarse_attitude(
    time: Array,
    steps: Steps,
    geodetic: Array,
    velocity: Array,
    sigma: Array,
    turning: Array,
    settings: ImuSettings,
    body_axes: BodyAxes,
) -> CoarseAttitude:
    """Return the attitude at the first of K events.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the events.
    steps : Steps
        The K - 1 steps between.
    geodetic : ndarray, shape (K, 3)
        Positions, to 100 m.
    velocity, sigma : ndarray, shape (K, 3)
        Velocities of the antenna, nan where there are none, and the standard deviations, m/s.
    turning : ndarray, shape (K, 3)
        Velocity of the antenna relative to the IMU, in body, m/s.
    settings : ImuSettings
        Settings of the IMU.
    body_axes : BodyAxes
        Body axes of the IMU.
    """
    body, turn = _in_first_body_axes(steps)
    body = body + rotate(turn, turning)
    known = np.flatnonzero(~np.isnan(velocity[:, 0]))
    t = time[known] - time[0]
    lat, lon, height = geodetic[known].T
    to_space = exp_so3(np.outer(t, [0.0, 0.0, RATE])) @ enu_from_ecef(lat, lon).transpose(0, 2, 1)
    space = rotate(to_space, velocity[known])
    # d/dt of the velocity over the Earth, seen from axes that do not turn with it.
    coriolis = np.cross(np.array([0.0, 0.0, RATE]), space)
    gravity = -normal_gravity(lat, height)[:, None] * to_space[:, :, 2]
    gravity_coriolis = gravity - coriolis
    span = np.diff(t)[:, None]
    space[1:] -= np.cumsum(0.5 * (gravity_coriolis[1:] + gravity_coriolis[:-1]) * span, axis=0)
    body, noise = body[known], np.sqrt(np.mean(sigma[known] ** 2))

    drift = settings.gyro_bias_std_deg_h * DEG_PER_HOUR
    level = settings.accel_bias_std_ug * MICRO_G
    longest = np.sqrt(2.0 * _WINDOW_ERROR / (STANDARD_GRAVITY * drift))
    window = float(np.clip(longest, *_WINDOW_LIMITS))
    up = enu_from_ecef(*geodetic[0, :2])[2]
    best, least = None, np.inf
    for begin in np.arange(0.0, max(t[-1] - 0.5 * window, 1e-3), 0.5 * window):
        a, b = np.searchsorted(t, [begin, begin + window])
        if b - a < 4:
            continue
        length = t[b - 1] - t[a]
        system = STANDARD_GRAVITY * drift * length**2 / 6.7 + level * length / np.sqrt(12.0)
        R, covariance = _wahba(body[a:b], space[a:b], noise, system)
        covariance = covariance + (drift * t[a]) ** 2 * np.eye(3)
        heading = float(up @ covariance @ up)
        if heading < least:
            best, least = (R, covariance), heading
    if best is None:
        best = np.eye(3), np.eye(3)
    nRe = enu_from_ecef(*geodetic[0, :2])
    nRb = nRe @ best[0]
    P = nRe @ best[1] @ nRe.T
    if np.sqrt(P[2, 2]) < _HEADING_LIMIT:
        return CoarseAttitude(nRb, P)
    return _by_course(nRb, P, turn[known], velocity[known], nRe, to_space, body_axes)


def _by_course(
    nRb: Array,
    P: Array,
    turn: Array,
    velocity: Array,
    nRe: Array,
    to_space: Array,
    body_axes: BodyAxes,
) -> CoarseAttitude:
    """Return the attitude with its heading from the course, if there is one."""
    moving = np.flatnonzero(np.linalg.norm(velocity[:, :2], axis=1) > _LEAST_SPEED)
    spread = np.full(3, 1.0)
    spread[:2] = np.minimum(np.sqrt(np.diag(P)[:2]), 30.0 * DEG)
    if moving.size == 0:
        spread[2] = _NO_HEADING
        return CoarseAttitude(
            nRb,
            np.diag(spread**2),
            message("heading_unknown.at_rest"),
        )
    k = moving[0]
    forward = nRb @ turn[k] @ frd_from_body(body_axes)[0]
    course = nRe @ rotate(to_space[k : k + 1], velocity[k : k + 1])[0]
    angle = np.arctan2(course[1], course[0]) - np.arctan2(forward[1], forward[0])
    spread[2] = _COURSE
    return CoarseAttitude(
        exp_so3([0.0, 0.0, angle]) @ nRb,
        np.diag(spread**2),
        message("heading_unknown.course"),
    )


def _in_first_body_axes(steps: Steps) -> tuple[Array, Array]:
    """Return velocity by specific force alone (K, 3) and rotation (K, 3, 3) since the start."""
    turn = np.empty((steps.duration.size + 1, 3, 3))
    turn[0] = np.eye(3)
    for k in range(steps.duration.size):
        turn[k + 1] = turn[k] @ steps.turn[k]
    body = np.zeros((turn.shape[0], 3))
    np.cumsum(rotate(turn[:-1], steps.dv), axis=0, out=body[1:])
    return body, turn


def _wahba(body: Array, space: Array, noise: float, system: float) -> tuple[Array, Array]:
    """Return R of R body + constant = space, and its covariance in the axes of space.

    `system` is the size of an error that is common to all pairs, so their number does not
    reduce it.
    """
    x, y = body - body.mean(axis=0), space - space.mean(axis=0)
    R = best_rotation(y.T @ x)
    # Of the velocity by specific force: the noise of that of GNSS would count as motion, and make
    # the heading of a straight run look known to 1 / sqrt(2 M) rad.
    moment = R @ (x.T @ x) @ R.T
    information = (np.trace(moment) * np.eye(3) - moment) / (noise**2 + len(x) * system**2)
    # A turn by a radian is as good as unknown.
    return R, np.linalg.inv(information + np.eye(3))
