"""Nine-state filter, extended and unscented: bias, per-axis scale error, misalignment of a DVL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.baselines.outcome import Estimated, Outcome, history_rows, prior_of
from factorgraph_dvl.baselines.point_sets import Points, misfit, rotation_starts
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate, skew
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import SCALES_SPEC
from factorgraph_dvl.sensors.parameters import Parameter

# Chosen: prior standard deviation of the bias, m/s, where the trial fixes it: the method
# estimates it always.
_BIAS_SIGMA = 0.5
# Chosen: passes over the data at most, and halvings of a step that does not lower the cost.
_PASSES = 50
_HALVINGS = 12
# Chosen: step, in standard deviations, at which the filter has converged.
_CONVERGED = 1e-3


def nine_state(
    points: Points,
    misalignment: Parameter,
    scale: Parameter,
    bias: Parameter,
    lever_arm: Array,
    *,
    iterated: bool = True,
) -> Outcome:
    """Calibrate with the nine-state filter.

    Parameters
    ----------
    points : Points
        The two point sets.
    misalignment, scale, bias : Parameter
        Parameters with their priors; the bias gets a prior of 0.5 m/s where the trial has none.
    lever_arm : ndarray, shape (3,)
        Lever arm of the DVL, m, taken as known.
    iterated : bool, default True
        False = the plain linear filter, about the prior mean.
    """
    parameters, findings = with_bias(misalignment, scale, bias)
    prior = prior_of(parameters)
    free = np.flatnonzero(prior.covariance.diagonal() > 0.0)
    starts = rotation_starts(misalignment) if iterated else rotation_starts(misalignment)[:1]
    at = prior
    if len(starts) > 1:
        few = points.thinned()
        ends = [
            _iterate(few, prior, replace(prior, values=(R, *prior.values[1:])), lever_arm, free)[0]
            for R in starts
        ]
        fits = [misfit(few, e, lever_arm) if e.values[1].min() > -0.5 else np.inf for e in ends]
        at = ends[int(np.argmin(fits))]
    if iterated:
        at, passes, converged = _iterate(points, prior, at, lever_arm, free)
    else:
        passes, converged = 1, True
    steps, covariances, data = _pass(points, prior, at, lever_arm, free)
    after = [_moved(at, steps[i], covariances[i], free) for i in range(len(steps))]
    rows = history_rows(len(points))
    history = tuple((float(points.time[i]), after[k]) for k, i in enumerate(rows.tolist()))
    names = [name for p in parameters for name in p.component_names]
    sigma = np.concatenate([p.sigma for p in parameters])
    unseparated = frozenset(names[i] for i in free[_undetermined(data, sigma[free])])
    mixed = [n for n in names[3:] if n in unseparated]
    if mixed:
        findings.append(
            Finding(
                Code.NOT_OBSERVABLE,
                message(
                    "not_observable.because",
                    names=mixed,
                    reason=message("not_observable.bias_and_scale"),
                ),
                parameter=bias.name,
            )
        )
    final = after[-1] if after else at
    return Outcome(final, passes, history, tuple(findings), unseparated, converged)


def with_bias(
    misalignment: Parameter, scale: Parameter, bias: Parameter
) -> tuple[tuple[Parameter, Parameter, Parameter], list[Finding]]:
    """Return the parameters of the nine states, and what the user must know of them."""
    findings = []
    if not bias.estimated:
        bias = replace(bias, sigma=np.full(3, _BIAS_SIGMA))
        findings.append(
            Finding(
                Code.METHOD_LIMITS,
                message("method_limits.bias", std=_BIAS_SIGMA),
                parameter=bias.name,
            )
        )
    scale = replace(
        scale,
        mean=np.broadcast_to(scale.mean, 3).copy(),
        sigma=np.broadcast_to(scale.sigma, 3).copy(),
        spec=SCALES_SPEC,
    )
    return (misalignment, scale, bias), findings


def _iterate(
    points: Points,
    prior: Estimated,
    at: Estimated,
    lever_arm: Array,
    free: np.ndarray,
    most: int = _PASSES,
) -> tuple[Estimated, int, bool]:
    """Return the fixed point of the filter, passes, and whether it has converged."""
    # Weights that move with the estimate would make the cost jump.
    R = points.covariance_d(at.values[0], lever_arm)
    now = _linear(points, prior, at, lever_arm, free, R)
    for count in range(1, most + 1):
        P = np.linalg.inv(now.prior_information + now.each.sum(axis=0))
        step = P @ (now.prior_vector + now.vector.sum(axis=0))
        converged = bool(np.all(np.abs(step) < _CONVERGED * np.sqrt(P.diagonal())))
        for _ in range(_HALVINGS):
            moved = _moved(at, step, P, free)
            new = _linear(points, prior, moved, lever_arm, free, R)
            if converged or new.cost < now.cost:
                break
            step = 0.5 * step
        else:
            return at, count, False
        at, now = moved, new
        if converged:
            return at, count, True
    return at, most, False


@dataclass(frozen=True)
class _Linear:
    """Information and its vector about a point: of the prior, and of each ping."""

    prior_information: Array
    prior_vector: Array
    each: Array
    vector: Array
    cost: float


def _linear(
    points: Points, prior: Estimated, at: Estimated, lever_arm: Array, free: np.ndarray, R: Array
) -> _Linear:
    """Return the filter's model about `at`, for noise of covariance R, (M, 3, 3)."""
    dRb, a, b = at.values
    v = rotate(dRb[None], points.at_dvl(lever_arm))
    H = np.zeros((len(points), 3, 9))
    H[:, :, 0:3] = -(1.0 + a)[:, None] * (dRb @ skew(points.at_dvl(lever_arm)))
    H[:, :, 3:6] = v[:, :, None] * np.eye(3)
    H[:, :, 6:9] = np.eye(3)
    residual = points.v_d - (1.0 + a) * v - b
    weighted = np.linalg.solve(R, H[:, :, free])
    from_prior = np.concatenate(
        [log_so3(dRb.T @ prior.values[0]), prior.values[1] - a, prior.values[2] - b]
    )
    first = np.linalg.inv(prior.covariance[np.ix_(free, free)])
    from_prior = from_prior[free]
    fit = np.linalg.solve(R, residual[:, :, None])[:, :, 0]
    return _Linear(
        prior_information=first,
        prior_vector=first @ from_prior,
        each=weighted.transpose(0, 2, 1) @ H[:, :, free],
        vector=np.matmul(weighted.transpose(0, 2, 1), residual[:, :, None])[:, :, 0],
        cost=float(from_prior @ first @ from_prior + np.sum(residual * fit)),
    )


def _pass(
    points: Points, prior: Estimated, at: Estimated, lever_arm: Array, free: np.ndarray
) -> tuple[Array, Array, Array]:
    """Return steps and covariances of the filter after pings of a history, and data alone.

    With constant states the filter adds up information, so its state after each ping is a
    running sum from_prior.
    """
    R = points.covariance_d(at.values[0], lever_arm)
    model = _linear(points, prior, at, lever_arm, free, R)
    rows = history_rows(len(points))
    P = np.linalg.inv(model.prior_information + np.cumsum(model.each, axis=0)[rows])
    vector = model.prior_vector + np.cumsum(model.vector, axis=0)[rows]
    steps = np.matmul(P, vector[:, :, None])[:, :, 0]
    return steps, P, model.each.sum(axis=0)


def _moved(at: Estimated, step: Array, P: Array, free: np.ndarray) -> Estimated:
    full = np.zeros(9)
    full[free] = step
    covariance = np.zeros((9, 9))
    covariance[np.ix_(free, free)] = P
    dRb, a, b = at.values
    values = (dRb @ exp_so3(full[:3]), a + full[3:6], b + full[6:9])
    return Estimated(at.parameters, values, covariance)


def _undetermined(information: Array, sigma: Array) -> np.ndarray:
    """Return which components the data alone determine no better than to half the prior."""
    scaled = information * np.outer(sigma, sigma)
    std = np.sqrt(np.diag(np.linalg.inv(scaled + 1e-6 * np.eye(sigma.size))))
    return np.asarray(std > 0.5)


# Squared distance of the sigma points, in standard deviations: that of a normal distribution's
# fourth moment. Measured at 30 deg: an error of 0.3 deg with it, of 4.4 deg with 9 (kappa = 0).
_SPREAD = 3.0
# Chosen: prior standard deviation of an angle up to which sigma points stay within 180 deg.
_WIDEST = 60.0 * DEG


def unscented(
    points: Points,
    parameters: tuple[Parameter, Parameter, Parameter],
    lever_arm: Array,
    findings: Sequence[Finding],
) -> Outcome:
    """Calibrate with the unscented filter, in one pass.

    Parameters
    ----------
    points : Points
        The two point sets.
    parameters : tuple of (Parameter, Parameter, Parameter)
        Misalignment, three scale errors and bias, with their priors.
    lever_arm : ndarray, shape (3,)
        Lever arm of the DVL, m, taken as known.
    findings : sequence of Finding
        What is already known.

    Raises
    ------
    ConfigError
        If the misalignment may be anything.
    """
    if parameters[0].sigma.max() > _WIDEST:
        raise ConfigError(
            "the unscented filter needs an approximate misalignment",
            where="trial.yaml dvl.misalignment_std_deg",
            expected=f"at most {_WIDEST / DEG:.0f}",
            hint="Use --method nine-state, which finds misalignments of any size",
        )
    prior = prior_of(parameters)
    D, x, P = prior.values[0], np.concatenate(prior.values[1:]), prior.covariance.copy()
    free = np.flatnonzero(P.diagonal() > 0.0)
    v = points.at_dvl(lever_arm)
    keep = set(history_rows(len(points)).tolist())
    history = []
    for k in range(len(points)):
        root = np.zeros((9, free.size))
        root[free] = np.sqrt(_SPREAD) * np.linalg.cholesky(P[np.ix_(free, free)])
        spread = np.concatenate([root.T, -root.T])
        turned = exp_so3(spread[:, :3]) @ v[k]
        z = (1.0 + x[:3] + spread[:, 3:6]) * (turned @ D.T) + x[3:] + spread[:, 6:]
        middle = (1.0 + x[:3]) * (D @ v[k]) + x[3:]
        mean = middle + (z - middle).sum(axis=0) / (2.0 * _SPREAD)
        # The middle has no weight in covariances (beta = 2), which so stay positive.
        off = z - mean
        R = D @ points.v_b_covariance[k] @ D.T + np.diag(points.sigma_d[k] ** 2)
        S = off.T @ off / (2.0 * _SPREAD) + R
        K = np.linalg.solve(S, off.T @ spread / (2.0 * _SPREAD)).T
        step = K @ (points.v_d[k] - mean)
        P = P - K @ S @ K.T
        P = 0.5 * (P + P.T)
        D, x = D @ exp_so3(step[:3]), x + step[3:]
        if k in keep:
            history.append((float(points.time[k]), Estimated(parameters, (D, x[:3], x[3:]), P)))
    final = Estimated(parameters, (D, x[:3], x[3:]), P)
    return Outcome(final, 1, tuple(history), tuple(findings))
