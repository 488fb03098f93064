"""Clocks of DVL and attitude against that of positions, from what their records have in common.

A DVL that is late sees turns and changes of speed late, and so does a compass. The velocity that a
DVL should see, v_d = M v_b + N omega + beta, is linear in unknown matrices, and what it misses is
least where the records belong together (Kelly and Sukhatme, A general framework for temporal
calibration of multiple proprioceptive and exteroceptive sensors, ISER 2010).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion

# Steps of the search, s, coarse then fine, and its reach in standard deviations of the prior.
# Chosen: each finds the minimum that the next refines.
_STEPS = (0.5, 0.1, 0.02)
_REACH_SIGMAS = 3.0
# Pings whose misfit counts as one. Chosen: what is slow in it lasts for seconds.
_TOGETHER = 10.0

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
        Of the pings, in axes of the DVL.
    motion_at : callable
        Returns the motion at true times (M,), s, if stamps of the attitude are late by so many
        seconds, and at which of them it is known.
    dvl_clock, attitude_clock : Parameter
        Time offsets with their priors.
    current : bool
        Whether the velocities are through water that moves.
    """
    clocks = (dvl_clock, attitude_clock)
    lags = [float(p.mean[0]) for p in clocks]

    def misfit(trial: list[float]) -> float:
        motion, known = motion_at(time - trial[0], trial[1])
        return _misfit(motion, velocity, known, current=current)

    for step in _STEPS:
        for i, p in enumerate(clocks):
            if not p.estimated:
                continue
            sigma = float(p.sigma[0])
            reach = _REACH_SIGMAS * sigma if step == _STEPS[0] else 5.0 * step
            count = max(int(np.ceil(reach / step)), 1)
            grid = lags[i] + step * np.arange(-count, count + 1)
            costs = []
            for lag in grid:
                off = (lag - float(p.mean[0])) / sigma
                costs.append(misfit([lag if j == i else lags[j] for j in range(2)]) + 0.5 * off**2)
            lags[i] = float(grid[int(np.argmin(costs))])
    return lags[0], lags[1]


def _misfit(motion: Motion, velocity: Array, known: np.ndarray, *, current: bool) -> float:
    """Return the negative log-likelihood of velocities with the best M, N and beta."""
    if known.sum() < 30:
        return np.inf
    bRn = motion.nRb[known].transpose(0, 2, 1)
    columns = [rotate(bRn, motion.v_n[known]), motion.omega_eb_b[known], np.ones((known.sum(), 1))]
    if current:
        columns += [bRn[:, :, 0], bRn[:, :, 1]]
    x, y = np.hstack(columns), velocity[known]
    beyond = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    variance = np.mean(beyond**2, axis=0) + 1e-12
    return 0.5 * known.sum() / _TOGETHER * float(np.sum(np.log(variance)))
