"""Initial attitude from a sensor that measures it, its mounting from the gyros if need be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import best_rotation, exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.dead_reckoned_spans import DeadReckonedSpan
from factorgraph_dvl.sensors.protocol import AttitudeAid, Attitudes
from factorgraph_dvl.trial import Trial

# Prior standard deviation up to which a mounting is taken as it stands. Chosen: the solver
# converges from there.
_KNOWN = 5.0 * DEG
# Turns over these intervals, s, are compared with the gyros'. Chosen: from sway to slow turns.
_LAGS = (1.0, 3.0, 10.0)
# Root mean square about the second axis, rad, from which on turns determine a mounting. Chosen:
# above the noise of a star tracker.
_LEAST_TURN = 0.2 * DEG
# The longest turn that is used, rad. Chosen: below half a turn, which has no single axis.
_LONGEST_TURN = 2.5


def attitudes(trial: Trial, frame: LocalFrame) -> tuple[Attitudes, ...]:
    """Return what the sensors of attitude measured."""
    found = (aid.attitudes(frame) for aid in trial.aids if isinstance(aid, AttitudeAid))
    return tuple(seen for seen in found if seen.time.size)


def mean_mounting(seen: Attitudes, nRb: Array) -> Array:
    """Return the mean of nRsᵀ nRb, (3, 3): the mounting sRb by attitudes (M, 3, 3) there."""
    return best_rotation(np.sum(seen.nRs.transpose(0, 2, 1) @ nRb, axis=0))


def known_mountings(
    trial: Trial, frame: LocalFrame, arcs: Sequence[DeadReckonedSpan]
) -> dict[str, Array]:
    """Return sRb of the sensors of attitude by name: by the prior, else by the gyros.

    A turn between two samples is the same for sensor and gyros, but for the axes:
    Log(nRsⱼᵀ nRsₖ) = sRb Log(ΔR), in axes kept in space. Wahba's problem, which two axes of
    rotation solve.
    """
    out = {}
    for seen in attitudes(trial, frame):
        name, prior = seen.mounting.name, seen.mounting
        if prior.sigma.max() <= _KNOWN:
            out[name] = exp_so3(prior.mean)
            continue
        ours, theirs = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for arc in arcs:
            use = arc.covers(seen.time)
            if use.sum() < 2:
                continue
            time = seen.time[use]
            space = arc.to_space(time) @ seen.nRs[use]
            body = arc.carry(time)[1]
            for step in _LAGS:
                later = np.searchsorted(time, time + step)
                k = np.flatnonzero(later < time.size)
                j = later[k]
                ours.append(log_so3(body[k].transpose(0, 2, 1) @ body[j]))
                theirs.append(log_so3(space[k].transpose(0, 2, 1) @ space[j]))
        turns = np.concatenate(ours)
        # Half turns and more have no single axis.
        small = np.linalg.norm(turns, axis=1) < _LONGEST_TURN
        moments = np.concatenate(theirs)[small].T @ turns[small]
        second = np.linalg.svd(moments, compute_uv=False)[1] / max(small.sum(), 1)
        if np.sqrt(second) > _LEAST_TURN:
            out[name] = best_rotation(moments)
    return out


def attitude_at_start(
    trial: Trial, frame: LocalFrame, arc: DeadReckonedSpan, mountings: dict[str, Array]
) -> Array | None:
    """Return the attitude at the start, (K, 3, 3), as each node sees it by the next measured one.

    None if no attitude was measured in the arc by a sensor of known mounting.
    """
    for seen in attitudes(trial, frame):
        use = arc.covers(seen.time)
        if seen.mounting.name in mountings and use.any():
            time = seen.time[use]
            nRb = seen.nRs[use] @ mountings[seen.mounting.name]
            at_start = arc.to_space(time) @ nRb @ arc.carry(time)[1].transpose(0, 2, 1)
            right = np.clip(np.searchsorted(time, arc.start + arc.since), 0, time.size - 1)
            return np.asarray(at_start[right])
    return None
