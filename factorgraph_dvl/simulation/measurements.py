"""Simulated records of IMU, GNSS and DVL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import factorial

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.simulation.gravity import force_by_deflection
from factorgraph_dvl.simulation.instruments import (
    DvlTruth,
    GnssTruth,
    Interval,
    Sampled,
    ScenarioView,
)
from factorgraph_dvl.simulation.motion import TrueMotion, TrueState

# Chosen: samples computed at a time; limits memory to some megabytes.
_CHUNK = 32768


def simulate_imu(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Imu, dict[str, Array]]:
    """Return the IMU's record, and its biases by reported name.

    `mean` samples are averages over the interval from the sample before; the sample
    after a gap still averages over its own period only.
    """
    truth = scenario.imu
    assert truth is not None
    jitter_rng, bias_rng, walk_rng, noise_rng, gravity_rng = rng.spawn(5)
    # The interval of the first sample must not begin before the motion.
    bounds = sample_times(truth, motion.duration, jitter_rng, first=0)
    time, interval = bounds[1:], np.diff(bounds)
    if time.size == 0:
        raise ConfigError(
            "the manoeuvres are shorter than one IMU period",
            where=f"{scenario.source} key manoeuvres",
            expected=f"more than {1.0 / truth.rate_hz:g} s",
        )
    if truth.sampling == "mean":
        gyro, accel = _mean_samples(motion, bounds)
    else:
        gyro, accel = _instantaneous_samples(motion, time)
    if scenario.noise and truth.gravity_deflection_std_arcsec > 0.0:
        middle = time - 0.5 * interval if truth.sampling == "mean" else time
        accel += force_by_deflection(scenario, motion, middle, gravity_rng)

    biases = {}
    for name, samples, unit, constant, std, walk, noise in (
        (
            "gyro_bias_deg_h",
            gyro,
            DEG_PER_HOUR,
            truth.gyro_bias_deg_h,
            truth.gyro_bias_std_deg_h,
            truth.gyro_bias_walk_deg_h_sqrt_h,
            truth.gyro_noise_deg_sqrt_h * DEG_PER_SQRT_HOUR,
        ),
        (
            "accel_bias_ug",
            accel,
            MICRO_G,
            truth.accel_bias_ug,
            truth.accel_bias_std_ug,
            truth.accel_bias_walk_ug_sqrt_h,
            truth.accel_noise_ug_sqrt_hz * MICRO_G,
        ),
    ):
        # Always drawn, so that a setting does not change the other draws.
        drawn = bias_rng.standard_normal(3) * (std or 0.0)
        bias = np.broadcast_to(drawn if constant == "draw" else np.array(constant), gyro.shape)
        if scenario.noise and walk > 0.0:
            steps = walk_rng.standard_normal(gyro.shape) * np.sqrt(interval / HOUR)[:, None]
            bias = bias + walk * np.cumsum(steps, axis=0)
        samples += bias * unit
        if scenario.noise and noise > 0.0:
            white = noise_rng.standard_normal(gyro.shape)
            samples += white * (noise / np.sqrt(interval))[:, None]
        biases[name] = bias
    keep = ~within(time, truth.gaps_s)
    imu = Imu(
        settings=cast("ImuSettings", scenario.settings("imu")),
        time=time[keep],
        gyro=gyro[keep],
        accel=accel[keep],
    )
    return imu, {name: bias[keep].mean(axis=0) for name, bias in biases.items()}


def simulate_gnss(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Gnss, dict[str, Array]]:
    """Return the receiver's record, position and velocity of the antenna, and its truth.

    Of the noise, only the white part.
    """
    truth: GnssTruth = scenario.gnss
    jitter_rng, position_rng, velocity_rng = rng.spawn(3)
    time = sample_times(truth, motion.duration, jitter_rng)
    # The antenna is on the ship, even if a turntable turns the IMU.
    state = motion.ship_at(time)
    nRs = rotation_from_rph(state.rph, scenario.body_axes)
    position, arm_n = state.geodetic, apply(nRs, np.array(truth.lever_arm_m))

    def velocity_at(time: Array, _: IntArray) -> Array:
        state = motion.ship_at(time)
        nRs = rotation_from_rph(state.rph, scenario.body_axes)
        return state.v_n + apply(nRs, np.cross(state.omega_eb_b, truth.lever_arm_m))

    length = truth.velocity_averaging_s
    # The motion before the start and after the end is not known.
    middle = middles(time - truth.velocity_delay_s, motion, length)
    moving = np.isin(time - truth.velocity_delay_s, middle)
    velocity = np.full((time.size, 3), np.nan)
    velocity[moving] = mean_over(velocity_at, motion, middle, length)
    white = position_rng.standard_normal(arm_n.shape) * truth.position_std_m
    error = np.sqrt(1.0 - truth.correlated_share) * white
    geodetic = displaced(position, arm_n + error if scenario.noise else arm_n)
    if truth.velocity_std_m_s is None:
        velocity = np.full_like(velocity, np.nan)
    elif scenario.noise:
        white = velocity_rng.standard_normal(velocity.shape) * truth.velocity_std_m_s
        velocity += np.sqrt(1.0 - truth.velocity_correlated_share) * white
    keep = ~within(time, truth.outages_s)
    unknown = np.full((int(keep.sum()), 3), np.nan)
    gnss = Gnss(
        settings=cast("GnssSettings", scenario.settings("gnss")),
        time=time[keep],
        geodetic=geodetic[keep],
        velocity=velocity[keep],
        position_std=unknown,
        velocity_std=unknown.copy(),
    )
    of_velocity = {
        "gnss_velocity_delay_s": truth.velocity_delay_s,
        "gnss_velocity_averaging_s": truth.velocity_averaging_s,
    }
    return gnss, {
        "gnss_lever_arm_m": np.array(truth.lever_arm_m),
        "gnss_time_offset_s": np.zeros(1),
        **{name: np.array([value]) for name, value in of_velocity.items() if value},
    }


def simulate_dvl(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Dvl, dict[str, Array]]:
    """Return the DVL's record, and its calibration by reported name.

        v_d = (1 + k) C_b^d (v_b + omega_eb_b x l) + noise,

    at the true time of the ping, or its mean over a window with the ping in the middle. Through
    the water, v_b excludes the current.
    """
    truth: DvlTruth = scenario.dvl
    jitter_rng, noise_rng, water_rng = rng.spawn(3)
    time = sample_times(truth, motion.duration, jitter_rng)
    time = middles(time, motion, truth.averaging_s)
    water = _water(scenario, time, motion.at(time), water_rng)
    velocity = mean_over(
        lambda when, window: _dvl_velocity(scenario, motion.at(when), water[window]),
        motion,
        time,
        truth.averaging_s,
    )
    if scenario.noise:
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        sigma = np.hypot(truth.velocity_std_m_s, truth.velocity_std_fraction * speed)
        sigma *= np.sqrt(1.0 - truth.correlated_share)
        velocity += sigma * noise_rng.standard_normal(velocity.shape)
    velocity[within(time, truth.no_lock_s)] = np.nan
    dvl = Dvl(
        settings=cast("DvlSettings", scenario.settings("dvl")),
        time=time,
        velocity=velocity,
        std=np.full_like(velocity, np.nan),
    )
    calibration = {
        "misalignment_deg": np.array(truth.misalignment_deg),
        "scale_error": np.atleast_1d(np.array(truth.scale_error, dtype=float)),
        "lever_arm_m": np.array(truth.lever_arm_m),
        "dvl_bias_m_s": np.zeros(3),
        "time_offset_s": np.zeros(1),
        "averaging_s": np.array([truth.averaging_s]),
    }
    if truth.reference == "water":
        calibration["current_m_s"] = np.array(scenario.current_m_s[:2])
        if truth.moving_water is not None:
            calibration["current_m_s"] = np.mean(water[:, :2], axis=0)
    return dvl, calibration


def _water(
    scenario: ScenarioView, time: Array, state: TrueState, rng: np.random.Generator
) -> Array:
    """Return the velocity of what the DVL is locked on, (M, 3), m/s."""
    truth: DvlTruth = scenario.dvl
    water = np.zeros((time.size, 3))
    if truth.reference == "bottom":
        return water
    water += np.array(scenario.current_m_s)
    moving = truth.moving_water
    if moving is not None and scenario.noise:
        east, north, _ = pymap3d.geodetic2enu(*state.geodetic.T, *state.geodetic[0], deg=False)
        water[:, :2] += moving_water(
            time,
            np.stack([east, north], axis=1),
            moving.std_m_s,
            moving.correlation_time_s,
            moving.correlation_distance_m,
            rng,
        )
    return water


def moving_water(
    time: Array,
    place: Array,
    std_m_s: float,
    tau_s: float,
    distance_m: float,
    rng: np.random.Generator,
) -> Array:
    """Return a current that changes with time and place, east and north, (M, 2), m/s.

    Its covariance falls as exp(-|t| / tau - |x| / distance). It is drawn once a minute, and
    between these knots as a random walk that meets both: over so short a time it is one.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times in order.
    place : ndarray, shape (M, 2), m
        East and north.
    std_m_s, tau_s, distance_m : float
        Standard deviation, correlation time and distance.
    rng : numpy.random.Generator
        Source of the numbers.
    """
    knots = np.unique(np.append(np.searchsorted(time, np.arange(time[0], time[-1], 60.0)),
                                time.size - 1))  # fmt: skip
    apart = np.linalg.norm(place[knots, None] - place[knots], axis=2)
    later = np.abs(time[knots, None] - time[knots])
    covariance = np.exp(-later / tau_s - apart / distance_m) + 1e-9 * np.eye(knots.size)
    draws = std_m_s * np.linalg.cholesky(covariance) @ rng.standard_normal((knots.size, 2))
    way = np.linalg.norm(np.diff(place, axis=0), axis=1)
    steps = np.diff(time) / tau_s + way / distance_m
    passed = np.append(0.0, np.cumsum(steps))
    walk = np.zeros((time.size, 2))
    walk[1:] = np.cumsum(
        std_m_s * np.sqrt(2.0 * steps)[:, None] * rng.standard_normal((steps.size, 2)), axis=0
    )
    beyond = draws - walk[knots]
    return walk + np.stack([np.interp(passed, passed[knots], x) for x in beyond.T], axis=1)


def middles(time: Array, motion: TrueMotion, length: float) -> Array:
    """Return the times (M,) about which a window of a length lies within the motion."""
    half = 0.5 * length
    return time[(time >= half) & (time <= motion.duration - half)]


def mean_over(
    velocity: Callable[[Array, IntArray], Array], motion: TrueMotion, time: Array, length: float
) -> Array:
    """Return means of a velocity over windows about times (M,), (M, 3).

    By Gauss and Legendre, on pieces between the kinks of the motion.

    Parameters
    ----------
    velocity : callable
        Velocity at times (K,) of windows (K,) by number, (K, 3), m/s.
    motion : TrueMotion
        The motion.
    time : ndarray, shape (M,), s
        Middles of the windows.
    length : float, s
        Length of the windows; 0 = the velocity at the times.
    """
    if length == 0.0:
        return velocity(time, np.arange(time.size))
    order = _quadrature_order(motion.highest_rate() * length)
    points, weights = np.polynomial.legendre.leggauss(order)
    half = 0.5 * length
    edges = [
        np.concatenate([[t - half], motion.kinks[np.abs(motion.kinks - t) < half], [t + half]])
        for t in time
    ]
    window = np.repeat(np.arange(time.size), [each.size - 1 for each in edges])
    first = np.concatenate([each[:-1] for each in edges])
    width = np.concatenate([np.diff(each) for each in edges])
    out = np.zeros((time.size, 3))
    for point, weight in zip(points, weights, strict=True):
        inside = np.clip(first + 0.5 * width * (point + 1.0), 0.0, motion.duration)
        part = (0.5 * weight / length) * width[:, None] * velocity(inside, window)
        np.add.at(out, window, part)
    return out


def _dvl_velocity(scenario: ScenarioView, state: TrueState, current: Array) -> Array:
    truth: DvlTruth = scenario.dvl
    bRn = np.swapaxes(rotation_from_rph(state.rph, scenario.body_axes), 1, 2)
    at_imu = apply(bRn, state.v_n - current)
    at_dvl = at_imu + np.cross(state.omega_eb_b, truth.lever_arm_m)
    misalignment = Rotation.from_rotvec(np.array(truth.misalignment_deg) * DEG)
    return np.asarray((1.0 + np.array(truth.scale_error)) * misalignment.apply(at_dvl))


def displaced(geodetic: Array, enu: Array) -> Array:
    """Return geodetic coordinates (M, 3) moved by local east, north, up (M, 3), m."""
    moved = pymap3d.enu2geodetic(*enu.T, *geodetic.T, deg=False)
    # pymap3d drops the dimension of a single latitude, and only of that.
    return np.stack([np.reshape(x, -1).astype(float) for x in moved], axis=1)


def apply(matrices: Array, vectors: Array) -> Array:
    """Return products of matrices (M, 3, 3) and vectors (M, 3) or (3,)."""
    return np.asarray(
        np.einsum("mij,mj->mi", matrices, np.broadcast_to(vectors, (len(matrices), 3)))
    )


def sample_times(
    sampled: Sampled, duration: float, rng: np.random.Generator, first: int | None = None
) -> Array:
    """Return times phase + k / rate after 0, or from k = `first` on, up to the end."""
    if first is None:
        first = 0 if sampled.phase_s > 0.0 else 1
    last = int(np.floor((duration - sampled.phase_s) * sampled.rate_hz + 1e-6))
    # Divided, not multiplied by a period: 0.3, not 0.30000000000000004.
    time = sampled.phase_s + np.arange(first, last + 1) / sampled.rate_hz
    shift = sampled.jitter_s * rng.uniform(-1.0, 1.0, time.size)
    return np.asarray(np.clip(time + shift, 0.0, duration))


def within(time: Array, intervals: Sequence[Interval]) -> NDArray[np.bool_]:
    """Return which times lie within any interval, its ends included."""
    out = np.zeros(time.size, dtype=bool)
    for start, end in intervals:
        out |= (time >= start) & (time <= end)
    return out


def _instantaneous_samples(motion: TrueMotion, time: Array) -> tuple[Array, Array]:
    gyro, accel = np.empty((time.size, 3)), np.empty((time.size, 3))
    for begin in range(0, time.size, _CHUNK):
        part = slice(begin, begin + _CHUNK)
        state = motion.at(time[part])
        gyro[part], accel[part] = state.omega_ib_b, state.f_b
    return gyro, accel


def _mean_samples(motion: TrueMotion, bounds: Array) -> tuple[Array, Array]:
    """Return averages of angular rate and specific force between bounds (N + 1,).

    Gauss-Legendre quadrature, on pieces between the kinks of the motion.
    """
    n = bounds.size - 1
    order = _quadrature_order(motion.highest_rate() * float(np.max(np.diff(bounds))))
    points, weights = np.polynomial.legendre.leggauss(order)
    gyro, accel = np.empty((n, 3)), np.empty((n, 3))
    for begin in range(0, n, _CHUNK):
        own = bounds[begin : begin + _CHUNK + 1]
        inside = motion.kinks[(motion.kinks > own[0]) & (motion.kinks < own[-1])]
        edges = np.union1d(own, inside)
        width = np.diff(edges)
        t = edges[:-1, None] + 0.5 * width[:, None] * (points + 1.0)
        state = motion.at(t.ravel())
        first = np.searchsorted(edges, own[:-1])
        for out, values in ((gyro, state.omega_ib_b), (accel, state.f_b)):
            integral = (
                0.5 * width[:, None] * np.einsum("q,mqi->mi", weights, values.reshape(*t.shape, 3))
            )
            sums = np.add.reduceat(integral, first, axis=0)
            out[begin : begin + _CHUNK] = sums / np.diff(own)[:, None]
    return gyro, accel


def _quadrature_order(phase: float) -> int:
    """Return the fewest Gauss points that average a sinusoid over `phase` rad exactly.

    Error bound: phase^(2q) (q!)⁴ / ((2q + 1) (2q)!³). Davis and Rabinowitz, Methods of
    Numerical Integration, eq. 2.7.12.
    """
    orders = np.arange(2, 25)
    bound = phase ** (2.0 * orders) * factorial(orders) ** 4
    bound /= (2 * orders + 1) * factorial(2 * orders) ** 3
    good = orders[bound < 1e-13]
    return int(good[0]) if good.size else int(orders[-1])
