"""What speaks against a hypothesis, as far as it is more than chance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.ranging.model import PlanarProblem
from factorgraph_dvl.ranging.smoother import Fit, cost_terms

# Evidence against a hypothesis with which it is given up: its likelihood is e^-20.
HOPELESS = 20.0
# Difference of a single term that is none of noise, if there are several; and standard deviations
# of the sum of the others that are.
_STRONG = 4.0
_SEVERAL = 3
_CHANCE = 2.0


def evidence(problem: PlanarProblem, fits: Sequence[Fit]) -> Array:
    """Return what speaks against each fit of the same data.

    By `odds_against`, and by the priors as they are: these do not add up by chance.
    """
    if not fits:
        return np.empty(0)
    single = [cost_terms(problem, f) for f in fits]
    priors = problem.prior_sigma.size + 1
    against = odds_against([terms[:-priors] for terms in single])
    against = against + np.array([terms[-priors:].sum() for terms in single])
    return np.asarray(against - against.min())


def odds_against(single: Sequence[Array]) -> Array:
    """Return what speaks against each fit: negative log likelihoods, relative to the best.

    They differ by the sum of the differences of their terms. But a heading that only its noise
    turns takes sides as well, for one mirror image now and for the other then; so the sum of
    many small differences walks at random, on a long straight run as far as one likes. Of
    these no more is believed than the odds of so large a sum D by chance, whose variance is
    the sum of the squares (Vuong, Likelihood ratio tests for model selection and non-nested
    hypotheses, Econometrica 57(2), 1989), and nothing below two of its standard deviations. A
    few measurements that fit one and miss the other, as after a turn, count as they are.

    Parameters
    ----------
    single : sequence of ndarray
        Of each fit, the terms (T,) of its cost.
    """
    if not single:
        return np.empty(0)
    first = single[int(np.argmin([terms.sum() for terms in single]))]
    out = []
    for terms in single:
        apart = terms - first
        strong = np.abs(apart) > _STRONG
        strong &= strong.sum() >= _SEVERAL
        small = apart[~strong]
        total = float(small.sum())
        z = abs(total) / max(float(np.linalg.norm(small)), 1e-12)
        believed = min(abs(total), max(_log_odds(z) - _log_odds(_CHANCE), 0.0))
        out.append(float(apart[strong].sum()) + np.sign(total) * believed)
    against = np.array(out)
    return against - against.min()


def _log_odds(z: float) -> float:
    """Return the logarithm of the odds that a normal draw is below z."""
    return float(log_ndtr(z) - log_ndtr(-z))
