"""Water in place of the bottom for part of a trial: the span that the scores of pings show.

In each of some blocks of the record a DVL may see water that moves with a current of its own. With
S the scores of these currents and I their information, all else following, one current from block
i to block j takes off the objective

    S_ijᵀ I_ij⁻¹ S_ij,    S_ij = sum S_k,    I_ij = sum I_kl,    i <= k, l <= j.

The span is where this is highest. Then the blocks at its ends are divided in turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.sensors.dvl import CURRENT, WATER, WATER_SPAN
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.averaging import unexplained
from factorgraph_dvl.solvers.record_scores import sums_in_parts
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Blocks of a record, and those into which the ones at the ends of a span are divided.
_BLOCKS = 20
# Share of the largest eigenvalue of information that is known. Chosen: rounding is less.
_KNOWN = 1e-9


def water_spans(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> dict[str, tuple[Parameter, int]]:
    """Return the span of a current that is not estimated, by its name, and how many were tried.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem, and its minimum.
    information : SquareRootInformation
        Information on all variables there.
    """
    known = {p.name: p for p in problem.all_parameters}
    out: dict[str, tuple[Parameter, int]] = {}
    for bound, residual in zip(problem.bound, evaluation.residuals, strict=True):
        time = np.unique(bound.observation.time[bound.weight.any(axis=1)])
        if (
            WATER not in bound.observation.parameters
            or known[WATER].estimated
            or time.size < _BLOCKS**2
            or unexplained(bound, residual) == 0.0
        ):
            continue
        first, last, edges = 0, 0, np.linspace(time[0], time[-1], _BLOCKS + 1)
        for finer in (False, True):
            if finer:
                ends = [
                    edges[[k, k + 1]]
                    for k in {max(first - 1, 0), first, last, min(last + 1, edges.size - 2)}
                ]
                edges = np.unique([*edges, *(np.linspace(*end, _BLOCKS // 2 + 1) for end in ends)])
            first, last = _best(*_by_block(problem, bound, evaluation, information, edges))
        span = np.array([edges[first], edges[last + 1]])
        out[WATER] = replace(known[WATER_SPAN], mean=span), (10 * _BLOCKS) ** 2 // 2
    return out


def _by_block(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    information: SquareRootInformation,
    edges: Array,
) -> tuple[Array, Array]:
    """Return scores (K, 2) and information (K, 2, K, 2) of a current of each block of pings."""
    count = edges.size - 1

    def by_blocks(part: BoundObservation) -> dict[str, Array]:
        values, own = evaluation.parameters, part.observation.time
        motion = part.motion(part.attachment, evaluation.states, values)
        lin = part.linearized(motion, values, [CURRENT], problem.processes_of(part))
        block = np.clip(np.searchsorted(edges, own, side="right") - 1, 0, count - 1)
        by_current = lin.d_parameters[CURRENT]
        out = np.zeros((*by_current.shape[:2], count, 2))
        out[np.arange(own.size), :, block] = by_current
        return {WATER: out.reshape(*by_current.shape[:2], -1)}

    sums = sums_in_parts(
        problem, bound, evaluation, {WATER: np.full(2 * count, np.inf)}, by_blocks
    )
    known = sums.square - information.covariance_of([sums.by_key])
    return sums.score.reshape(count, 2), known.reshape(count, 2, count, 2)


def _best(score: Array, information: Array) -> tuple[int, int]:
    """Return the first and the last block of the span that takes off most; not of the whole."""
    count = len(score)
    S = np.concatenate([np.zeros((1, 2)), np.cumsum(score, axis=0)])
    whole = np.zeros((count + 1, 2, count + 1, 2))
    whole[1:, :, 1:] = information.cumsum(axis=0).cumsum(axis=2)
    i, j = np.triu_indices(count + 1, 1)
    i, j = i[j - i < count], j[j - i < count]
    own = S[j] - S[i]
    known = whole[j, :, j] - whole[i, :, j] - whole[j, :, i] + whole[i, :, i]
    fall = np.einsum("nk,nkl,nl->n", own, np.linalg.pinv(known, _KNOWN, hermitian=True), own)
    best = int(np.argmax(fall))
    return int(i[best]), int(j[best]) - 1
