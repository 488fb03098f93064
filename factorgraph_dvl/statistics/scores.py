"""Score tests of parameters that are taken as known: would they explain the misfit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.geometry.vectors import Array

# Relative size of an eigenvalue of information that is none.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Score:
    """Test of some parameters that were taken as known.

    Parameters
    ----------
    chi2 : float
        Twice the fall of the cost if they were free.
    freedom : int
        Number of their components.
    step, std : ndarray, shape (freedom,), SI
        Where they would go in their tangent space, and how well that would be known, all other
        candidates being right.
    scatter : float
        Variance of the scores over that of white noise, by which chi2 was divided.
    """

    chi2: float
    freedom: int
    step: Array
    std: Array
    scatter: float = 1.0

    @property
    def log10_p(self) -> float:
        """Logarithm of the probability of a larger chi2 by chance; -inf where it underflows."""
        with np.errstate(divide="ignore"):
            return float(np.log10(chdtrc(self.freedom, self.chi2)))

    def less(self, price: float) -> Score:
        """Return the test with a smaller chi2, as of the best of many that were tried."""
        return replace(self, chi2=max(self.chi2 - price, 0.0))

    def divided(self, scatter: float) -> Score:
        """Return the test where scores scatter more, in variance, than white noise makes them."""
        std = self.std * np.sqrt(scatter)
        return Score(self.chi2 / scatter, self.freedom, self.step, std, self.scatter * scatter)

    def evidence(self, wide: Array) -> float:
        """Return by how much -2 log likelihood falls, about, where it may be anything plausible.

        As probabilities underflow for several at once, this ranks causes: chi2, less the logarithm
        of how much better than by its wide prior each component is known (Laplace's method; Kass
        and Raftery, Bayes factors, Journal of the American Statistical Association 90(430), 1995).

        Parameters
        ----------
        wide : ndarray, shape (freedom,), SI
            Standard deviations of the wide prior.
        """
        return self.chi2 - float(np.sum(np.log1p((wide / self.std) ** 2)))


@dataclass(frozen=True)
class Scores:
    """Scores S and information I of all candidates, everything else eliminated.

    Parameters
    ----------
    places : mapping of str to slice
        Components of each candidate among all.
    score : ndarray, shape (C,)
        Downward gradient of the cost, 1/SI.
    information : ndarray, shape (C, C)
        Information of the data, 1/SI², which may be singular.
    wide : ndarray, shape (C,)
        Standard deviations of the wide priors, SI, also infinite: what the data do not inform on
        stays there.
    """

    places: Mapping[str, slice]
    score: Array
    information: Array
    wide: Array

    def test(self, names: Sequence[str]) -> Score:
        """Return the test of some candidates together, all others being right.

        The step is zero along what nothing is known of.
        """
        rows = np.concatenate([np.arange(self.score.size)[self.places[name]] for name in names])
        information = self.information[np.ix_(rows, rows)] + np.diag(self.wide[rows] ** -2.0)
        size = np.sqrt(np.maximum(np.diag(information), 0.0))
        known = size > _ROUNDING * np.max(size, initial=0.0)
        # In units in which each component has an information of one.
        gain = np.divide(1.0, size, out=np.zeros_like(size), where=known)
        units = np.outer(gain, gain)
        inverse = units * np.linalg.pinv(units * information, _ROUNDING, hermitian=True)
        step = inverse @ self.score[rows]
        std = np.where(known, np.sqrt(np.maximum(np.diag(inverse), 0.0)), np.inf)
        return Score(float(self.score[rows] @ step), rows.size, step, std)

    def with_slopes(self, slopes: Mapping[str, Array]) -> Scores:
        """Return the scores where the objective has slopes that no residual has, by name, 1/SI."""
        score = self.score.copy()
        for name, slope in slopes.items():
            score[self.places[name]] -= slope
        return replace(self, score=score)

    def with_variance(self, variance: Array) -> Scores:
        """Return the scores where their variance is not the information, of each candidate alone.

        The step is the same; its covariance is I⁻¹ M I⁻¹ with the variance M (White, Econometrica
        48(4), 1980).

        Parameters
        ----------
        variance : ndarray, shape (C, C)
            The variance.
        """
        score, information = np.zeros_like(self.score), np.zeros_like(self.information)
        for own in self.places.values():
            known = self.information[own, own]
            gain = known @ np.linalg.pinv(variance[own, own], _ROUNDING, hermitian=True)
            score[own], information[own, own] = gain @ self.score[own], gain @ known
        return Scores(self.places, score, information, self.wide)


def places_of(wide: Mapping[str, Array]) -> dict[str, slice]:
    """Return the components of each candidate among all, by name; arguments as `Scores.wide`."""
    edges = np.cumsum([0, *(sigma.size for sigma in wide.values())]).tolist()
    return {name: slice(*ends) for name, ends in zip(wide, pairwise(edges), strict=True)}
