"""Costs of hypotheses relative to the best, as far as they are more than chance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr

from factorgraph_dvl.geometry.vectors import Array

# Chosen: relative cost at which a hypothesis is dropped, a likelihood of e^-20.
NEGLIGIBLE = 20.0
# Chosen: difference of a single term that noise does not explain, if several terms reach it.
_STRONG = 4.0
_SEVERAL = 3
# Chosen: standard deviations of the sum of the others that chance explains.
_CHANCE = 2.0


def hypothesis_costs(data: Sequence[Array], priors: Sequence[float]) -> Array:
    """Return the costs of tracks by the same data relative to the best, (F,).

    Those of the data by `significant_costs`; those of the priors as they are, since few terms
    do not add up by chance.

    Parameters
    ----------
    data : sequence of ndarray
        Costs of each track by its data, the terms (T,) of its cost.
    priors : sequence of float
        Cost of each track, the cost by all priors.
    """
    if not data:
        return np.empty(0)
    against = significant_costs(data) + np.array(priors)
    return np.asarray(against - against.min())


def significant_costs(single: Sequence[Array]) -> Array:
    """Return negative log likelihoods of fits relative to the best, without what chance explains.

    The costs of two fits differ by the sum of the differences of their terms. On a long straight
    run the noise of the heading favours one mirror image now and the other then, so the sum of
    many small differences is a random walk. A sum D counts only as the log odds that chance does
    not reach it, its variance being the sum of squares (Vuong, Likelihood ratio tests for model
    selection and non-nested hypotheses, Econometrica 57(2), 1989), and not at all below two
    standard deviations. A few large differences, as after a turn, count in full.

    Parameters
    ----------
    single : sequence of ndarray
        Costs of each fit, the terms (T,) of its cost.
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
        counted = min(abs(total), max(_log_odds(z) - _log_odds(_CHANCE), 0.0))
        out.append(float(apart[strong].sum()) + np.sign(total) * counted)
    against = np.array(out)
    return against - against.min()


def _log_odds(z: float) -> float:
    """Return the logarithm of the odds that a normal draw is below z."""
    return float(log_ndtr(z) - log_ndtr(-z))
