"""Scores of parameters that change one record only, from the factorisation that there is."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.statistics.rows import add_transposed_product
from factorgraph_dvl.statistics.scores import Scores
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Measurements whose derivatives are there at once. Chosen: some ten megabytes.
_CHUNK = 4096


def record_scores(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    information: SquareRootInformation,
    candidates: Mapping[str, Array],
    motion: Motion | None = None,
    derivatives: Mapping[str, Array] = MappingProxyType({}),
) -> Scores:
    """Return scores and information of parameters that change one record only.

    With J the whitened derivatives by them, A those by all variables, P the covariance of these
    and r the residuals,

        S = -Jᵀ r,    I = JᵀJ - JᵀA P AᵀJ:

    the score tests of `statistics.scores`, at the price of no elimination.

    Parameters
    ----------
    problem : Problem
        Problem without these parameters.
    bound : BoundObservation
        The observation, or some of its measurements, weighed and attached.
    evaluation : Evaluation
        The minimum.
    information : SquareRootInformation
        Information on all variables there.
    candidates : mapping of str to ndarray
        Standard deviations (n,) of the wide prior of each, SI; they may be infinite.
    motion : Motion, optional
        Motion where the observation is attached, if it is known.
    derivatives : mapping of str to ndarray, optional
        Derivatives (M, d, n) by some of the parameters, in place of those of the observation.
    """
    values = evaluation.parameters
    if motion is None:
        motion = bound.motion(bound.attachment, evaluation.states, values)
    own, processes = bound.parameters(problem.parameters), problem.processes_of(bound)
    wanted = [p.name for p in own]
    lin = bound.linearized(motion, values, [*wanted, *candidates], processes)
    lin.d_parameters.update(derivatives)
    edges = np.cumsum([0, *(sigma.size for sigma in candidates.values())]).tolist()
    keys = bound.keys_at(bound.nodes(processes), processes, [problem.key(n) for n in wanted])
    sizes = tuple(bound.sizes(processes, own))
    o = bound.observation
    score, square = np.zeros(edges[-1]), np.zeros((edges[-1], edges[-1]))
    taken_up: dict[int, Array] = {}
    for begin in range(0, o.time.size, _CHUNK):
        some = slice(begin, min(begin + _CHUNK, o.time.size))
        rows, residual = bound.jacobian(
            lin, some, motion, evaluation.states, values, wanted, processes, {}
        )
        by_names = np.concatenate([lin.d_parameters[name][some] for name in candidates], axis=2)
        by_names = bound.weight[some][:, :, None] * by_names
        part = Rows(o.label, o.components, keys[some], sizes, rows, residual, begin)
        add_transposed_product(part, by_names, taken_up)
        flat = by_names.reshape(-1, edges[-1])
        score -= flat.T @ residual.ravel()
        square += flat.T @ flat
    square -= information.covariance_of([taken_up])
    places = {name: slice(*ends) for name, ends in zip(candidates, pairwise(edges), strict=True)}
    return Scores(places, score, square, np.concatenate(list(candidates.values())))
