"""Fixed-lag smoothing without IMU: the nodes of the last seconds, and what came before."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.graph.bordered_chain import Covariances, Factorisation, NormalEquations
from factorgraph_dvl.graph.motion_chain import MotionChain
from factorgraph_dvl.graph.motion_problem import MotionEvaluation, MotionProblem
from factorgraph_dvl.graph.priors import after_step
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.sensors.protocol import Observation

# Probability with which a good measurement passes the gate; chosen: 6 standard deviations of one
# component, as of a replay with an IMU.
_PASSES = 2e-9
# Searches for measurements beyond the gate, and least share of the largest square among those that
# one rejects; chosen: errors of one kind that differ by less are alike.
_SEARCHES, _WORST = 4, 0.25
# Share of a kind's measurements beyond the gate from which on it contradicts the prediction;
# chosen, as of a replay with an IMU.
_CONTRADICTS = 0.3


@dataclass(frozen=True)
class Known:
    """What is known of one node and the constants by all that came before the node.

    Parameters
    ----------
    equations : NormalEquations
        Of that node alone.
    state : ndarray, shape (n,)
        Where they were linearised.
    values : dict of str to ndarray
        The parameters there.
    """

    equations: NormalEquations
    state: Array
    values: dict[str, Array]


class WindowProblem(MotionProblem):
    """Problem of the last nodes, whose prior is what was known before the first of them.

    Parameters
    ----------
    whole : MotionProblem
        Of the records so far, with noise and the strength of the prior as they were found.
    known : Known
        At the first node.
    chain : MotionChain
        Nodes of the window.
    attitude : AttitudeRecord
        How the body points in it.
    observations : sequence of Observation
        Measurements in it.
    states : ndarray, shape (K, n)
        Near the solution.
    slope : ndarray, shape (c,)
        What `MotionProblem.slope` gains in the window.
    """

    def __init__(
        self,
        whole: MotionProblem,
        known: Known,
        chain: MotionChain,
        attitude: AttitudeRecord,
        observations: Sequence[Observation],
        states: Array,
        slope: Array,
    ) -> None:
        super().__init__(
            chain, whole.frame, attitude, observations, whole.all_parameters, states, whole.clock
        )
        self.zero = whole.zero
        self.noise_factors = whole.noise_factors
        self.slope = slope
        self._known = known

    def _without_motion(self, evaluation: MotionEvaluation) -> NormalEquations:
        out, known = self.measured(evaluation), self._known.equations
        by_state = evaluation.states[0] - self._known.state
        by_constants = self.coordinates(self._known.values, evaluation.parameters)
        out.diagonal[0] += known.diagonal[0]
        out.border[0] += known.border[0]
        out.corner += known.corner
        out.node_gradient[0] += known.node_gradient[0]
        out.node_gradient[0] += known.diagonal[0] @ by_state + known.border[0] @ by_constants
        out.constant_gradient += known.constant_gradient
        out.constant_gradient += known.corner @ by_constants + by_state @ known.border[0]
        return out

    def _add_first(self, equations: NormalEquations, states: Array) -> float:
        return 0.0


@dataclass(frozen=True)
class SmoothedWindow:
    """A window after a step of its nodes and the constants.

    Parameters
    ----------
    problem : MotionProblem
        With the measurements that are left out.
    evaluation : MotionEvaluation
        Where the step ended.
    covariances : Covariances
        Of nodes and constants.
    inconsistent : tuple of str
        Kinds of measurements that contradict the others.
    """

    problem: MotionProblem
    evaluation: MotionEvaluation
    covariances: Covariances
    inconsistent: tuple[str, ...] = ()

    def known_before(self, node: int) -> Known:
        """Return what is known of a node by all that came before it."""
        at = self.evaluation
        return Known(self.problem.known_before(at, node), at.states[node], at.parameters)


def smooth_window(
    problem: WindowProblem, states: Array, values: dict[str, Array]
) -> SmoothedWindow:
    """Return a window after a Gauss-Newton step, without measurements beyond the gate.

    One step is enough: states are linear, constants hardly move from one window to the next, and
    all is linearised anew in the next one.

    Raises
    ------
    SolveError
        If no step is possible.
    """
    for _ in range(_SEARCHES):
        found = _step(problem, states, values)
        further = _worst(problem, found)
        if not further:
            break
        problem = copy(problem)
        before = problem.rejected
        problem.rejected = {**before, **{k: v | before.get(k, False) for k, v in further.items()}}
    return replace(found, inconsistent=_inconsistent(problem))


def _step(problem: WindowProblem, states: Array, values: dict[str, Array]) -> SmoothedWindow:
    equations = problem.equations(problem.weighed(states, values))
    try:
        factors: Factorisation = equations.factorise()
    except np.linalg.LinAlgError:
        raise SolveError(
            "the information is not positive definite",
            where="replay",
            hint="Inspect the trial: standard deviations may differ by too many digits",
        ) from None
    dx, dc = factors.step()
    after = problem.evaluate(states + dx, after_step(problem.parameters, values, dc))
    return SmoothedWindow(problem, after, factors.covariances())


def _worst(problem: WindowProblem, found: SmoothedWindow) -> dict[str, BoolArray]:
    """Return the worst measurements beyond the gate, by label: they make others seem so."""
    out = {}
    each = problem.residuals(found.evaluation, found.covariances)
    for o, residuals in zip(problem.observations, each, strict=True):
        known = np.isfinite(residuals)
        known[problem.rejected.get(o.label, np.zeros(len(known), dtype=bool))] = False
        squares = np.sum(np.where(known, residuals, 0.0) ** 2, axis=1)
        beyond = squares > chdtri(np.maximum(known.sum(axis=1), 1), _PASSES)
        if o.noise_groups and beyond.any():
            out[o.label] = beyond & (squares >= _WORST * squares.max())
    return out


def _inconsistent(problem: WindowProblem) -> tuple[str, ...]:
    """Return the kinds of measurements of which too many were rejected."""
    shares = {label: float(np.mean(rows)) for label, rows in problem.rejected.items()}
    return tuple(label for label, share in shares.items() if share > _CONTRADICTS)
