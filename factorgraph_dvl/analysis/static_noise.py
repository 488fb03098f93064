"""Noise of an IMU from a static record: Allan deviation, and what is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.imu import Imu

# Allan variance of a flicker of instability B, in B² (IEEE Std 952-2020, annex C).
_FLICKER = 2.0 * np.log(2.0) / np.pi
# Chosen, s: the filters of instruments shape what comes below.
_SHORTEST_TAU = 0.1
# Chosen: beyond this share of the record too few differences are left.
_LONGEST_SHARE = 0.2
# Chosen: relative deviation of real noise from the three terms of the model.
_MODEL_ERROR = 0.02
# Chosen, s: a shorter record shows nothing but white noise, and that badly.
_SHORTEST_RECORD = 60.0
# Chosen: samples that are later than this many intervals were preceded by lost ones.
_LOST = 1.5
# Chosen, rad/s: standard deviation of the mean rate over a second that no gyro at rest has.
_MOVES = 0.2 * DEG
# Chosen: a term below so many standard deviations is given as a limit.
_SEEN = 2.0
# Rounds of weights from the fitted model; the second changes them by percents.
_ROUNDS = 4


@dataclass(frozen=True)
class Figure:
    """A noise figure with its standard deviation, SI; one that was not seen is below `limit`."""

    value: float
    std: float
    limit: float

    @property
    def seen(self) -> bool:
        """Whether the record shows it."""
        return self.value > 0.0


@dataclass(frozen=True)
class AxisNoise:
    """Noise of one axis.

    Parameters
    ----------
    tau : ndarray, shape (T,), s
        Averaging times.
    deviation, std : ndarray, shape (T,)
        Overlapping Allan deviation and its standard deviation, SI.
    white : Figure
        Angle or velocity random walk, SI/√Hz.
    instability : Figure
        Bias instability B of a flicker, SI; the flat of the deviation is at 0.664 B.
    walk : Figure
        Rate random walk, SI/√s.
    """

    tau: Array
    deviation: Array
    std: Array
    white: Figure
    instability: Figure
    walk: Figure

    def model(self, tau: Array) -> Array:
        """Return the Allan deviation of the three figures."""
        terms = np.array([self.white.value, self.instability.value, self.walk.value])
        return np.asarray(np.sqrt(_basis(tau) @ terms**2))

    @property
    def walk_over_hour(self) -> float:
        """Random walk of the bias that varies as much within an hour as walk and flicker."""
        return float(
            np.hypot(self.walk.value, self.instability.value * np.sqrt(3.0 * _FLICKER / 3600.0))
        )


@dataclass(frozen=True)
class StaticNoise:
    """Noise of an IMU at rest.

    Parameters
    ----------
    duration, rate : float
        Duration and rate of the stretch without gaps that was used, s, Hz.
    gyro, accel : tuple of AxisNoise
        X, y, z.
    """

    duration: float
    rate: float
    gyro: tuple[AxisNoise, ...]
    accel: tuple[AxisNoise, ...]


def static_noise(imu: Imu) -> StaticNoise:
    """Return the noise of an IMU from its record at rest.

    Parameters
    ----------
    imu : Imu
        Record; of the settings nothing is used. Its longest stretch without gaps is taken.

    Raises
    ------
    ConfigError
        If allantools is not installed.
    DataError
        If the record is too short or not static.
    """
    step = np.diff(imu.time)
    dt = float(np.median(step)) if step.size else np.inf
    breaks = np.concatenate([[0], np.flatnonzero(step > _LOST * dt) + 1, [imu.time.size]])
    longest = int(np.argmax(np.diff(breaks)))
    part = slice(breaks[longest], breaks[longest + 1])
    count = int(breaks[longest + 1] - breaks[longest])
    if count * dt < _SHORTEST_RECORD:
        raise DataError(
            f"the longest stretch without gaps lasts {count * dt if count > 1 else 0.0:.3g} s",
            where=imu.source,
            expected=f"at least {_SHORTEST_RECORD:g} s at rest, better some hours",
        )
    gyro, accel = imu.gyro[part], imu.accel[part]
    second = max(round(1.0 / dt), 1)
    means = gyro[: count // second * second].reshape(-1, second, 3).mean(axis=1)
    moving = float(means.std(axis=0).max())
    if moving > _MOVES:
        raise DataError(
            f"the IMU moves: its rate changes by {moving / DEG:.3g} deg/s from second to second",
            where=imu.source,
            expected="a record at rest",
        )
    return StaticNoise(
        duration=count * dt,
        rate=1.0 / dt,
        gyro=tuple(_axis(values, dt) for values in gyro.T),
        accel=tuple(_axis(values, dt) for values in accel.T),
    )


def _axis(values: Array, dt: float) -> AxisNoise:
    try:
        import allantools
    except ImportError:
        raise ConfigError(
            "allantools is not installed",
            expected="the extra `allan`",
            hint="Install it by: pip install 'factorgraph-dvl[allan]'",
        ) from None
    longest = _LONGEST_SHARE * values.size * dt
    count = max(int(np.log2(longest / max(dt, _SHORTEST_TAU))), 2) + 1
    factor = np.unique(np.rint(max(dt, _SHORTEST_TAU) / dt * 2.0 ** np.arange(count)).astype(int))
    tau, deviation, _, _ = allantools.oadev(
        values - values.mean(), rate=1.0 / dt, data_type="freq", taus=factor * dt
    )
    # Flicker lies between the noises that dominate at either end.
    freedom = np.array(
        [allantools.edf_simple(values.size + 1, float(m), -1) for m in np.rint(tau / dt)]
    )
    relative = np.sqrt(2.0 / freedom)
    variance = deviation**2
    basis = _basis(tau)
    model = variance
    for _ in range(_ROUNDS):
        weight = 1.0 / (model * np.hypot(relative, _MODEL_ERROR))
        scale = np.linalg.norm(basis * weight[:, None], axis=0)
        terms = nnls(basis * weight[:, None] / scale, variance * weight)[0] / scale
        model = basis @ terms
    information = (basis * weight[:, None]).T @ (basis * weight[:, None])
    sigma = np.sqrt(np.diag(np.linalg.inv(information / np.outer(scale, scale)))) / scale
    figures = []
    for term, std in zip(terms.tolist(), sigma.tolist(), strict=True):
        limit = float(np.sqrt(term + _SEEN * std))
        if term > _SEEN * std:
            value = float(np.sqrt(term))
            figures.append(Figure(value, std / (2.0 * value), limit))
        else:
            figures.append(Figure(0.0, np.nan, limit))
    return AxisNoise(tau, deviation, 0.5 * deviation * relative, *figures)


def _basis(tau: Array) -> Array:
    """Return Allan variances of unit white noise, flicker and random walk, (T, 3)."""
    return np.stack([1.0 / tau, np.full(tau.size, _FLICKER), tau / 3.0], axis=1)
