"""Findings of a result: residuals that do not fit, values far from priors, outliers, ambiguity."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import chdtrc

from factorgraph_dvl.estimates import (
    Estimate,
    Hypothesis,
    Noise,
    NoiseBySpeed,
    Residuals,
    noise_name,
)
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding, Severity
from factorgraph_dvl.quality.scale_causes import scale_cause
from factorgraph_dvl.sensors.averaging import is_window
from factorgraph_dvl.sensors.protocol import Aid

# Factors by which residuals are larger than stated from which on every standard deviation is too
# small, and the model another than the data's. Chosen: sums of some hundred residuals stay below
# the first by chance, and no data sheet is wrong by the second.
TOO_LARGE = 1.3
DO_NOT_FIT = 10.0
# Scale errors of velocity logs, the largest that one has, and the standard deviations beyond it
# that are no chance. Chosen: a sound speed of 1500 m/s in fresh water of 5 °C makes 5 %.
_SCALES = ("scale_error", "beam_scale_error")

_LARGEST_SCALE = 0.05

_CERTAIN = 3.0

# Standard deviations between prior and data that are no chance. Chosen: its probability is 6e-7.
_FAR_FROM_PRIOR = 5.0

# Standard deviations by which a wrong prior may draw a value. Chosen: one is within what is
# claimed.
_DRAWS = 1.0

# Factors on a stated noise that no one need look into. Chosen: data sheets are as far off.
NOISE_FACTORS = (0.5, 2.0)

# Share of the prior's standard deviation that may be left for the data to say anything. Chosen:
# they are then at most three times less sharp than the prior; of less, errors of the model that
# hardly matter make a contradiction.
_INFORMED = 0.95

# Root mean square of normalised residuals from which on a filter has not converged. Chosen: noise
# stated half as large as it is.
CONTRADICTS = 2.0

# Probability of a few values that are so large by chance.
_CHANCE = 1e-3

# Share of outliers from which on they are a contradiction. Chosen: a good log has some.
_MANY_OUTLIERS = 0.02

# Windows of outliers that a finding lists, and time between two of them, s. Chosen: a line's
# length, and the time in which rejected measurements make a window.
_LISTED = 5

_APART = 10.0


def consistency_findings(
    estimates: Sequence[Estimate], residuals: Sequence[Residuals], noise: Sequence[Noise] = ()
) -> list[Finding]:
    """Return findings where a solution contradicts what was stated before.

    Residuals that are larger than stated make every reported standard deviation too small,
    unless their noise was estimated; a value far outside its prior says that prior or data are
    wrong.
    """
    estimated = {n.name: n for n in noise}
    out = []
    for e in estimates:
        out += _far_from_prior(e) + _impossible_scale(e)
    for r in residuals:
        out += _size_of_residuals(r, estimated.get(noise_name(r.label)))
    return out


def _size_of_residuals(r: Residuals, noise: Noise | None) -> list[Finding]:
    """Return a finding where residuals are larger or smaller than stated."""
    factor = None if noise is None else noise.factor
    stated = r.sigma if factor is None else r.sigma / factor
    square = (r.residual / stated) ** 2
    rms = float(np.sqrt(np.nanmean(square))) if r.time.size else 0.0
    least = 1.0 if factor is None else float(np.nanmin(factor))
    small = least < NOISE_FACTORS[0]
    # Standard deviations are stated for all components together.
    apart = factor is not None and bool(np.nanmax(factor) > NOISE_FACTORS[1] * np.nanmin(factor))
    if noise is not None and noise.by_speed is not None and rms <= DO_NOT_FIT and not apart:
        usual = not small and bool(np.nanmax(noise.factor) <= NOISE_FACTORS[1])
        return [_by_speed(r.label, noise.by_speed, usual=usual)]
    if rms <= TOO_LARGE:
        text = message("small_residuals.noise", ratio=least)
        return [Finding(Code.SMALL_RESIDUALS, text, sensor=r.label)] if small else []
    code, key = Code.DOES_NOT_FIT, "does_not_fit.residuals"
    severity = code.severity
    if rms <= DO_NOT_FIT:
        code = Code.LARGE_RESIDUALS
        key = "large_residuals.stated" if factor is None else "large_residuals.estimated"
        large = np.zeros(0) if noise is None else noise.factor[~_by_chance(r, noise)]
        allowed = noise is not None and not np.nanmax(large, initial=0.0) > NOISE_FACTORS[1]
        severity = "note" if allowed else "warning"
    text = message(key, ratio=rms)
    if small:
        # One number for both, by component.
        enter = np.sqrt(np.nanmean(square, axis=0)) * np.nanmedian(stated, axis=0)
        text = message(
            "large_residuals.and_small",
            large=text,
            small=least,
            values=enter,
            unit=r.unit,
            components=list(r.components),
        )
    elif apart and code == Code.LARGE_RESIDUALS:
        text = message(
            "large_residuals.by_component",
            large=text,
            factors=factor,
            components=list(r.components),
        )
    return [Finding(code, text, sensor=r.label, severity=severity)]


def _by_speed(label: str, noise: NoiseBySpeed, *, usual: bool) -> Finding:
    """Return what the noise of a velocity log is, and whether all of it is as data sheets are."""
    text = message(
        "large_residuals.by_speed",
        std=noise.std,
        fraction=noise.fraction,
        stated_std=noise.stated_std,
        stated_fraction=noise.stated_fraction,
    )
    severity: Severity = "note" if usual else "warning"
    larger = noise.std > noise.stated_std or noise.fraction > noise.stated_fraction
    code = Code.LARGE_RESIDUALS if larger else Code.SMALL_RESIDUALS
    return Finding(code, text, sensor=label, severity=severity)


def _by_chance(r: Residuals, noise: Noise) -> BoolArray:
    """Return where what persists may have become that large by chance, (d,).

    A record of length T has about 1 + T / (2 τ) independent values of a first-order process.
    """
    if noise.correlation_time is None:
        return np.zeros(noise.factor.size, dtype=bool)
    count = 1.0 + np.ptp(r.time) / (2.0 * noise.correlation_time)
    return np.asarray(chdtrc(count, count * noise.factor**2) > _CHANCE)


def _impossible_scale(e: Estimate) -> list[Finding]:
    """Return a finding if a scale error is larger than a velocity log has, unless stated so."""
    if e.spec.stem not in _SCALES:
        return []
    off = np.minimum(np.abs(e.value), np.abs(e.value - e.prior_value))
    if not (off - _CERTAIN * e.std > _LARGEST_SCALE).any():
        return []
    worst = int(np.argmax(off - _CERTAIN * e.std))
    value, std, name = e.value[worst], e.std[worst], e.component_names[worst]
    cause = scale_cause(float(value))
    if cause is None:
        limit = 100.0 * _LARGEST_SCALE
        text = message("impossible_scale.larger", name=name, value=value, std=std, limit=limit)
    else:
        text = message("impossible_scale.caused", name=name, value=value, std=std, cause=cause)
    return [Finding(Code.IMPOSSIBLE_SCALE, text, parameter=e.name)]


def is_far_from_prior(e: Estimate, value: Array) -> bool:
    """Whether a parameter would be far from its prior if it had another value, (n,)."""
    _, apart = _apart(e, value)
    return bool(np.max(apart, initial=0.0) > _FAR_FROM_PRIOR)


def _apart(e: Estimate, value: Array) -> tuple[BoolArray, Array]:
    """Return which components the data inform on, and by how many σ those are off their priors."""
    informed = e.std < _INFORMED * e.prior_std
    moved = np.abs(value - e.prior_value)[informed]
    return informed, moved / np.sqrt((e.prior_std**2 - e.std**2)[informed])


def _far_from_prior(e: Estimate) -> list[Finding]:
    """Return a finding if a component is far from its prior, by the data alone.

    The difference x - x0 of posterior and prior has the variance σ0² - σ²; without the prior
    x would be (x - x0) σ² / (σ0² - σ²) further deviation. The standard deviations by which other
    parameters would move are fewer. What is usual of a sensor that nothing is stated of, as the
    window over which it averages, is no prior that data contradict, nor is what is plausible.
    """
    plausible = e.spec.plausible is not None and np.allclose(e.prior_std, e.spec.plausible)
    if e.spec.usual or plausible:
        return []
    informed, apart = _apart(e, e.value)
    if not informed.any():
        return []
    worst = int(np.argmax(apart))
    if not apart[worst] > _FAR_FROM_PRIOR:
        return []
    moved = np.abs(e.value - e.prior_value)[informed]
    rest = (e.prior_std**2 - e.std**2)[informed]
    mean, prior_std, std = (x[informed][worst] for x in (e.prior_value, e.prior_std, e.std))
    gain = prior_std**2 / rest[worst]
    alone = mean + gain * (e.value[informed][worst] - mean)
    draws = moved[worst] * std / rest[worst]
    name = np.array(e.component_names)[informed][worst]
    effect = message("far_from_prior.outweighed")
    if draws > _DRAWS:
        effect = message("far_from_prior.moves", draws=draws)
    return [
        Finding(
            Code.FAR_FROM_PRIOR,
            message(
                "far_from_prior.data",
                name=name,
                value=alone,
                std=std * np.sqrt(gain),
                apart=apart[worst],
                prior=mean,
                prior_std=prior_std,
                effect=effect,
            ),
            parameter=e.name,
            severity="error" if draws > _DRAWS else "warning",
        )
    ]


def contradictions(residuals: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each sensor whose residuals a filter's covariance does not explain.

    Over the last half of them, when a filter should have converged. Residuals that are too
    small are none of this: a filter may be more careful than it needs.

    Parameters
    ----------
    residuals : sequence of Residuals
        Residuals with standard deviations that include those of the states, or innovations.
    """
    out = []
    for r in residuals:
        late = r.time >= np.median(r.time) if r.time.size else np.zeros(0, dtype=bool)
        z = (r.residual / r.sigma)[late]
        z = z[np.isfinite(z)]
        square = float(z @ z)
        if square > CONTRADICTS**2 * z.size and chdtrc(z.size, square) < _CHANCE:
            out.append(
                Finding(
                    Code.FILTER_CONTRADICTED,
                    message("filter_contradicted.residuals", ratio=np.sqrt(square / z.size)),
                    sensor=r.label,
                )
            )
    return out


def not_observable(estimate: Estimate, why: Callable[[int], Message | str]) -> list[Finding]:
    """Return a finding for each reason why components of an estimate are not observable.

    Parameters
    ----------
    estimate : Estimate
        Components that are fixed are left out.
    why : callable of int, Message
        The reason of a component, by its index.
    """
    reasons: dict[Message | str, list[str]] = {}
    for i in np.flatnonzero(~estimate.observable & (estimate.prior_std > 0.0)):
        reasons.setdefault(why(int(i)), []).append(estimate.component_names[i])
    return [
        Finding(
            Code.NOT_OBSERVABLE,
            message("not_observable.because", names=names, reason=reason),
            parameter=estimate.name,
        )
        for reason, names in reasons.items()
    ]


def outlier_findings(used: Sequence[Residuals], rejected: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each kind of measurement of which some are outliers."""
    kept = {r.label: r.time.size for r in used}
    out = []
    for label in dict.fromkeys(r.label for r in rejected):
        own = [r for r in rejected if r.label == label]
        count = sum(r.time.size for r in own)
        total = count + kept.get(label, 0)
        text = message("outliers.some", count=count, total=total)
        spans = [span for r in own if r.reason == "window" for span in _spans(r.time)]
        if spans:
            listed = [message("words.span", start=a, end=b) for a, b in spans[:_LISTED]]
            more: Message | str = ""
            if len(spans) > _LISTED:
                more = message("words.and_more", count=len(spans) - _LISTED)
            text = message("outliers.windows", count=count, total=total, windows=listed, more=more)
        severe = count > _MANY_OUTLIERS * total or bool(spans)
        out.append(
            Finding(Code.OUTLIERS, text, sensor=label, severity="warning" if severe else "note")
        )
    return out


def _spans(time: Array) -> list[tuple[float, float]]:
    """Return begin and end of the windows that times (M,) form."""
    ends = np.flatnonzero(np.diff(time) > _APART)
    first = np.concatenate([[0], ends + 1])
    last = np.concatenate([ends, [time.size - 1]])
    return [(float(time[a]), float(time[b])) for a, b in zip(first, last, strict=True)]


def mostly_rejected(used: Sequence[Residuals], rejected: Sequence[Residuals]) -> list[Finding]:
    """Return a finding for each kind of measurement of which over a third were rejected."""
    kept = {r.label: r.time.size for r in used}
    return [
        Finding(
            Code.MANY_REJECTED,
            message(
                "many_rejected.echoes",
                count=r.time.size,
                total=r.time.size + kept.get(r.label, 0),
            ),
            sensor=r.label,
        )
        for r in rejected
        if 2 * r.time.size > kept.get(r.label, 0)
    ]


def ambiguity(hypotheses: Sequence[Hypothesis]) -> list[Finding]:
    """Return a finding if more than one hypothesis is left."""
    living = [h for h in hypotheses if h.died is None]
    if len(living) < 2:
        return []
    first, second = living[:2]
    frame = LocalFrame(*first.trajectory.geodetic[-1])
    apart = float(np.linalg.norm(frame.position(*second.trajectory.geodetic[-1])))
    return [
        Finding(
            Code.AMBIGUOUS,
            message(
                "ambiguous.trajectories",
                count=len(living),
                weights=[h.weight for h in living],
                apart=apart,
            ),
        )
    ]


def errors_left_out(aids: Sequence[Aid]) -> list[Finding]:
    """Return findings of errors that sensors state and that are not estimated without an IMU."""
    return [_left_out(aid, key) for aid in aids for key in aid.settings.left_out]


def windows_left_out(aids: Sequence[Aid]) -> list[Finding]:
    """Return findings of windows that sensors state, where measurements are instantaneous."""
    windows = [(aid, key) for aid in aids for key in aid.settings.left_out if is_window(key)]
    return [_left_out(aid, key) for aid, key in windows]


def _left_out(aid: Aid, key: str) -> Finding:
    key_of_text = "error_left_out.window" if is_window(key) else "error_left_out.change"
    text = message(key_of_text, section=aid.section, name=key)
    return Finding(Code.ERROR_LEFT_OUT, text, sensor=aid.label)
