"""White noise of an IMU from the high frequencies of its own record: an upper bound."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.signal import welch

from factorgraph_dvl.geometry.units import DEG_PER_SQRT_HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.finding import Code, Finding
from factorgraph_dvl.sensors.imu import Imu

# Chosen: samples to a spectrum, and the window, whose side lobes are 180 dB down: sway of
# 1 rad/s leaks less than the quietest gyro's noise into the bands.
_SAMPLES = 256
_WINDOW = ("kaiser", 24.0)
# Chosen: of fewer samples the bound is more than 5 % too low by chance.
_LEAST_SAMPLES = 4000
# Bands from this share of the rate up to the last but one bin, and their number.
_FROM = 0.1
_BANDS = 4
# The window leaves little of the ends of a stretch: stretches begin at every fourth of one.
_OVERLAP = 192
# Relative spread of the intervals up to which the spectrum of the samples is that of the signal.
_REGULAR = 1e-3
_LOST = 1.5
# Chosen: noise that is larger than stated by less than this leaves every σ as good as it was.
# Of the scenarios' records of 15,000 samples or more it is 0.98 to 1.02 of the stated one.
_LARGER = 1.1


class WhiteNoise(NamedTuple):
    """Upper bounds of the noise of gyros and accelerometers, rad/√s and m/s/√s."""

    gyro: float
    accel: float


def white_noise(imu: Imu) -> WhiteNoise | None:
    """Return upper bounds of the white noise, None where the record does not show it.

    White noise is at all frequencies, so it is at most the lowest density of any band; motion
    and vibration are in some bands only. Density: median over spectra of stretches (Welch
    1967; that leaves out jerks), mean over the axes, median over a band (that leaves out lines).

    Parameters
    ----------
    imu : Imu
        A record, of which the longest stretch without gaps is used.
    """
    step = np.diff(imu.time)
    dt = float(np.median(step)) if step.size else np.inf
    breaks = np.concatenate([[0], np.flatnonzero(step > _LOST * dt) + 1, [imu.time.size]])
    longest = int(np.argmax(np.diff(breaks)))
    part = slice(breaks[longest], breaks[longest + 1])
    inner = step[breaks[longest] : breaks[longest + 1] - 1]
    if inner.size < _LEAST_SAMPLES:
        return None
    if np.quantile(np.abs(inner / dt - 1.0), 0.99) > _REGULAR:
        return None
    return WhiteNoise(_lowest(imu.gyro[part], dt), _lowest(imu.accel[part], dt))


def with_recorded_noise(imu: Imu) -> tuple[Imu, tuple[Finding, ...]]:
    """Return an IMU whose stated noise is at least that of its record, and what was found.

    Parameters
    ----------
    imu : Imu
        With stated noise; where the record's bound is larger, it takes its place.
    """
    found = white_noise(imu)
    if found is None:
        return imu, ()
    changes: dict[str, float] = {}
    findings: list[Finding] = []
    for name, value, stated, (si, unit, key) in (
        (
            "gyros",
            found.gyro,
            imu.settings.gyro_noise_root_psd,
            (DEG_PER_SQRT_HOUR, "deg/√h", "gyro_noise_deg_sqrt_h"),
        ),
        (
            "accelerometers",
            found.accel,
            imu.settings.accel_noise_root_psd,
            (MICRO_G, "µg/√Hz", "accel_noise_ug_sqrt_hz"),
        ),
    ):
        if value > _LARGER * stated:
            changes[key] = value / si
            findings.append(
                Finding(
                    Code.IMU_NOISE,
                    f"the noise of the {name} is {value / stated:.2g} times the stated one by the "
                    f"high frequencies of the record, and {value / si:.3g} {unit} was used; "
                    f"state it as `{key}`, or `noise: stated` if the record only vibrates",
                    sensor="IMU",
                )
            )
    if not changes:
        return imu, ()
    return replace(imu, settings=msgspec.structs.replace(imu.settings, **changes)), tuple(findings)


def _lowest(samples: Array, dt: float) -> float:
    frequency, density = welch(
        samples,
        1.0 / dt,
        window=_WINDOW,
        nperseg=_SAMPLES,
        noverlap=_OVERLAP,
        average="median",
        axis=0,
    )
    inside = (frequency * dt >= _FROM) & (frequency * dt < 0.5 - 1.5 / _SAMPLES)
    bands = np.array_split(density[inside].mean(axis=1), _BANDS)
    # The density is one-sided.
    return float(np.sqrt(0.5 * min(float(np.median(band)) for band in bands)))
