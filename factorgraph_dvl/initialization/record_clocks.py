"""Clocks of DVL and attitude against that of positions, from what their records have in common.

A DVL that is late sees turns and changes of speed late, and so does a compass. The velocity that a
DVL should see, v_d = M v_b + N omega + beta, is linear in unknown matrices, and what it misses is
least where the records belong together (Kelly and Sukhatme, A general framework for temporal
calibration of multiple proprioceptive and exteroceptive sensors, ISER 2010).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion

# Steps of the search, s, coarse then fine, and its reach in standard deviations of the prior.
# Chosen: each finds the minimum that the next refines.
_STEPS = (0.5, 0.1, 0.02)
_REACH_SIGMAS = 3.0
# Pings whose misfit counts as one. Chosen: what is slow in it lasts for seconds.
_TOGETHER = 10.0
# Pings without which there is no misfit, and the time, s, for which a current counts as constant.
# Chosen: with a line and a turn of a ship in it, well below the hour in which tides change.
_LEAST_PINGS = 30
_SAME_CURRENT = 900.0

MotionAt = Callable[[Array, float], tuple[Motion, np.ndarray]]


def clock_lags(
    time: Array,
    velocity: Array,
    motion_at: MotionAt,
    dvl_clock: Parameter,
    attitude_clock: Parameter,
    *,
    current: bool,
) -> tuple[float, float]:
    """Return the time offsets of DVL and attitude, s, that make the records agree best.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Stamps of pings.
    velocity : ndarray, shape (M, 3), m/s
        Velocity of the pings, in axes of the DVL.
    motion_at : callable
        Returns the motion at true times (M,), s, if stamps of the attitude are late by so many
        seconds, and at which of them it is known.
    dvl_clock, attitude_clock : Parameter
        Time offsets with their priors.
    current : bool
        Whether the velocities are through water that moves.
    """
    clocks = (dvl_clock, attitude_clock)
    means, sigmas = (np.concatenate([getattr(p, n) for p in clocks]) for n in ("mean", "sigma"))
    shared, relative = 0.0, attitude_clock.relative
    if relative is not None and relative.to == dvl_clock.name:
        # Of one instrument: what is searched is by how much its attitudes are late beside pings.
        shared, sigmas[1] = 1.0, relative.sigma
        means[1] -= means[0]

    def misfit(lags: Array) -> float:
        motion, known = motion_at(time - lags[0], lags[1] + shared * lags[0])
        if known.sum() < _LEAST_PINGS:
            return np.inf
        fit = (
            _misfit_through_water(time, motion, velocity, known)
            if current
            else _misfit(motion, velocity, known)
        )
        off = (lags - means)[sigmas > 0.0] / sigmas[sigmas > 0.0]
        return fit + 0.5 * float(off @ off)

    lags = means
    for step in _STEPS:
        for i in np.flatnonzero(sigmas):
            reach = _REACH_SIGMAS * sigmas[i] if step == _STEPS[0] else 5.0 * step
            count = max(int(np.ceil(reach / step)), 1)
            along = step * np.eye(2)[i]
            tried = [lags + k * along for k in range(-count, count + 1)]
            lags = tried[int(np.argmin([misfit(each) for each in tried]))]
    return float(lags[0]), float(lags[1] + shared * lags[0])


def _misfit(motion: Motion, velocity: Array, known: np.ndarray) -> float:
    """Return the negative log-likelihood of velocities with the best M, N and beta."""
    bRn = motion.nRb[known].transpose(0, 2, 1)
    columns = [rotate(bRn, motion.v_n[known]), motion.omega_eb_b[known], np.ones((known.sum(), 1))]
    x, y = np.hstack(columns), velocity[known]
    beyond = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return _negative_log_likelihood(beyond)


def _misfit_through_water(
    time: Array, motion: Motion, velocity: Array, known: np.ndarray
) -> float:
    """Return the negative log-likelihood of velocities over ground with the best A, l and c.

    v_n = nRb (A v_d - omega x l) + c. The current c is constant for some minutes only: with one
    current for twelve hours, clocks 1.8 s off made up for residuals of 0.3 m/s. Velocities over
    ground are noisier than those of a DVL: on the other side of the equation, their noise would
    make A too small.
    """
    nRb = motion.nRb[known]
    through_water = nRb[:, :, :, None] * velocity[known][:, None, None, :]
    by_arm = nRb @ skew(motion.omega_eb_b[known])
    x = np.concatenate([through_water.reshape(-1, 3, 9), by_arm], axis=2)
    every = np.concatenate([x, motion.v_n[known][:, :, None]], axis=2)
    _, span, count = np.unique(
        (time[known] - time[0]) // _SAME_CURRENT, return_inverse=True, return_counts=True
    )
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    every -= (np.add.reduceat(every, starts, axis=0) / count[:, None, None])[span]
    sigma = np.ones(3)
    for _ in range(2):
        whitened = (every / sigma[:, None]).reshape(-1, every.shape[2])
        best = np.linalg.lstsq(whitened[:, :-1], whitened[:, -1], rcond=None)[0]
        beyond = every[:, :, -1] - every[:, :, :-1] @ best
        sigma = np.sqrt(np.mean(beyond**2, axis=0) + 1e-12)
    return _negative_log_likelihood(beyond)


def _negative_log_likelihood(residuals: Array) -> float:
    """Return that of normal residuals (M, d) whose variances are their own."""
    variance = np.mean(residuals**2, axis=0) + 1e-12
    return 0.5 * len(residuals) / _TOGETHER * float(np.sum(np.log(variance)))
