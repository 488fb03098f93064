"""Covariates: components that follow something measured beside each trial, such as temperature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from factorgraph_dvl.campaign.between_trials import fitted
from factorgraph_dvl.campaign.changes import FALSE_ALARM
from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, fit
from factorgraph_dvl.campaign.supremum import normal_equivalent
from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class Slope:
    """A component that follows a covariate.

    Parameters
    ----------
    covariate : str
        Name.
    component : int
        That follows.
    profile : ndarray, shape (N,)
        The covariate less its mean, in each trial.
    probability : float
        Of as clear a slope in any component, by any covariate, if there were none.
    """

    covariate: str
    component: int
    profile: Array
    probability: float

    @property
    def effect(self) -> Effect:
        """The covariate as an effect; its size is the slope."""
        return Effect(self.component, self.profile)


def slopes(
    information: Information, covariates: Mapping[str, Array], effects: Sequence[Effect] = ()
) -> tuple[Slope, ...]:
    """Return which components follow which covariates, the clearest first.

    Parameters
    ----------
    information : Information
        Of N trials.
    covariates : mapping of str to ndarray, shape (N,)
        Values in each trial.
    effects : sequence of Effect, optional
        To estimate besides.
    """
    profiles = {n: v - v.mean() for n, v in covariates.items() if np.ptp(v) > 0.0}
    size = information.prior_std.size
    found: list[Slope] = []
    while True:
        known = [*effects, *(slope.effect for slope in found)]
        used = {(s.covariate, s.component) for s in found}
        tests = [
            (_probability(information, known, Effect(k, profile)), name, k)
            for name, profile in profiles.items()
            for k in range(size)
            if (name, k) not in used
        ]
        if not tests:
            return tuple(found)
        p, name, k = min(tests)
        p = min(p * len(tests), 1.0)
        if p > FALSE_ALARM:
            return tuple(found)
        found.append(Slope(name, k, profiles[name], p))


def _probability(information: Information, known: Sequence[Effect], effect: Effect) -> float:
    """Return the probability of as large an effect by chance."""
    k = effect.component
    own = information.matrix[:, k, k] > 0.0
    if not own.any() or np.ptp(effect.profile[own]) == 0.0:
        return 1.0
    zero = fit(information, np.zeros(information.prior_std.size), [*known, effect])
    size, std = zero.effect(len(known))
    if 2.0 * ndtr(-abs(size) / std) > FALSE_ALARM:
        return 1.0
    found = fitted(information, [*known, effect])
    size, std = found.effect(len(known))
    z = abs(size) / std
    if found.variance[k] > 0.0:
        used = sum(e.component == k for e in known)
        z = normal_equivalent(z, max(int(own.sum()) - 2 - used, 1))
    return float(2.0 * ndtr(-z))
