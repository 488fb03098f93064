"""The clock of an IMU: stamps that were rounded, samples that were lost."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.conventions import Array


def fill_lost(
    time: Array, samples: Array, lost: np.ndarray, bridged: np.ndarray, broken: np.ndarray
) -> tuple[Array, Array, Array, np.ndarray]:
    """Interpolate short runs of lost samples, with the standard deviation to expect."""
    add_time, add_samples, add_sigma, at = [], [], [], []
    for i in np.flatnonzero(bridged).tolist():
        n = int(lost[i])
        a, b = max(i - 2, 0), min(i + 4, time.size)
        new = time[i] + (time[i + 1] - time[i]) * np.arange(1, n + 1) / (n + 1)
        local = (time[a:b] - time[i]) / (time[i + 1] - time[i])
        degree = min(3, b - a - 1)
        fit = np.polyfit(local, samples[a:b], degree)
        u = (new - time[i]) / (time[i + 1] - time[i])
        value = np.stack([np.polyval(fit[:, k], u) for k in range(6)], axis=1)
        straight = samples[i] + u[:, None] * (samples[i + 1] - samples[i])
        add_time.append(new)
        add_samples.append(value)
        add_sigma.append(np.abs(value - straight))
        at.append(np.full(n, i + 1))
    where = np.concatenate(at)
    out_broken = np.insert(broken, where - 1, False)
    return (
        np.insert(time, where, np.concatenate(add_time)),
        np.insert(samples, where, np.concatenate(add_samples), axis=0),
        np.insert(np.zeros_like(samples), where, np.concatenate(add_sigma), axis=0),
        out_broken,
    )


def unrounded(time: Array) -> Array:
    """Return times since the first, regular where only rounding makes them irregular.

    At 128 Hz a stamp in milliseconds is wrong by up to 6 % of the interval, and in a roll
    of 50 deg/s a mean over the wrong interval by 0.02 deg. Times that a straight line fits
    to within the last decimal (or the last bit) that they are written with lie on it.
    """
    count = np.arange(time.size) - 0.5 * (time.size - 1)
    since = time - time[0]
    slope = float(count @ since) / float(count @ count)
    line = since.mean() + slope * count
    quantum = float(np.spacing(np.abs(time).max()))
    for decimals in range(1, 7):
        unit = 10.0**-decimals
        if unit < 0.5 * slope and np.all(np.abs(since / unit - np.rint(since / unit)) < 1e-3):
            quantum = max(quantum, unit)
    # A fitted line may be off by as much as the rounding itself.
    return line if np.abs(since - line).max() <= quantum else since
