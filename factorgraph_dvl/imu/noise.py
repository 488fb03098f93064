"""White noise of an IMU from the high frequencies of its own record: an upper bound."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from factorgraph_dvl.geometry.units import DEG_PER_SQRT_HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

# Chosen: samples to a spectrum, and the window, whose side lobes are 180 dB down: sway of
# 1 rad/s leaks less than the quietest gyro's noise into the bands.
_SAMPLES = 256
_WINDOW = np.kaiser(_SAMPLES + 1, 24.0)[:-1]
# Chosen: of fewer samples the bound is more than 5 % too low by chance.
_LEAST_SAMPLES = 4000
# Bands from this share of the rate up to the last but one bin, and their number. Chosen: above
# the motion of vessels at 20 Hz and more.
_FROM = 0.1
_BANDS = 4
# The window leaves little of the ends of a stretch: stretches begin at every fourth of one.
_APART = 64
# Stretches of a first look, and the excess over the stated noise below which it is enough. Chosen:
# their noise is known to 1 %.
FIRST_LOOK = 600
_CLEARLY_LESS = 1.05
# Stretches that are transformed at once. Chosen: some MB.
_BLOCK = 1024
# Relative spread of the intervals up to which the spectrum of the samples is that of the signal,
# and intervals from which on samples are lost. Chosen: stamps in 10 µs at 100 Hz; half-way.
_REGULAR = 1e-3
_LOST = 1.5
# Chosen: noise that is larger than stated by less than this leaves every σ as good as it was.
# Of the scenarios' records of 15,000 samples or more it is 0.98 to 1.02 of the stated one.
_LARGER = 1.1
# Keys of the settings, with their units, of gyros and accelerometers.
_KEYS = {
    "gyro_noise_deg_sqrt_h": (DEG_PER_SQRT_HOUR, "deg/√h"),
    "accel_noise_ug_sqrt_hz": (MICRO_G, "µg/√Hz"),
}


class WhiteNoise(NamedTuple):
    """Upper bounds of the noise of gyros and accelerometers, rad/√s and m/s/√s."""

    gyro: float
    accel: float


def white_noise(imu: Imu, *, stretches: int | None = None) -> WhiteNoise | None:
    """Return upper bounds of the white noise, None where the record does not show it.

    White noise is at all frequencies, so it is at most the lowest density of any band; motion
    and vibration are in some bands only. Density: median over spectra of stretches (Welch
    1967; that leaves out jerks), mean over the axes, median over a band (that leaves out lines).

    Parameters
    ----------
    imu : Imu
        A record, of which the longest part without gaps is used.
    stretches : int, optional
        About how many of its stretches are looked at; all by default.
    """
    _, part, dt, regular = unbroken_parts(imu.time)
    inner = part.stop - part.start - 1
    if inner < _LEAST_SAMPLES or not regular:
        return None
    every = 1 if stretches is None else max(inner // _APART // stretches, 1)
    return WhiteNoise(_lowest(imu.gyro[part], dt, every), _lowest(imu.accel[part], dt, every))


class UnbrokenParts(NamedTuple):
    """Parts of a record without gaps, and how samples follow.

    Parameters
    ----------
    edges : ndarray of int, shape (P + 1,)
        First sample of each part, and the number of samples.
    longest : slice
        Samples of the longest part.
    interval : float, s
        Usual interval of the samples, infinite where there is only one.
    regular : bool
        Whether samples of the longest part follow at that interval.
    """

    edges: IntArray
    longest: slice
    interval: float
    regular: bool


def unbroken_parts(time: Array) -> UnbrokenParts:
    """Return the parts without gaps of samples at times (N,), s."""
    step = np.diff(time)
    dt = float(np.median(step)) if step.size else np.inf
    edges = np.concatenate([[0], np.flatnonzero(step > _LOST * dt) + 1, [time.size]])
    first = int(np.argmax(np.diff(edges)))
    longest = slice(int(edges[first]), int(edges[first + 1]))
    inner = step[longest.start : longest.stop - 1]
    unlike = np.quantile(np.abs(inner / dt - 1.0), 0.99) if inner.size else np.inf
    return UnbrokenParts(edges, longest, dt, bool(unlike <= _REGULAR))


def with_recorded_noise(imu: Imu) -> Imu:
    """Return an IMU whose noise is at least that of its record.

    Parameters
    ----------
    imu : Imu
        IMU with stated noise; where the record's bound is larger, it takes its place.
    """
    stated = (imu.settings.gyro_noise_root_psd, imu.settings.accel_noise_root_psd)
    found = white_noise(imu, stretches=FIRST_LOOK)
    if found is None or all(f < _CLEARLY_LESS * s for f, s in zip(found, stated, strict=True)):
        return imu
    found = white_noise(imu)
    assert found is not None
    changes = {
        key: value / si
        for (key, (si, _)), value, claimed in zip(_KEYS.items(), found, stated, strict=True)
        if value > _LARGER * claimed
    }
    if not changes:
        return imu
    return replace(imu, settings=msgspec.structs.replace(imu.settings, **changes))


def noise_findings(stated: ImuSettings, used: ImuSettings) -> tuple[Finding, ...]:
    """Return what the user must know where the noise of an IMU is larger than stated."""
    findings = []
    for key, (_, unit) in _KEYS.items():
        value, claimed = getattr(used, key), getattr(stated, key)
        if value > _LARGER * claimed:
            text = "imu_noise.gyros" if key.startswith("gyro") else "imu_noise.accelerometers"
            said = message(text, ratio=value / claimed, value=value, unit=unit, name=key)
            findings.append(Finding(Code.IMU_NOISE, said, sensor="IMU"))
    return tuple(findings)


def _lowest(samples: Array, dt: float, every: int) -> float:
    """Return the root of the lowest two-sided density of any band."""
    stretches = sliding_window_view(samples, _SAMPLES, axis=0)[:: _APART * every]
    powers = []
    for i in range(0, stretches.shape[0], _BLOCK):
        block = stretches[i : i + _BLOCK]
        spectrum = np.fft.rfft((block - block.mean(axis=-1, keepdims=True)) * _WINDOW)
        powers.append(spectrum.real**2 + spectrum.imag**2)
    power = np.concatenate(powers)
    # The median of as many exponential variables, of mean 1 (Allen et al. 2012, appendix B).
    twice = 2.0 * np.arange(1, (power.shape[0] - 1) // 2 + 1)
    median = 1.0 + np.sum(1.0 / (twice + 1.0) - 1.0 / twice)
    density = np.median(power, axis=0) * dt / np.sum(_WINDOW**2) / median
    cycles = np.fft.rfftfreq(_SAMPLES)
    inside = (cycles >= _FROM) & (cycles < 0.5 - 1.5 / _SAMPLES)
    bands = np.array_split(density[:, inside].mean(axis=0), _BANDS)
    return float(np.sqrt(min(float(np.median(band)) for band in bands)))
