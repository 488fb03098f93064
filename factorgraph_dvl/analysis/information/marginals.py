"""Posterior against prior: what the data added, and which directions stay open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information.segment_singular_values import dominant, readable_basis
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Estimate

# A direction of which the data left this share of the prior's σ, or more, is open; above
# the second they told nothing of it.
OPEN = 0.5
_NOTHING = 0.98
# Correlation from which on two components are called hard to tell apart.
_HARD = 0.9
# Components of a sentence; with more it is none.
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
        Of unit length, in units of the priors' standard deviations.
    names : tuple of str
        Of the components that dominate it, the largest first.
    """

    ratio: float
    information: float
    vector: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class Marginals:
    """The marginal view of a calibration.

    Parameters
    ----------
    names : tuple of str
        (P,) components that were estimated, in reported units.
    value, std, prior_std : ndarray, shape (P,)
    observable : ndarray, shape (P,)
        Bool, whether the data at least halved the prior's σ.
    correlation : ndarray, shape (P, P)
        Of the posterior.
    directions : tuple of Direction
        P directions, the weakest first.
    sentences : tuple of str
        The weak directions in words.
    """

    names: tuple[str, ...]
    value: Array
    std: Array
    prior_std: Array
    observable: np.ndarray
    correlation: Array
    directions: tuple[Direction, ...]
    sentences: tuple[str, ...]

    @property
    def ratio(self) -> Array:
        """Posterior over prior standard deviation, (P,)."""
        return self.std / self.prior_std


def marginals(estimates: Sequence[Estimate], covariance: Array) -> Marginals | None:
    """Return the marginal view; None if nothing was estimated from a known prior.

    Parameters
    ----------
    estimates : sequence of Estimate
        The calibration.
    covariance : ndarray
        Joint covariance of all components, in reported units.
    """
    names = np.array([n for e in estimates for n in e.component_names], dtype=object)
    value, std, prior, observable = (
        np.concatenate([np.empty(0), *(np.asarray(getattr(e, field)) for e in estimates)])
        for field in ("value", "std", "prior_std", "observable")
    )
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
        correlation=correlation,
        directions=directions,
        sentences=(
            *_open_sentences(directions, shown, prior[free], P),
            *_hard_sentences(shown, P, correlation, std[free], prior[free]),
        ),
    )


def _directions(scaled: Array, names: tuple[str, ...]) -> tuple[Direction, ...]:
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    values, rows = values[::-1], vectors.T[::-1]
    untold = np.sqrt(np.maximum(values, 0.0)) > _NOTHING
    if untold.any():
        rows = np.concatenate([readable_basis(rows[untold]), rows[~untold]])
    return tuple(_direction(row, scaled, names) for row in rows)


def _direction(row: Array, scaled: Array, names: tuple[str, ...]) -> Direction:
    # Eigenvectors have no sign: the largest component shall be positive.
    vector = row * np.sign(row[np.argmax(np.abs(row))])
    variance = max(float(vector @ scaled @ vector), 1e-300)
    return Direction(
        ratio=float(np.sqrt(variance)),
        information=1.0 / variance,
        vector=vector,
        names=dominant(vector, names),
    )


def _open_sentences(
    directions: Sequence[Direction], names: tuple[str, ...], prior: Array, P: Array
) -> list[str]:
    """Say which directions the data left open.

    Together they span a subspace; of two open combinations of two components, each of
    these is open.
    """
    vectors = [d.vector for d in directions if d.ratio >= OPEN]
    if not vectors:
        return []
    out = []
    basis = readable_basis(np.linalg.qr(np.array(vectors).T)[0].T)
    for row in basis:
        d = _direction(row, P / np.outer(prior, prior), names)
        left = f"{100.0 * min(d.ratio, 1.0):.0f} % of the prior's σ is left"
        index = [names.index(name) for name in d.names]
        if len(index) == 1:
            told = "is not told" if d.ratio > _NOTHING else "is hardly told"
            out.append(f"{d.names[0]} {told} by the data: {left}")
        elif len(index) > _MOST_NAMED:
            out.append(f"{', '.join(d.names)} cannot be told apart: {left} of a combination")
        else:
            step = d.vector[index] * prior[index]
            moves = " and ".join(
                f"{name} by {s / step[0]:.3g}" for name, s in zip(d.names, step, strict=True)
            )
            text = f"{_listed(d.names)} cannot be told apart: {left} where {moves} move together"
            if len(index) == 2:
                text += _known_combination(index[0], index[1], step, names, prior, P)
            out.append(text)
    return out


def _known_combination(
    i: int, j: int, step: Array, names: Sequence[str], prior: Array, P: Array
) -> str:
    """Say what the data know across a direction of two components, if anything."""
    slope = float(step[0] / step[1])
    variance = float(P[i, i] - 2.0 * slope * P[i, j] + slope**2 * P[j, j])
    before = float(prior[i] ** 2 + (slope * prior[j]) ** 2)
    if variance > OPEN**2 * before:
        return ""
    return (
        f"; only {names[i]} {_signed(-slope)} · {names[j]} is known, to "
        f"{np.sqrt(max(variance, 0.0)):.2g}"
    )


def _hard_sentences(
    names: Sequence[str], P: Array, correlation: Array, std: Array, prior: Array
) -> list[str]:
    """Say which components are known, but mostly together."""
    out = []
    known = std < OPEN * prior
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            rho = float(correlation[i, j])
            if abs(rho) < _HARD or not (known[i] and known[j]):
                continue
            slope = float(P[i, j] / P[j, j])
            rest = float(std[i]) * np.sqrt(max(1.0 - rho**2, 0.0))
            out.append(
                f"{names[i]} and {names[j]} are hard to tell apart (correlation {rho:.3f}): "
                f"{names[i]} {_signed(-slope)} · {names[j]} is known to {rest:.2g}, "
                f"{names[i]} alone to {std[i]:.2g}"
            )
    return out


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def _signed(value: float) -> str:
    return f"{'+' if value >= 0.0 else '-'} {abs(value):.3g}"
