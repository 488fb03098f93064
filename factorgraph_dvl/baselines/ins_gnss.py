"""Error-state Kalman filter of SINS and GNSS, and its Rauch-Tung-Striebel smoother.

Fifteen states: position (east, north, up, m), velocity (m/s), attitude, gyro bias
(rad/s), accelerometer bias (m/s²). The errors are true - estimated; that of the attitude
is phi in nRb_true = Exp(phi) nRb, in local-level axes. The mechanisation is local-level
on the ellipsoid, with Earth and transport rate, Coriolis and normal gravity; the filter
feeds its estimates back at every measurement.

Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd
ed., chapters 5 and 14. Left out of the error model, as below a micro-g and 1e-5 deg/h for
positions known to some metres: the derivatives of gravity and Earth rate with position.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt, tan

import numpy as np

from factorgraph_dvl.baselines.kalman_filter import ForwardPass, smoothed_errors, update
from factorgraph_dvl.baselines.strapdown import Steps
from factorgraph_dvl.geometry.earth import (
    ECCENTRICITY_SQUARED,
    RATE,
    SEMI_MAJOR,
    normal_gravity,
    radii,
)
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3, wrapped
from factorgraph_dvl.geometry.vectors import Array, skew

# Chosen: below this, rad, rotations add up to better than 1e-12.
_SMALL_TURN = 1e-6
_EYE = np.eye(3)


@dataclass(frozen=True)
class FilterState:
    """The state at the start of an arc.

    Parameters
    ----------
    geodetic : ndarray, shape (3,)
        Latitude, longitude (rad), height (m).
    velocity : ndarray, shape (3,), m/s
        Local-level.
    nRb : ndarray, shape (3, 3)
        Attitude, body to local-level.
    gyro_bias : ndarray, shape (3,), rad/s
        Gyro bias in body axes.
    accel_bias : ndarray, shape (3,), m/s²
        Accelerometer bias in body axes.
    covariance : ndarray, shape (15, 15)
        Covariance of the errors.
    """

    geodetic: Array
    velocity: Array
    nRb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array


@dataclass(frozen=True)
class Fixes:
    """GNSS measurements at K events, nan where there are none.

    Parameters
    ----------
    geodetic, velocity : ndarray, shape (K, 3)
        Position and velocity of the antenna.
    position_variance, velocity_variance : ndarray, shape (K, 3)
        East, north, up.
    turning : ndarray, shape (K, 3), rad/s
        Reading of the gyros less the rate of the body on its carrier.
    lever_arm : ndarray, shape (3,) or (K, 3)
        Lever arm of the antenna, in body, m.
    """

    geodetic: Array
    velocity: Array
    position_variance: Array
    velocity_variance: Array
    turning: Array
    lever_arm: Array


@dataclass(frozen=True)
class FilteredTrack:
    """Estimated states of K events of one arc, with their covariance.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the events.
    geodetic, velocity, nRb, gyro_bias, accel_bias : ndarray, shape (K, ...)
        Position, velocity, attitude, gyro bias and accelerometer bias as in `FilterState`.
    covariance : ndarray, shape (K, 15, 15)
        Covariances of the errors.
    apparent_gravity : ndarray, shape (K, 3), m/s²
        Gravity less Coriolis terms over the step that follows.
    frame_rate : ndarray, shape (K, 3), rad/s
        Rate of the local-level axes over that step.
    """

    time: Array
    geodetic: Array
    velocity: Array
    nRb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    apparent_gravity: Array
    frame_rate: Array


def run_filter(
    time: Array, steps: Steps, fixes: Fixes, start: FilterState, walk_psd: tuple[float, float]
) -> ForwardPass[FilteredTrack]:
    """Run the filter over the events of one arc.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the events.
    steps : Steps
        The K - 1 steps between them.
    fixes : Fixes
        GNSS measurements at the events.
    start : FilterState
        State at the first event.
    walk_psd : tuple of (float, float)
        Power spectral densities of the random walks of gyro and accelerometer bias, rad²/s³,
        m²/s⁵.
    """
    k_events = time.size
    geodetic, velocity = np.empty((k_events, 3)), np.empty((k_events, 3))
    nRb, biases = np.empty((k_events, 3, 3)), np.empty((k_events, 6))
    filtered = np.empty((k_events, 15, 15))
    predicted, transition = np.empty_like(filtered), np.empty_like(filtered)
    correction = np.zeros((k_events, 15))
    apparent_gravity, frame_rate = np.zeros((k_events, 3)), np.zeros((k_events, 3))

    Q = _process_noise(steps, walk_psd)
    by_gyro = skew(steps.dv * steps.duration[:, None] - steps.dp)
    has_position = ~np.isnan(fixes.geodetic[:, 0])
    has_velocity = ~np.isnan(fixes.velocity[:, 0])

    lat, lon, height = start.geodetic.tolist()
    v, C, P = start.velocity.copy(), start.nRb.copy(), start.covariance.copy()
    bg, ba = start.gyro_bias.copy(), start.accel_bias.copy()
    F = np.eye(15)
    for k in range(k_events):
        if k:
            j = k - 1
            at, v, C, gravity = _step(steps, j, by_gyro[j], (lat, lon, height), v, C, bg, ba, F)
            (lat, lon, height), (apparent_gravity[j], frame_rate[j]) = at, gravity
            P = F @ P @ F.T + Q[j]
            transition[k] = F
        predicted[k] = P

        if has_position[k] or has_velocity[k]:
            at = (lat, lon, height)
            H, z, R = _measured(fixes, k, has_position[k], has_velocity[k], at, v, C, bg)
            K, P = update(P, H, R)
            x = K @ z
            correction[k] = x
            meridian, east_radius, _ = _radii(lat)
            lon += x[0] / ((east_radius + height) * cos(lat))
            lat += x[1] / (meridian + height)
            height += x[2]
            v = v + x[3:6]
            C = _exp(x[6:9]) @ C
            bg, ba = bg + x[9:12], ba + x[12:15]
        filtered[k] = P
        geodetic[k] = lat, lon, height
        velocity[k], nRb[k] = v, C
        biases[k, :3], biases[k, 3:] = bg, ba
    if k_events > 1:
        apparent_gravity[-1], frame_rate[-1] = apparent_gravity[-2], frame_rate[-2]
    gyro_bias, accel_bias = biases[:, :3], biases[:, 3:]
    motion = (time, geodetic, velocity, nRb, gyro_bias, accel_bias)
    track = FilteredTrack(*motion, filtered, apparent_gravity, frame_rate)
    return ForwardPass(track, transition, predicted, correction)


def _step(
    steps: Steps,
    j: int,
    by_gyro: Array,
    at: tuple[float, float, float],
    v: Array,
    C: Array,
    bg: Array,
    ba: Array,
    F: Array,
) -> tuple[tuple[float, float, float], Array, Array, tuple[Array, Array]]:
    """Return position, velocity and attitude after step j, with apparent gravity and frame rate.

    The transition of the errors is written to F (15, 15); its zeros and ones stay.
    """
    lat, lon, height = at
    T = float(steps.duration[j])
    bias_jacobian = steps.bias_jacobian[j]
    CV = C @ (steps.dv[j] - bias_jacobian @ ba + by_gyro @ bg)
    CP = C @ (steps.dp[j] - (0.5 * T) * (bias_jacobian @ ba))
    g = float(normal_gravity(lat, height))
    v_mid = v + 0.5 * CV
    v_mid[2] -= 0.5 * g * T
    ve, vn, _ = v_mid.tolist()
    meridian, east_radius, tangent = _radii(lat)
    rm, re = meridian + height, east_radius + height
    wn, wu = RATE * cos(lat), RATE * sin(lat)
    transport = (-vn / rm, ve / re, ve * tangent / re)
    rate = np.array((transport[0], wn + transport[1], wu + transport[2]))
    coriolis = _cross((transport[0], 2 * wn + transport[1], 2 * wu + transport[2]))
    acceleration = -(coriolis @ v_mid)
    acceleration[2] -= g
    # The axes turn while the force acts: on average by half of their turn.
    acceleration -= 0.5 * (_cross(rate.tolist()) @ CV)

    moved = (v * T + CP + acceleration * (0.5 * T * T)).tolist()
    CA = C @ bias_jacobian
    F[0:3, 3:6] = T * _EYE
    F[0:3, 6:9] = -_cross(CP.tolist())
    F[0:3, 12:15] = CA * (-0.5 * T)
    F[3:6, 3:6] = _EYE - coriolis * T
    F[3:6, 6:9] = -_cross(CV.tolist())
    F[3:6, 9:12] = C @ by_gyro
    F[3:6, 12:15] = -CA
    F[6:9, 4] = (T / rm, 0.0, 0.0)
    F[6:9, 3] = (0.0, -T / re, -T * tangent / re)
    F[6:9, 6:9] = _EYE - _cross((rate * T).tolist())
    F[6:9, 9:12] = -CA
    turned = _exp(-T * rate) @ C @ _exp(-(bias_jacobian @ bg)) @ steps.turn[j]
    middle = lat + 0.5 * moved[1] / rm
    after = (lat + moved[1] / rm, lon + moved[0] / (re * cos(middle)), height + moved[2])
    return after, v + CV + acceleration * T, turned, (acceleration, rate)


def _measured(
    fixes: Fixes,
    k: int,
    has_position: bool,
    has_velocity: bool,
    at: tuple[float, float, float],
    v: Array,
    C: Array,
    bg: Array,
) -> tuple[Array, Array, Array]:
    """Return matrix, innovation and variances of the fix at event k."""
    lat, lon, height = at
    lever_arm = fixes.lever_arm if fixes.lever_arm.ndim == 1 else fixes.lever_arm[k]
    H = np.zeros((6, 15))
    z = np.zeros(6)
    if has_position:
        arm = C @ lever_arm
        meridian, east_radius, _ = _radii(lat)
        measured = fixes.geodetic[k].tolist()
        east = (east_radius + height) * cos(lat)
        z[0:3] = (
            wrapped(measured[1] - lon) * east,
            (measured[0] - lat) * (meridian + height),
            measured[2] - height,
        )
        z[0:3] -= arm
        H[0:3, 0:3] = _EYE
        H[0:3, 6:9] = -_cross(arm.tolist())
    if has_velocity:
        earth = np.array((0.0, RATE * cos(lat), RATE * sin(lat)))
        omega = fixes.turning[k] - bg - earth @ C
        lever_cross = _cross(lever_arm.tolist())
        turning = C @ -(lever_cross @ omega)
        z[3:6] = fixes.velocity[k] - v - turning
        H[3:6, 3:6] = _EYE
        H[3:6, 6:9] = -_cross(turning.tolist())
        H[3:6, 9:12] = C @ lever_cross
    R = np.concatenate([fixes.position_variance[k], fixes.velocity_variance[k]])
    if has_position and has_velocity:
        return H, z, R
    rows = slice(0, 3) if has_position else slice(3, 6)
    return H[rows], z[rows], R[rows]


def smooth(forward: ForwardPass[FilteredTrack]) -> FilteredTrack:
    """Return the states given all measurements of the arc (Rauch, Tung, Striebel)."""
    return _corrected(forward.track, *smoothed_errors(forward, _sum_of_errors))


def _sum_of_errors(fed_back: Array, error: Array) -> Array:
    """Return what two errors amount to, one after the other."""
    total = fed_back + error
    if np.abs(fed_back[6:9]).max() > _SMALL_TURN:
        # Rotations compose, they do not add.
        total[6:9] = log_so3(exp_so3(error[6:9]) @ exp_so3(fed_back[6:9]))
    return total


def _corrected(track: FilteredTrack, error: Array, covariance: Array) -> FilteredTrack:
    lat, lon, height = track.geodetic.T
    meridian, east_radius = radii(lat)
    geodetic = np.stack(
        [
            lat + error[:, 1] / (meridian + height),
            lon + error[:, 0] / ((east_radius + height) * np.cos(lat)),
            height + error[:, 2],
        ],
        axis=1,
    )
    return FilteredTrack(
        track.time,
        geodetic,
        track.velocity + error[:, 3:6],
        exp_so3(error[:, 6:9]) @ track.nRb,
        track.gyro_bias + error[:, 9:12],
        track.accel_bias + error[:, 12:15],
        covariance,
        track.apparent_gravity,
        track.frame_rate,
    )


def _process_noise(steps: Steps, walk_psd: tuple[float, float]) -> Array:
    """Return (M, 15, 15): white noise of the sensors, and of what drives the biases.

    What the noise of a gyro does to the velocity within a step, through tilted gravity,
    is a hundredth of what the accelerometer's own does.
    """
    T, eye = steps.duration[:, None, None], np.eye(3)
    accel = steps.accel_variance[:, None, None] * eye
    out = np.zeros((steps.duration.size, 15, 15))
    out[:, 0:3, 0:3] = accel * T**2 / 3.0
    out[:, 0:3, 3:6] = out[:, 3:6, 0:3] = accel * T / 2.0
    out[:, 3:6, 3:6] = accel
    out[:, 6:9, 6:9] = steps.gyro_variance[:, None, None] * eye
    out[:, 9:12, 9:12] = walk_psd[0] * T * eye
    out[:, 12:15, 12:15] = walk_psd[1] * T * eye
    return out


def _radii(lat: float) -> tuple[float, float, float]:
    """Return meridian and prime-vertical radius, m, and the tangent of the latitude."""
    root = 1.0 - ECCENTRICITY_SQUARED * sin(lat) ** 2
    east = SEMI_MAJOR / sqrt(root)
    return east * (1.0 - ECCENTRICITY_SQUARED) / root, east, tan(lat)


def _cross(v: tuple[float, ...] | list[float]) -> Array:
    """Return [v x] of one vector: `skew` without what it costs to serve many."""
    x, y, z = v
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _exp(phi: Array) -> Array:
    """Return Exp([phi x]) of one vector, quickly where it is small."""
    x, y, z = phi.tolist()
    square = x * x + y * y + z * z
    if square > 1e-4:
        return exp_so3(phi)
    cross = _cross((x, y, z))
    return np.eye(3) + (1.0 - square / 6.0) * cross + (0.5 - square / 24.0) * (cross @ cross)
