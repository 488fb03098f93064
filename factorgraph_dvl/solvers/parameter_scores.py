"""Scores of parameters that are taken as known, from the factorisation that there is.

With the whitened rows of a problem at its minimum, A by its variables and J by such parameters,
the residuals r, and the covariance P of the variables, all else follows the parameters as J̃:

    J̃ = J - A P AᵀJ,    S = -J̃ᵀ r = -Jᵀ (r + A d),    I = J̃ᵀ J̃ = JᵀJ - JᵀA P AᵀJ,

with the step d to the minimum, -P Aᵀr.
Where rows scatter by D, and not by one, S has the variance J̃ᵀ D² J̃ (White, Econometrica 48(4),
1980).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.problem import Problem, Rows
from factorgraph_dvl.statistics.constancy import by_interval
from factorgraph_dvl.statistics.rows import add_transposed_product, product, rows_with_times
from factorgraph_dvl.statistics.scores import Scores, places_of
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Intervals whose scores show how much a misfit that a parameter does not explain scatters. Chosen:
# longer than what persists in a trial of minutes.
_INTERVALS = 20

# Returns parts of a problem in which the parameters are free, each with its rows.
Parts = Callable[[], Iterable[tuple[Problem, Iterator[Rows]]]]


@dataclass(frozen=True)
class ParameterScores:
    """Scores of parameters that are taken as known, and how they follow.

    Parameters
    ----------
    parts : callable
        Returns parts of the problem in which these parameters are free, each with its rows.
    columns : mapping of str to tuple of (int, ndarray)
        Key there, and standard deviations (n,) of the wide prior, by name.
    scores : Scores
        Scores, and information as rows are whitened.
    by_key : mapping of int to ndarray
        JᵀA, (C, size) by key.
    information : SquareRootInformation
        Information on the variables of the problem without them.
    """

    parts: Parts
    columns: Mapping[str, tuple[int, Array]]
    scores: Scores
    by_key: Mapping[int, Array]
    information: SquareRootInformation

    def scattered(
        self, time: Array, ratios: Mapping[str, Array], others: Mapping[str, tuple[int, Array]]
    ) -> tuple[Scores, dict[str, float]]:
        """Return the scores where residuals scatter otherwise, and how much parts of them do.

        Once each parameter has explained what it can, scores of a misfit that it does not explain,
        as of correlated noise, go with each other for a while (White, Econometrica 48(4), 1980;
        Newey and West, Econometrica 55(3), 1987).

        Parameters
        ----------
        time : ndarray, shape (K,), s
            Times of the nodes.
        ratios : mapping of str to ndarray
            Standard deviations (d,) of rows by label, where they are not one.
        others : mapping of str to tuple of (int, ndarray)
            Parameters that are variables: as `columns`.

        Returns
        -------
        scores : Scores
            The scores by that variance; one by one, the others being right.
        scatter : dict of str to float
            Variance of the scores of parts of the trial over what white noise makes of it, at
            least one, by name; of `others` too.
        """
        following, places = self._following(others)
        size = next(iter(following.values())).shape[1]
        edges = np.linspace(time[0], time[-1], _INTERVALS + 1)[1:-1]
        score, variance = np.zeros((_INTERVALS, size)), np.zeros((_INTERVALS, size, size))
        of_priors = np.zeros((size, size))
        for problem, every in self.parts():
            priors: list[Rows] = []
            rows = rows_with_times(problem, (_scaled(each, ratios) for each in every), priors)
            of_part = by_interval(rows, following, edges)
            score, variance = score + of_part[0], variance + of_part[1]
            for each in priors:
                J = product(each, following).reshape(-1, size)
                of_priors += J.T @ J
        whole = variance.sum(axis=0) + of_priors
        out = {}
        for name, place in places.items():
            own = variance[:, place, place]
            total = own.sum(axis=0) + np.eye(own.shape[1])
            step = np.linalg.solve(total, score[:, place].sum(axis=0))
            left = score[:, place] - own @ step
            more = left.T @ left * _INTERVALS / (_INTERVALS - 1)
            out[name] = max(1.0, float(np.trace(np.linalg.solve(total, more))) / step.size)
        count, wide = self.scores.score.size, self.scores.wide
        return self.scores.with_variance(whole[:count, :count] / np.outer(wide, wide)), out

    def _following(
        self, others: Mapping[str, tuple[int, Array]]
    ) -> tuple[dict[int, Array], dict[str, slice]]:
        """Return how every variable follows the parameters in units of their wide priors."""
        information, wide = self.information, self.scores.wide
        places, edge = dict(self.scores.places), self.scores.wide.size
        parts = []
        if self.by_key:
            moved = information.covariance_with([self.by_key])
            parts.append({key: -matrix * wide for key, matrix in moved.items()})
        for name, (own_key, sigma) in others.items():
            unit = {own_key: np.diag(1.0 / sigma)}
            gain = np.linalg.inv(information.covariance_of([unit]))
            by_this = information.covariance_with([unit])
            parts.append({key: matrix @ gain for key, matrix in by_this.items()})
            places[name] = slice(edge, edge + sigma.size)
            edge += sigma.size
        following = {key: np.hstack([part[key] for part in parts]) for key in parts[0]}
        for name, (key, sigma) in self.columns.items():
            own = np.zeros((sigma.size, edge))
            own[:, places[name]] = np.diag(sigma)
            following[key] = own
        return following, places


def parameter_scores(
    parts: Parts,
    columns: Mapping[str, tuple[int, Array]],
    information: SquareRootInformation,
    step: gtsam.VectorValues | None = None,
) -> ParameterScores:
    """Return the scores of parameters that a problem takes as known.

    Parameters
    ----------
    parts, columns, information : callable or mapping or SquareRootInformation
        Those of `ParameterScores`. Variables of the problem have the same keys in the parts.
    step : gtsam.VectorValues, optional
        Step to the minimum, if the problem is not there.
    """
    wide = {name: sigma for name, (_, sigma) in columns.items()}
    sigma, places = np.concatenate([np.zeros(0), *wide.values()]), places_of(wide)
    of_key = {key: places[name] for name, (key, _) in columns.items()}
    score, square = np.zeros(sigma.size), np.zeros((sigma.size, sigma.size))
    # By the parameters that rows see, which are some of them.
    seen: dict[tuple[int, ...], dict[int, Array]] = {}
    for _, every in parts():
        for rows in every:
            J, some, rest = _split(rows, of_key)
            if not some.size:
                continue
            add_transposed_product(rest, J, seen.setdefault(tuple(some.tolist()), {}))
            flat = J.reshape(-1, some.size)
            score[some] -= flat.T @ rows.vector.ravel()
            square[np.ix_(some, some)] += flat.T @ flat
    by_key: dict[int, Array] = {}
    for columns_seen, sums in seen.items():
        rows_of_sum = list(columns_seen)
        while sums:
            key, part = sums.popitem()
            if key not in by_key:
                by_key[key] = np.zeros((sigma.size, part.shape[1]))
            by_key[key][rows_of_sum] += part
    if step is not None:
        score -= sum(matrix @ step.at(key) for key, matrix in by_key.items())
    known = square - information.covariance_of([by_key]) if by_key else square
    return ParameterScores(
        parts, columns, Scores(places, score, known, sigma), by_key, information
    )


def _split(rows: Rows, of_key: Mapping[int, slice]) -> tuple[Array, IntArray, Rows]:
    """Return the columns of parameters (M, d, C), which they are (C,), and rows without them."""
    own = [of_key.get(key) for key in rows.keys[0].tolist()]
    edges = np.cumsum([0, *rows.sizes]).tolist()
    parts: dict[bool, list[Array]] = {True: [], False: []}
    for place, begin, end in zip(own, edges, edges[1:], strict=False):
        parts[place is not None].append(rows.matrix[:, :, begin:end])
    kept = [i for i, place in enumerate(own) if place is None]
    some = [np.arange(place.start, place.stop) for place in own if place is not None]
    nothing = np.empty((*rows.matrix.shape[:2], 0))
    rest = replace(
        rows,
        keys=rows.keys[:, kept],
        sizes=tuple(rows.sizes[i] for i in kept),
        matrix=np.concatenate([nothing, *parts[False]], axis=2),
    )
    return (
        np.concatenate([nothing, *parts[True]], axis=2),
        np.concatenate([np.empty(0, dtype=int), *some]),
        rest,
    )


def _scaled(rows: Rows, ratios: Mapping[str, Array]) -> Rows:
    """Return rows whose products have the variance that their residuals scatter by."""
    ratio = ratios.get(rows.source)
    if ratio is None:
        return rows
    return replace(rows, matrix=rows.matrix * ratio[:, None], vector=rows.vector / ratio)
