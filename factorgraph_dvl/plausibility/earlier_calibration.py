"""Whether an earlier calibration contradicts the trial that it is the prior of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.imu import BIASES
from factorgraph_dvl.sensors.parameters import JointPrior
from factorgraph_dvl.trial import Trial

# Chosen: probabilities by chance below which a contradiction is to be checked, and below which
# it makes a result useless.
DOUBTFUL_P = 1e-3
CONTRADICTED_P = 1e-6
# Share of the prior's variance that the data must remove along a direction for them to say
# anything about it. Chosen: a prior that is ten times sharper than the data is still tested; of
# less, errors of the model that hardly matter make a contradiction.
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class PriorAgainstData:
    """A prior against the data alone.

    Parameters
    ----------
    statistic : float
        Chi-square.
    freedom : int
        Directions that the data inform on.
    value, std : ndarray, shape (n,)
        What the data alone say; std is infinite along what they leave open.
    """

    statistic: float
    freedom: int
    value: Array
    std: Array

    @property
    def probability(self) -> float:
        """Probability of a statistic as large by chance."""
        return float(chdtrc(self.freedom, self.statistic)) if self.freedom else 1.0


def prior_against_data(
    prior: Array, prior_covariance: Array, value: Array, covariance: Array
) -> PriorAgainstData:
    """Return the test of a prior against the data alone, from prior and posterior.

    With the prior x0, P0 and the posterior x, P, the data alone say x_d with P_d, where
    P⁻¹ = P0⁻¹ + P_d⁻¹. Then (x_d - x0)ᵀ (P_d + P0)⁻¹ (x_d - x0) = (x - x0)ᵀ (P0 - P)⁻¹ (x - x0),
    which needs no P_d.

    Parameters
    ----------
    prior : ndarray, shape (n,)
        Mean of the prior.
    prior_covariance : ndarray, shape (n, n)
        Covariance of the prior.
    value : ndarray, shape (n,)
        Mean with the data.
    covariance : ndarray, shape (n, n)
        Covariance with the data.
    """
    scale = np.sqrt(np.maximum(np.diag(prior_covariance), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    variances, directions = np.linalg.eigh(prior_covariance / np.outer(scale, scale))
    known = variances > 1e-12
    root = scale[:, None] * directions[:, known] * np.sqrt(variances[known])
    inverse = np.linalg.pinv(root)
    share, turn = np.linalg.eigh(np.eye(root.shape[1]) - inverse @ covariance @ inverse.T)
    informed = share > _LEAST_SHARE
    along = turn.T @ inverse @ (value - prior)
    back = root @ turn
    gain = np.where(informed, 1.0 / np.where(informed, share, 1.0), 0.0)
    unknown = np.abs(back[:, ~informed]).max(axis=1, initial=0.0) > 1e-6 * scale
    variance = back**2 @ np.maximum(gain - 1.0, 0.0)
    return PriorAgainstData(
        float(gain @ along**2),
        int(informed.sum()),
        prior + back @ (gain * along),
        np.where(unknown, np.inf, np.sqrt(variance)),
    )


def prior_findings(
    trial: Trial, estimates: Sequence[Estimate], covariance: Array
) -> Iterator[Finding]:
    """Yield a finding for each earlier calibration that contradicts the trial.

    Parameters
    ----------
    trial : Trial
        Its DVL and its IMU may have earlier calibrations.
    estimates : sequence of Estimate
        What the trial made of it, with other parameters.
    covariance : ndarray, shape (P, P)
        Joint covariance of `estimates`.
    """
    sensors = {id(prior): (section.upper(), prior) for section, prior in trial.priors.items()}
    for sensor, prior in sensors.values():
        yield from _contradiction(sensor, prior, estimates, covariance)


def _contradiction(
    sensor: str, prior: JointPrior, estimates: Sequence[Estimate], covariance: Array
) -> Iterator[Finding]:
    ends = np.cumsum([e.value.size for e in estimates], dtype=int)
    own: list[int] = []
    before: list[int] = []
    names: list[str] = []
    for e, end in zip(estimates, ends, strict=True):
        if e.name in prior.values and np.any(e.prior_std > 0.0):
            own += range(end - e.value.size, end)
            before += np.arange(len(prior.covariance))[prior.rows(e.name)].tolist()
            names += e.component_names
    if not own:
        return
    mean = np.concatenate([np.ravel(v) for v in prior.values.values()])[before]
    value = np.concatenate([e.value for e in estimates])[own]
    P0 = prior.covariance[np.ix_(before, before)]
    # Of a bias that walks the prior is that of its start, and the estimate its mean.
    of_mean = np.concatenate([e.prior_std * (e.name in BIASES) for e in estimates])[own] ** 2
    P0[np.diag_indices_from(P0)] = np.maximum(np.diag(P0), of_mean)
    P = covariance[np.ix_(own, own)]
    test = prior_against_data(mean, P0, value, P)
    p = test.probability
    if p >= DOUBTFUL_P:
        return
    std, after = np.sqrt(np.diag(P0)), np.sqrt(np.diag(P))
    # The same test of one component alone.
    scale = np.maximum(std, np.finfo(float).tiny)
    informed = 1.0 - (after / scale) ** 2
    apart = np.where(informed > _LEAST_SHARE, np.abs(value - mean) / scale, 0.0)
    i = int(np.argmax(apart / np.sqrt(np.maximum(informed, _LEAST_SHARE))))
    alone: Message | str = ""
    if np.isfinite(test.std[i]):
        alone = message("prior_contradicted.alone", value=test.value[i], std=test.std[i])
    yield Finding(
        Code.PRIOR_CONTRADICTED,
        message(
            "prior_contradicted.by_trial",
            source=prior.source,
            statistic=test.statistic,
            freedom=test.freedom,
            probability=p,
            name=names[i],
            before=mean[i],
            before_std=std[i],
            alone=alone,
            value=value[i],
            std=after[i],
        ),
        sensor=sensor,
        parameter=next(e.name for e in estimates if names[i] in e.component_names),
        severity="error" if p < CONTRADICTED_P else "warning",
    )
