"""When a calibration was good enough: from what was known at each time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.analysis.error_statistics import true_value_of
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class ComponentConvergence:
    """How a component converged.

    Parameters
    ----------
    name : str
        Name of the component.
    good_std, good_error : float
        Limits, in its unit.
    std_since : float
        Time from which on its standard deviation stayed below the limit, s; nan = never.
    error_since : float
        The same of its error against the truth; nan also where that is unknown.
    """

    name: str
    good_std: float
    good_error: float
    std_since: float
    error_since: float


@dataclass(frozen=True)
class Convergence:
    """How a calibration converged.

    Parameters
    ----------
    components : tuple of ComponentConvergence
        Those with a limit.
    good_since : float
        Time from which on all standard deviations stayed below their limits, and no measurements
        were contradictory, s; nan = never.
    """

    components: tuple[ComponentConvergence, ...]
    good_since: float


def convergence(
    time: Array,
    values: Array,
    std: Array,
    inconsistent: np.ndarray,
    estimates: Sequence[Estimate],
    truth: Mapping[str, ArrayLike],
    good_std: Mapping[str, float],
    good_error: Mapping[str, float],
) -> Convergence:
    """Return when each component stayed within its limits.

    Parameters
    ----------
    time : ndarray, shape (H,), s
        Times of the updates.
    values, std : ndarray, shape (H, n)
        What was known then, in the order of `estimates`.
    inconsistent : ndarray, shape (H,)
        Whether the standard deviations were not to be trusted.
    estimates : sequence of Estimate
        Estimates at the end.
    truth : mapping of str to array_like
        True values by reported name; may be empty.
    good_std, good_error : mapping of str to float
        Limits by reported name, in its unit.
    """
    out, column = [], 0
    all_good = ~inconsistent
    for e in estimates:
        true_value = true_value_of(e, truth)
        for i, name in enumerate(e.component_names):
            c = column + i
            limit = good_std.get(e.name)
            if limit is None or e.prior_std[i] == 0.0:
                continue
            error_limit = good_error.get(e.name, np.nan)
            error_since = np.nan
            if true_value is not None and np.isfinite(error_limit):
                error_since = _since(time, np.abs(values[:, c] - true_value[i]) <= error_limit)
            good = std[:, c] <= limit
            all_good = all_good & good
            out.append(
                ComponentConvergence(name, limit, error_limit, _since(time, good), error_since)
            )
        column += len(e.component_names)
    return Convergence(tuple(out), _since(time, all_good) if out else np.nan)


def check_limits(trial: Trial, limits: Iterable[str]) -> None:
    """Raise ConfigError if a limit is for something that a trial does not calibrate.

    Parameters
    ----------
    trial : Trial
        Trial whose sensors say what is estimated.
    limits : iterable of str
        Reported names.
    """
    inertial = () if trial.imu is None else trial.imu.parameters(0.0)
    sensors = (inertial, *(aid.parameters() for aid in trial.aids))
    known = [p.name for parameters in sensors for p in parameters if p.estimated]
    for name in limits:
        if name not in known:
            raise ConfigError(
                f"no parameter {name!r} is estimated", expected=f"one of {', '.join(known)}"
            )


def short_of_limits(
    estimates: Sequence[Estimate], good_std: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the components whose standard deviations are above their limits."""
    return tuple(
        name
        for e in estimates
        for i, name in enumerate(e.component_names)
        if e.name in good_std and e.prior_std[i] > 0.0 and e.std[i] > good_std[e.name]
    )


def _since(time: Array, good: np.ndarray) -> float:
    """Return the time from which on all is good, nan if the last is not."""
    if good.size == 0 or not good[-1]:
        return float("nan")
    bad = np.flatnonzero(~good)
    return float(time[bad[-1] + 1] if bad.size else time[0])
