"""The clock of an IMU: stamps that were rounded, samples that were lost, clocks that jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.trial import Trial

# Step of the time, s, from which on the clock was set. Chosen: no IMU rests for an hour.
JUMP = 3600.0


def without_restarted_clock(trial: Trial) -> Trial:
    """Return a trial without what its IMU recorded by another clock than all other sensors.

    A logger that starts at 0 and takes GPS time later stamps its first samples by a clock of
    their own. Stretches before and after such a jump stay where other sensors measured.
    """
    time = trial.inertial.time
    edges = np.concatenate([[0], np.flatnonzero(np.diff(time) > JUMP) + 1, [time.size]])
    if edges.size == 2:
        return trial
    aids = [aid.time[np.logical_not(aid.missing)] for aid in trial.aids]
    measured = np.sort(np.concatenate([np.empty(0), *aids]))
    first, last = time[edges[:-1]], time[edges[1:] - 1]
    kept = np.searchsorted(measured, last, "right") > np.searchsorted(measured, first)
    if kept.all() or not kept.any():
        return trial
    notes = tuple(
        Finding(
            Code.CLOCK_RESTARTED,
            message("clock_restarted.alone", start=a, end=b, samples=n),
            sensor="IMU",
        )
        for a, b, n in zip(first[~kept], last[~kept], np.diff(edges)[~kept], strict=True)
    )
    rows = np.repeat(kept, np.diff(edges))
    return replace(trial, imu=rows_of(trial.inertial, rows), notes=(*trial.notes, *notes))


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


def unrounded(time: Array, number: Array | None = None) -> Array:
    """Return times since the first, regular where only rounding makes them irregular.

    At 128 Hz a stamp in milliseconds is wrong by up to 6 % of the interval, and in a roll
    of 50 deg/s a mean over the wrong interval by 0.02 deg. Times that a straight line fits
    to within the last decimal (or the last bit) that they are written with lie on it.

    Parameters
    ----------
    time : ndarray, shape (N,), s
        Stamps of the samples.
    number : ndarray, shape (N,), optional
        Number of the samples, lost ones counted; None = none was lost.
    """
    count = np.arange(time.size) if number is None else number
    count = count - count.mean()
    since = time - time[0]
    slope = float(count @ since) / float(count @ count)
    line = since.mean() + slope * count
    quantum = float(np.spacing(max(abs(time[0]), abs(time[-1]))))
    for decimals in range(1, 7):
        unit = 10.0**-decimals
        if unit >= 0.5 * slope:
            continue
        scaled = since / unit
        if np.abs(scaled - np.rint(scaled)).max() < 1e-3:
            quantum = max(quantum, unit)
            break
    # A fitted line may be off by as much as the rounding itself.
    return line if np.abs(since - line).max() <= quantum else since
