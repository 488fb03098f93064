"""Posterior against prior: information of the data, and undetermined directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information.segment_singular_values import dominant, readable_basis
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message, together
from factorgraph_dvl.quality.verdict import DEFAULT_LIMITS, Grade, grades_of

# Chosen: a direction is undetermined if at least half of the prior's σ remains; above the second
# share the data do not inform it at all.
OPEN = 0.5
_NOTHING = 0.98
# Chosen: from this correlation on, σ of a component is twice its σ given the other.
_CORRELATED = 0.9
# Chosen: more coefficients make a sentence unreadable.
_MOST_NAMED = 4


@dataclass(frozen=True)
class Direction:
    """A direction in the space of the parameters.

    Parameters
    ----------
    ratio : float
        Posterior over prior standard deviation along it.
    information : float
        Posterior over prior information, 1 / ratio²: the generalised eigenvalue.
    vector : ndarray, shape (P,)
        Unit vector, in units of the priors' standard deviations.
    names : tuple of str
        Names of the dominant components, the largest first.
    """

    ratio: float
    information: float
    vector: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class Marginals:
    """Posterior of a calibration against its prior.

    Parameters
    ----------
    names : tuple of str
        Names of the P estimated components.
    value, std, prior_std : ndarray, shape (P,)
        Value, posterior and prior standard deviation, in reported units.
    observable : ndarray of bool, shape (P,)
        Whether the data at least halved the prior's σ.
    grade : tuple of Grade
        Grade of the posterior standard deviation against its limit.
    correlation : ndarray, shape (P, P)
        Correlation of the posterior.
    directions : tuple of Direction
        P directions, the weakest first.
    sentences : tuple of Message
        A sentence for each weak direction.
    """

    names: tuple[str, ...]
    value: Array
    std: Array
    prior_std: Array
    observable: np.ndarray
    grade: tuple[Grade, ...]
    correlation: Array
    directions: tuple[Direction, ...]
    sentences: tuple[Message, ...]

    @property
    def ratio(self) -> Array:
        """Posterior over prior standard deviation, (P,)."""
        return self.std / self.prior_std


def marginals(
    estimates: Sequence[Estimate],
    covariance: Array,
    limits: Mapping[str, float] = DEFAULT_LIMITS,
) -> Marginals | None:
    """Return posterior against prior; None if nothing was estimated from a known prior.

    Parameters
    ----------
    estimates : sequence of Estimate
        Estimates of the calibration.
    covariance : ndarray
        Joint covariance of all components, in reported units.
    limits : mapping of str to float, optional
        Standard deviations that are good enough, by parameter.
    """
    names = np.array([n for e in estimates for n in e.component_names], dtype=object)
    value, std, prior, observable = (
        np.concatenate([np.empty(0), *(np.asarray(getattr(e, field)) for e in estimates)])
        for field in ("value", "std", "prior_std", "observable")
    )
    grade = [g for e in estimates for g in grades_of(e, limits)]
    free = np.isfinite(std) & (std > 0.0) & np.isfinite(prior) & (prior > 0.0)
    if not free.any():
        return None
    P = covariance[np.ix_(free, free)]
    shown = tuple(str(n) for n in names[free])
    scaled = P / np.outer(prior[free], prior[free])
    correlation = P / np.outer(std[free], std[free])
    directions = _directions(scaled, shown)
    return Marginals(
        names=shown,
        value=value[free],
        std=std[free],
        prior_std=prior[free],
        observable=observable[free].astype(bool),
        grade=tuple(grade[i] for i in np.flatnonzero(free)),
        correlation=correlation,
        directions=directions,
        sentences=(
            *_undetermined_sentences(directions, shown, prior[free], P),
            *_correlated_sentences(shown, P, correlation, std[free], prior[free]),
        ),
    )


def _directions(scaled: Array, names: tuple[str, ...]) -> tuple[Direction, ...]:
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    values, rows = values[::-1], vectors.T[::-1]
    uninformed = np.sqrt(np.maximum(values, 0.0)) > _NOTHING
    if uninformed.any():
        rows = np.concatenate([readable_basis(rows[uninformed]), rows[~uninformed]])
    return tuple(_direction(row, scaled, names) for row in rows)


def _direction(row: Array, scaled: Array, names: tuple[str, ...]) -> Direction:
    # The sign of an eigenvector is arbitrary: make the largest component positive.
    vector = row * np.sign(row[np.argmax(np.abs(row))])
    variance = max(float(vector @ scaled @ vector), 1e-300)
    return Direction(
        ratio=float(np.sqrt(variance)),
        information=1.0 / variance,
        vector=vector,
        names=dominant(vector, names),
    )


def _undetermined_sentences(
    directions: Sequence[Direction], names: tuple[str, ...], prior: Array, P: Array
) -> list[Message]:
    """Return a sentence for each direction that the data do not determine.

    These directions span a subspace: two undetermined combinations of two components leave
    both components undetermined.
    """
    vectors = [d.vector for d in directions if d.ratio >= OPEN]
    if not vectors:
        return []
    out = []
    basis = readable_basis(np.linalg.qr(np.array(vectors).T)[0].T)
    for row in basis:
        d = _direction(row, P / np.outer(prior, prior), names)
        left = 100.0 * min(d.ratio, 1.0)
        index = [names.index(name) for name in d.names]
        if len(index) == 1:
            key = "directions.open" if d.ratio > _NOTHING else "directions.hardly"
            out.append(message(key, name=d.names[0], left=left))
        elif len(index) > _MOST_NAMED:
            out.append(message("directions.many", names=_listed(d.names), left=left))
        else:
            step = d.vector[index] * prior[index]
            moves = [
                message("directions.by", name=name, size=s / step[0])
                for name, s in zip(d.names, step, strict=True)
            ]
            known: Message | str = ""
            if len(index) == 2:
                known = _known_combination(index[0], index[1], step, names, prior, P)
            out.append(
                message(
                    "directions.together",
                    names=_listed(d.names),
                    left=left,
                    moves=together(moves),
                    known=known,
                )
            )
    return out


def _known_combination(
    i: int, j: int, step: Array, names: Sequence[str], prior: Array, P: Array
) -> Message | str:
    """Return the combination of two components that the data determine, if there is one."""
    slope = float(step[0] / step[1])
    variance = float(P[i, i] - 2.0 * slope * P[i, j] + slope**2 * P[j, j])
    before = float(prior[i] ** 2 + (slope * prior[j]) ** 2)
    if variance > OPEN**2 * before:
        return ""
    return message(
        "directions.known",
        first=names[i],
        factor=_signed(-slope),
        second=names[j],
        std=np.sqrt(max(variance, 0.0)),
    )


def _correlated_sentences(
    names: Sequence[str], P: Array, correlation: Array, std: Array, prior: Array
) -> list[Message]:
    """Return a sentence for each pair of known but strongly correlated components."""
    out = []
    known = std < OPEN * prior
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            rho = float(correlation[i, j])
            if abs(rho) < _CORRELATED or not (known[i] and known[j]):
                continue
            slope = float(P[i, j] / P[j, j])
            rest = float(std[i]) * np.sqrt(max(1.0 - rho**2, 0.0))
            out.append(
                message(
                    "directions.correlated",
                    first=names[i],
                    second=names[j],
                    correlation=rho,
                    factor=_signed(-slope),
                    rest=rest,
                    alone=std[i],
                )
            )
    return out


def _listed(names: Sequence[str]) -> Message | str:
    if len(names) == 1:
        return names[0]
    return message("words.listed", names=names[:-1], last=names[-1])


def _signed(value: float) -> str:
    return f"{'+' if value >= 0.0 else '-'} {abs(value):.3g}"
