"""Joint calibration of many trials, with what varies, steps and drifts between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, logsumexp, ndtr

from factorgraph_dvl.campaign.changes import (
    FALSE_ALARM,
    Change,
    Drift,
    drift_of,
    next_step,
    normal_equivalent,
    step_scores,
)
from factorgraph_dvl.campaign.information import Information
from factorgraph_dvl.campaign.model import Effect, Fit, fit, fitted, probabilities
from factorgraph_dvl.geometry.vectors import Array


@dataclass(frozen=True)
class JointCalibration:
    """The calibration that trials share, as it is in the last of them.

    Parameters
    ----------
    information : Information
        Information of the N trials on n components, in order.
    days : ndarray, shape (N,)
        Times of the trials; their numbers where dates are not known.
    fit : Fit
        Fit with variance between trials, changes, slopes and drifts.
    variance_probability : ndarray, shape (n,)
        Probability of each variance between trials, if there were none.
    changes : tuple of Change
        Steps between trials, in order.
    slopes : tuple of Slope
        Components that follow covariates.
    drifts : tuple of Drift
        Components that walk at random.
    """

    information: Information
    days: Array
    fit: Fit
    variance_probability: Array
    changes: tuple[Change, ...]
    slopes: tuple[Slope, ...]
    drifts: tuple[Drift, ...]

    @property
    def value(self) -> Array:
        """Values in the last trial, with its covariates, (n,), in reported units."""
        return self.fit.value_in(-1)[0]

    @property
    def covariance(self) -> Array:
        """Covariance of `value`, (n, n)."""
        return self.fit.value_in(-1)[1]

    @property
    def between_std(self) -> Array:
        """Standard deviation between trials, (n,), in reported units."""
        return np.asarray(np.sqrt(self.fit.variance) * self.fit.scale)

    @property
    def shared(self) -> Fit:
        """The fit of nodes that all trials share, without variation between them."""
        return fit(self.information, np.zeros(self.fit.size))

    @property
    def probability(self) -> float:
        """Probability of trials as far from the fit by chance."""
        freedom = self.fit.freedom
        return float(chdtrc(freedom, self.fit.statistic)) if freedom > 0.0 else 1.0

    def step(self, i: int) -> tuple[float, float]:
        """Return size and standard deviation of a change, in reported units."""
        return self.fit.effect(i)

    def slope(self, i: int) -> tuple[float, float]:
        """Return a slope and its standard deviation, by unit of the covariate."""
        return self.fit.effect(len(self.changes) + i)


def joint_calibration(
    information: Information, days: Array, covariates: Mapping[str, Array] | None = None
) -> JointCalibration:
    """Return the joint calibration of trials, and what changed between them.

    Slopes are found first, then steps, one after the other; a step on a component of which a
    walk at random is more likely makes it a drift.

    Parameters
    ----------
    information : Information
        Information of N trials, in order.
    days : ndarray, shape (N,)
        Times of the trials.
    covariates : mapping of str to ndarray, shape (N,), optional
        What components may follow.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import factorgraph_dvl as fd
    >>> trials = []
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for seed in (1, 2):
    ...         solution = fd.solve(fd.simulate("examples/short.yaml", seed=seed))
    ...         fd.save_solution(solution, f"{folder}/{seed}")
    ...         trials.append(fd.TrialCalibration(fd.load_calibration(f"{folder}/{seed}")))
    >>> information = fd.information_of(trials)
    >>> joint = fd.joint_calibration(information, days=np.array([0.0, 1.0]))
    >>> float(joint.value[information.names.index("lever_arm_y_m")].round(1)), joint.changes
    (1.2, ())
    """
    follow = slopes(information, covariates or {})
    fixed = [s.effect for s in follow]
    found: list[Change] = []
    drifts: list[Drift] = []
    count = information.square.size

    def effects() -> list[Effect]:
        moved = [change.effect(count) for change in found]
        return [*moved, *fixed, *(e for d in drifts for e in d.effects(days))]

    while len(found) < count - 1:
        change = next_step(information, effects(), [d.component for d in drifts])
        if change is None:
            break
        drift = _more_likely_drift(information, effects(), change, days)
        if drift is None:
            found.append(change)
        else:
            found = [c for c in found if c.component != drift.component]
            drifts.append(drift)
    found.sort(key=lambda change: change.after)
    best = fitted(information, effects())
    p = probabilities(best)
    for k in np.flatnonzero((best.variance > 0.0) & (p < FALSE_ALARM)):
        candidate = drift_of(information, best, int(k), days)
        if candidate is not None and candidate[0].probability < FALSE_ALARM / best.size:
            drifts.append(candidate[0])
    if drifts:
        best = fitted(information, effects())
        p = probabilities(best)
    return JointCalibration(information, days, best, p, tuple(found), follow, tuple(drifts))


def _more_likely_drift(
    information: Information, effects: Sequence[Effect], change: Change, days: Array
) -> Drift | None:
    """Return the drift that is more likely than a step, None if it is the step.

    Of either the variance is estimated; the step is as likely after each trial.
    """
    before = fitted(information, effects)
    candidate = drift_of(information, before, change.component, days)
    if candidate is None:
        return None
    step = change.effect(information.square.size)
    with_step = fitted(information, [*effects, step])
    alone = fit(information, with_step.variance, effects)
    scores = step_scores(alone)
    # Of a step of this variance, in units of the variance of each estimate of it.
    ratio = with_step.effect(len(effects))[0] ** 2 / scores.std[change.component] ** 2
    statistic = scores.statistic[change.component]
    gains = 0.5 * (statistic**2 * ratio / (1.0 + ratio) - np.log1p(ratio))
    gain = alone.likelihood - before.likelihood + float(logsumexp(gains)) - np.log(gains.size)
    drift, gain_of_drift = candidate
    return drift if gain_of_drift > gain else None


@dataclass(frozen=True)
class Slope:
    """A component that follows a covariate.

    Parameters
    ----------
    covariate : str
        Name.
    component : int
        Component that follows.
    profile : ndarray, shape (N,)
        The covariate less its mean, in each trial.
    probability : float
        Probability of as clear a slope in any component, by any covariate, if there were none.
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
        Information of N trials.
    covariates : mapping of str to ndarray, shape (N,)
        Values in each trial.
    effects : sequence of Effect, optional
        Effects to estimate besides the common value.
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
