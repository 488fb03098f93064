"""Scores of parameters that change one record only, from the factorisation that there is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.statistics.rows import add_transposed_product
from factorgraph_dvl.statistics.scores import Score
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Relative size of an eigenvalue of information that is none.
_ROUNDING = 1e-9
# Measurements whose derivatives are there at once. Chosen: some ten megabytes.
_CHUNK = 4096


@dataclass(frozen=True)
class RecordScores:
    """Scores S and information I of parameters of one record, all else following.

    Parameters
    ----------
    places : dict of str to slice
        Components of each parameter among all.
    score : ndarray, shape (C,)
        Downward gradient of the cost, 1/SI.
    information : ndarray, shape (C, C)
        Information of the data, 1/SI², which may be singular.
    """

    places: dict[str, slice]
    score: Array
    information: Array

    def test(self, name: str, wide: Array | float = np.inf) -> Score:
        """Return the test of a parameter; the step is zero along what nothing is known of.

        Parameters
        ----------
        name : str
            Name of the parameter.
        wide : ndarray or float, SI
            Standard deviations of its prior; by default it has none.
        """
        own = self.places[name]
        score = self.score[own]
        prior = np.broadcast_to(np.asarray(wide, float) ** -2.0, score.size)
        information = self.information[own, own] + np.diag(prior)
        size = np.sqrt(np.maximum(np.diag(information), 0.0))
        known = size > _ROUNDING * np.max(size, initial=0.0)
        # In units in which each component has an information of one.
        gain = np.divide(1.0, size, out=np.zeros_like(size), where=known)
        inverse = np.linalg.pinv(np.outer(gain, gain) * information, _ROUNDING, hermitian=True)
        inverse *= np.outer(gain, gain)
        step = inverse @ score
        std = np.where(known, np.sqrt(np.maximum(np.diag(inverse), 0.0)), np.inf)
        return Score(float(score @ step), step.size, step, std)


def record_scores(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    information: SquareRootInformation,
    names: Sequence[str],
    motion: Motion | None = None,
    derivatives: Mapping[str, Array] = MappingProxyType({}),
) -> RecordScores:
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
    names : sequence of str
        The parameters.
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
    lin = bound.linearized(motion, values, [*wanted, *names], processes)
    lin.d_parameters.update(derivatives)
    edges = np.cumsum([0, *(lin.d_parameters[name].shape[2] for name in names)]).tolist()
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
        by_names = np.concatenate([lin.d_parameters[name][some] for name in names], axis=2)
        by_names = bound.weight[some][:, :, None] * by_names
        part = Rows(o.label, o.components, keys[some], sizes, rows, residual, begin)
        add_transposed_product(part, by_names, taken_up)
        flat = by_names.reshape(-1, edges[-1])
        score -= flat.T @ residual.ravel()
        square += flat.T @ flat
    square -= information.covariance_of([taken_up])
    places = {name: slice(*ends) for name, ends in zip(names, pairwise(edges), strict=True)}
    return RecordScores(places, score, square)
