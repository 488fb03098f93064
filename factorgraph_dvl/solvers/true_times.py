"""The motion at true times of a chain whose nodes have the clocks of sensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.records import concatenated
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.graph.trajectory import between, epochs_between, reported
from factorgraph_dvl.solvers.posterior import Posterior, of_states

# Epochs whose covariances are computed at once. Chosen: some ten megabytes.
_CHUNK = 4096
# Rows of a state that are of the attitude, and those that are not.
_ATTITUDE, _OTHERS = slice(0, 3), slice(3, 9)


def covariances_at_true_times(
    problem: Problem, evaluation: Evaluation, covariances: Posterior
) -> Array:
    """Return the covariances of the states of nodes where the true times are exact, (K, 3, 3, 3).

    Of attitude, position and velocity in n. At a true time is what the nodes have later by the
    offset of their clock: there the motion errs by what it changes in the error of the offset too.
    """
    chain, states = problem.chain, evaluation.states
    acceleration = np.gradient(states.v_n, chain.node_time, axis=0)
    moved = np.hstack([states.omega_b, states.v_n, acceleration])
    with_parameters = of_states(chain, covariances.with_parameters)
    by_clocks = np.zeros((chain.node_time.size, 9, len(problem.prior_root)))
    for clock, rows in ((chain.attitude_clock, _ATTITUDE), (chain.clock, _OTHERS)):
        if clock in problem.columns:
            own = problem.prior_root[problem.columns[clock]][0]
            by_clocks[:, rows] = moved[:, rows, None] * own
    cross = with_parameters @ by_clocks.transpose(0, 2, 1)
    P = covariances.nodes + cross + cross.transpose(0, 2, 1)
    P += by_clocks @ covariances.parameters @ by_clocks.transpose(0, 2, 1)
    own = (slice(i, i + 3) for i in range(0, 9, 3))
    out = np.stack([P[:, rows, rows] for rows in own], axis=1)
    # Attitudes turn in axes of the body.
    out[:, 0] = states.nRb @ out[:, 0] @ states.nRb.transpose(0, 2, 1)
    return out


def known_span(chain: SmoothChain, values: Mapping[str, Array]) -> tuple[float, float]:
    """Return the true times from which on and up to which the motion is known, s.

    Positions are known up to the last node but one, attitudes up to the last.
    """
    turned = chain.attitude_time[[0, -1]] - chain.shift(values)
    first = max(float(chain.node_time[0]), float(turned[0]))
    last = min(float(chain.node_time[-2]), float(turned[1]))
    lag = nodes_late(chain, values)
    return first - lag, last - lag


def nodes_late(chain: SmoothChain, values: Mapping[str, Array]) -> float:
    """Return the times of the nodes less true times, s."""
    return 0.0 if chain.clock is None else float(values[chain.clock][0])


def trajectory_at_true_times(
    problem: Problem,
    evaluation: Evaluation,
    covariances: Posterior,
    body_axes: BodyAxes,
    rate_hz: float,
) -> Trajectory:
    """Return the motion at a rate, with its covariance, at most at that of the densest record.

    Parameters
    ----------
    problem : Problem
        Problem of a chain without IMU.
    evaluation : Evaluation
        Its minimum.
    covariances : Posterior
        There.
    body_axes : BodyAxes
        Axes of the body.
    rate_hz : float
        Epochs in a second.
    """
    chain = problem.chain
    assert isinstance(chain, SmoothChain)
    time = epochs_at_most(chain, *known_span(chain, evaluation.parameters), rate_hz)
    P = covariances_at_true_times(problem, evaluation, covariances)
    return motion_at_true_times(chain, evaluation, P, body_axes, time)


def epochs_at_most(chain: SmoothChain, first: float, last: float, rate_hz: float) -> Array:
    """Return the epochs after a time and up to another, s, at a rate that the record has."""
    rate_hz = min(rate_hz, 1.0 / chain.resolution if chain.resolution else rate_hz)
    return epochs_between(first, last, rate_hz)


def motion_at_true_times(
    chain: SmoothChain, evaluation: Evaluation, P: Array, body_axes: BodyAxes, time: Array
) -> Trajectory:
    """Return the motion at times (M,), s, by `covariances_at_true_times` P (K, 3, 3, 3)."""
    values, states = evaluation.parameters, evaluation.states
    lag, shift = nodes_late(chain, values), chain.shift(values)
    parts = []
    for i in range(0, max(time.size, 1), _CHUNK):
        some = time[i : i + _CHUNK]
        at = chain.attach(some + lag, shift)
        motion = chain.transition(at, states)
        covariance = np.concatenate(
            [
                between(part, place.node, np.clip(place.tau / place.span, 0.0, 1.0))
                for part, place in ((P[:, :1], at.turned), (P[:, 1:], at.place))
            ],
            axis=1,
        )
        covariance += motion.missing(chain.density, chain.nRt)
        parts.append(reported(some, motion.motion, covariance, chain.frame, body_axes))
    return parts[0] if len(parts) == 1 else concatenated(parts)
