"""Vibration of the IMU: motion that is too fast for other sensors to measure, and that goes on."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import correlate1d

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.interpolation import block_means
from factorgraph_dvl.imu.noise import FIRST_LOOK, unbroken_parts, white_noise
from factorgraph_dvl.sensors.imu import Imu

# Frequency, Hz, above which motion is vibration, half-width of the filter that takes it off, s,
# and widths that a record must have to show what goes on. Chosen: a ping or a Doppler measurement
# takes about a tenth of a second, and whether it follows what is faster is not known; no hull
# sways at 8 Hz. Measured: beside a propeller of 24 Hz, in velocity and rate, an INS had two clocks
# 0.016 s apart.
_VIBRATION = 8.0
_FILTER = 0.5
_GOES_ON = 10
# Share of a motion below which what passes the filter is no vibration. Chosen: it leaks less.
_LEAK = 1e-3
# Standard deviations of its power by which vibration exceeds noise. Chosen: chance never does.
_SURE = 5.0
# Samples at most that are searched for it. Chosen: minutes of motion.
_ENOUGH = 60_000


def without_vibration(imu: Imu) -> Imu:
    """Return a record without its vibration; the same one where there is none.

    Rates and forces pass a filter without delay, so that attitude, velocity and position of the
    motion do, too. What is white noise and no vibration stays in the record.

    Parameters
    ----------
    imu : Imu
        Record. Parts without gaps that are shorter than the filter stay as they are.
    """
    parts, longest, dt, regular = unbroken_parts(imu.time)
    half = round(_FILTER / dt)
    if not regular or 4.0 * _VIBRATION * dt > 1.0 or half == 0:
        return imu
    few = slice(longest.start, min(longest.stop, longest.start + _ENOUGH))
    found = white_noise(imu, stretches=FIRST_LOOK) or (0.0, 0.0)
    stated = imu.settings.gyro_noise_root_psd, imu.settings.accel_noise_root_psd
    signals = imu.gyro, imu.accel
    if not any(
        _vibrates(signal[few], dt, max(density, own) / np.sqrt(dt))
        for signal, density, own in zip(signals, found, stated, strict=True)
    ):
        return imu
    taps = _low_pass(half, dt)
    gyro, accel = (signal.copy() for signal in signals)
    for a, b in pairwise(parts):
        if b - a > 2 * half:
            gyro[a:b], accel[a:b] = _filtered(gyro[a:b], taps), _filtered(accel[a:b], taps)
    return replace(imu, gyro=gyro, accel=accel)


def _vibrates(values: Array, dt: float, sigma: float) -> bool:
    """Whether samples (N, 3) have more above the frequency than their noise, all the time."""
    half = round(_FILTER / dt)
    if _GOES_ON * 2 * half > values.shape[0]:
        return False
    passed = -_low_pass(half, dt)
    passed[half] += 1.0
    fast = _filtered(values, passed)
    by_noise = sigma**2 * float(passed @ passed)
    chance = 1.25 * by_noise * np.sqrt(2.0 / values.size)
    # A step is fast only for a short time.
    power = float(np.median(block_means(np.mean(fast**2, axis=1), 2 * half)))
    return power > by_noise + _SURE * chance + _LEAK**2 * float(np.mean(values**2))


def _low_pass(half: int, dt: float) -> Array:
    """Return the weights of a filter without delay: a sinc in Blackman's window."""
    taps = np.sinc(2.0 * _VIBRATION * dt * np.arange(-half, half + 1)) * np.blackman(2 * half + 1)
    return np.asarray(taps / taps.sum())


def _filtered(values: Array, taps: Array) -> Array:
    """Return filtered samples (N, 3); beyond both ends they go on about the line that is there."""
    half = taps.size // 2
    before, after = _beyond(values[: half + 1], half), _beyond(values[: -half - 2 : -1], half)
    whole = np.concatenate([before[::-1], values, after])
    return np.asarray(correlate1d(whole, taps, axis=0)[half:-half])


def _beyond(first: Array, count: int) -> Array:
    """Return samples before the first ones (count + 1, 3), the nearest one first."""
    at = np.arange(count + 1)
    slope = np.polyfit(at, first, 1)[0]
    # What is not the line is mirrored, so that it goes on as it is.
    return np.asarray(first[1:] - 2.0 * at[1:, None] * slope)
