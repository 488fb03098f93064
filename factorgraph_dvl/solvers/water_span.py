"""Water in place of the bottom for part of a trial: the span that the scores of pings show.

Where a DVL begins to see water that moves, the current that each ping asks for steps, and the IMU
knows of no such step. Between the largest steps are blocks of pings. With S the scores of a
current of each block and I their information, all else following, one current from block i to
block j takes off the objective

    S_ijᵀ I_ij⁻¹ S_ij,    S_ij = sum S_k,    I_ij = sum I_kl,    i <= k, l <= j.

The span is where this is highest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.sensors.dvl_water import CURRENT, WATER, WATER_SPAN
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solvers.record_scores import (
    part_of,
    record_sums_in_turn,
    scores_of,
    unexplained,
)
from factorgraph_dvl.solvers.shape import Shape
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Steps that are looked at, and pings on each side that show one. Chosen: a span has two, other
# errors some more; noise of a DVL is averaged, and the IMU drifts by less.
_STEPS, _SIDE = 8, 30
# Most parts of a record whose scores scatter by noise. Chosen: longer than what persists for
# seconds.
_PARTS = 30
# Share of the largest eigenvalue of information that is known. Chosen: rounding is less.
_KNOWN = 1e-9


def water_spans(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> dict[str, Shape]:
    """Return the span of a current that is not estimated, by its name.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Problem, and its minimum.
    information : SquareRootInformation
        Information on all variables there.
    """
    known = {p.name: p for p in problem.all_parameters}
    out = dict[str, Shape]()
    for bound, residual in zip(problem.bound, evaluation.residuals, strict=True):
        time = bound.observation.time
        if (
            WATER in bound.observation.parameters
            and not known[WATER].estimated
            and time.size > 4 * _SIDE
            and unexplained(bound, residual) > 0.0
        ):
            first = _first_pings(problem, bound, evaluation)
            i, j = _best(*_by_block(problem, bound, evaluation, information, time[first[1:-1]]))
            own = first[i], first[j + 1]
            span = np.array([time[own[0]], time[own[1] - 1]])
            edges = _parts_beside(*own, time.size)
            of_parts = _by_block(problem, bound, evaluation, information, time[edges[1:-1]])
            inside = (edges[:-1] >= own[0]) & (edges[:-1] < own[1])
            # It may begin and end with any ping.
            shape = replace(known[WATER_SPAN], mean=span)
            out[WATER] = Shape(shape, time.size**2 // 2, _elsewhere(*of_parts, inside))
    return out


def _parts_beside(begin: int, end: int, count: int) -> IntArray:
    """Return where parts begin, and the end: the span, and others as long on both sides of it.

    Errors that persist go with each other over as long.
    """
    length = max(end - begin, count // _PARTS)
    return np.unique([0, *range(begin, 0, -length), *range(end, count, length), count])


def _first_pings(problem: Problem, bound: BoundObservation, evaluation: Evaluation) -> IntArray:
    """Return the first ping of each block, and the number of pings, in order."""
    values = evaluation.parameters
    whole, motion = part_of(problem, bound, np.arange(bound.observation.time.size), evaluation)
    lin = whole.linearized(motion, values, [CURRENT], problem.processes_of(bound))
    # Columns are orthogonal, and of unit length but for the scale.
    asked = -np.einsum("mdi,md->mi", lin.d_parameters[CURRENT], lin.residual)
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(asked, axis=0)])
    count, n = len(asked), _SIDE
    step = sums[2 * n :] - 2.0 * sums[n : count + 1 - n] + sums[: count + 1 - 2 * n]
    size = np.linalg.norm(step, axis=1)
    found = []
    for _ in range(_STEPS):
        at = int(np.argmax(size))
        if size[at] <= 0.0:
            break
        found.append(at + n)
        size[max(at - n, 0) : at + n] = 0.0
    return np.array([0, *sorted(found), count])


def _by_block(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    information: SquareRootInformation,
    starts: Array,
) -> tuple[Array, Array]:
    """Return scores (K, 2) and information (K, 2, K, 2) of a current of each block of pings."""
    count = starts.size + 1

    def by_blocks(_: IntArray, part: BoundObservation, motion: Motion) -> dict[str, Array]:
        values, own = evaluation.parameters, part.observation.time
        lin = part.linearized(motion, values, [CURRENT], problem.processes_of(part))
        block = np.searchsorted(starts, own, side="right")
        by_current = lin.d_parameters[CURRENT]
        out = np.zeros((*by_current.shape[:2], count, 2))
        out[np.arange(own.size), :, block] = by_current
        return {WATER: out.reshape(*by_current.shape[:2], -1)}

    unknown = {WATER: np.full(2 * count, np.inf)}
    sums = record_sums_in_turn(problem, bound, evaluation, unknown, by_blocks)
    found = scores_of(sums, information, unknown)
    return found.score.reshape(count, 2), found.information.reshape(count, 2, count, 2)


def _elsewhere(score: Array, information: Array, inside: BoolArray) -> float:
    """Return the variance of scores of blocks outside a span, over that of white noise.

    At least one. A current of the span has explained what it can.
    """
    of_span = information[inside].sum(axis=0)
    known = np.linalg.pinv(of_span[:, inside].sum(axis=1), _KNOWN, hermitian=True)
    step = known @ score[inside].sum(axis=0)
    total = freedom = 0.0
    for k in np.flatnonzero(~inside):
        left = score[k] - of_span[:, k].T @ step
        own = information[k, :, k] - of_span[:, k].T @ known @ of_span[:, k]
        total += float(left @ np.linalg.pinv(own, _KNOWN, hermitian=True) @ left)
        freedom += left.size
    return max(total / freedom, 1.0) if freedom else 1.0


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
