"""Score tests of parameters that are taken as known: would they explain the misfit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

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

    def searched(self, count: int) -> Score:
        """Return the test of the best of so many shapes of a candidate: each may be by chance."""
        return replace(self, chi2=max(self.chi2 - 2.0 * float(np.log(count)), 0.0))

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


def scores(
    delta: gtsam.VectorValues,
    information: SquareRootInformation,
    candidates: Mapping[str, tuple[int, Array]],
) -> Scores:
    """Return scores and information of parameters that were taken as known.

    The graph contains them as variables with a wide prior, linearised where the fit without them
    ended, their priors' means being the values there. With P their covariance, the step delta
    to the minimum, and Lambda the information of the priors,

        I = P⁻¹ - Lambda,    S = P⁻¹ delta,    chi² = Sᵀ I⁻¹ S

    (Rao, Large sample tests of statistical hypotheses, 1948; Engle, Wald, likelihood ratio, and
    Lagrange multiplier tests in econometrics, 1984).

    Parameters
    ----------
    delta : gtsam.VectorValues
        Step to the minimum of the graph.
    information : SquareRootInformation
        Square-root information of the graph.
    candidates : mapping of str to tuple of (int, ndarray)
        Key and standard deviations (n,) of the wide prior, by name.
    """
    sizes = [sigma.size for _, sigma in candidates.values()]
    edges = np.cumsum([0, *sizes])
    P = information.covariance_of(
        [{key: np.eye(sigma.size)} for key, sigma in candidates.values()]
    )
    sigma = np.concatenate([sigma for _, sigma in candidates.values()])
    step = np.concatenate([delta.at(key) for key, _ in candidates.values()])
    # In units of the wide priors, that parameters of all sizes keep their digits.
    whole = np.linalg.inv(P / np.outer(sigma, sigma))
    return Scores(
        {name: slice(a, b) for name, a, b in zip(candidates, edges, edges[1:], strict=False)},
        whole @ (step / sigma) / sigma,
        (whole - np.eye(sigma.size)) / np.outer(sigma, sigma),
        sigma,
    )
