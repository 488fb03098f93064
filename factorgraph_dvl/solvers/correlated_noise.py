"""Correlated noise of the sensors: found in the residuals, or stated by the trial."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from factorgraph_dvl.estimates import Noise, NoiseBySpeed, noise_name
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process, node_times, walk_sigma, walk_time
from factorgraph_dvl.sensors.protocol import Observation, ScaleWalk
from factorgraph_dvl.solvers.levenberg_marquardt import factorized
from factorgraph_dvl.statistics.correlation import Correlation, fit_correlation
from factorgraph_dvl.statistics.leverage import leverage
from factorgraph_dvl.statistics.variance_components import LEAST_FACTOR

# Correlation time, s, below which noise is no process: white noise of its long-run variance takes
# its place. Measured: with 4 s, and noise that is correlated over 5 s, σ was 2 to 5 times too
# large under sway; nodes every 0.7 s cost a fifth more time.
_SHORT = 2.0
# Share of the shortest time that the trajectory follows, up to which residuals show how short a
# correlation time is, and the time from which the whole graph finds a longer one. Measured:
# noise of a DVL over 5 s looked like 1 s beside a tactical IMU, and positions were 2 sigma off.
_SEEN_SHARE = 0.3
_START_TIME = 4.0
# Correlation times in a trial below which only the density 2 σ² / τ can be
# estimated. Measured: σ alone is then uncertain by a factor.
_MANY = 20.0
# Standard deviations of a sample variance by which residuals must show less noise than is stated.
# Chosen: a few in a thousand records are taken for what they are not.
_SURE = 3.0
# More nodes that a process gets where its strength asks for more. Chosen: what interpolation
# between its nodes leaves out is at most twice what white noise leaves of a mean.
_CLOSER = 1.4
# Measurements, s, below which correlation is not searched. Chosen: trials with rival minima, whose
# costs compare only under one model, last up to 30 s.
_SHORTEST = 29.0


@dataclass(frozen=True)
class CorrelatedNoise:
    """Correlated noise of a problem's observations.

    Parameters
    ----------
    processes : tuple of Process
        Errors that persist for longer than the interval of the states.
    factors : mapping of str to ndarray
        Factors (d,) of each label on the standard deviations of the white noise that is left.
    long_run : mapping of str to ndarray
        Factors (d,) of each label on standard deviations for noise that persists for seconds.
    gain : float
        Fall of -2 log likelihood by what is not stated, against white noise alone.
    long_run_gain : float
        The part of it by noise that persists for seconds.
    """

    processes: tuple[Process, ...]
    factors: dict[str, Array]
    long_run: dict[str, Array]
    gain: float
    long_run_gain: float


def correlated_noise(
    problem: Problem, evaluation: Evaluation, estimated: Collection[str]
) -> CorrelatedNoise:
    """Return the correlated noise that a trial states, or that residuals show.

    Parameters
    ----------
    problem : Problem
        Its measurements count as if their noise were white.
    evaluation : Evaluation
        Its minimum.
    estimated : collection of str
        Labels of the observations whose noise may be estimated.
    """
    processes: list[Process] = []
    factors: dict[str, Array] = {}
    long_run: dict[str, Array] = {}
    gain = long_run_gain = 0.0
    for i, o in enumerate(problem.observations):
        weight = problem.weights[i]
        used = weight > 0.0
        if not o.noise_groups or used.any(axis=1).sum() < 2:
            continue
        sigma = _typical(weight)
        when = _used_time(problem, i)
        stated = o.correlated
        process = None
        if stated is not None and stated.sigma is not None:
            tau = np.full(sigma.size, stated.time)
            nodes = node_times(when, stated.time, stated.sigma, sigma)
            short = float(np.ptp(when)) < _MANY * stated.time
            least = stated.sigma if short else None
            process = Process(o.label, len(processes), stated.sigma, tau, nodes, least)
        elif o.label in estimated and np.ptp(when) >= _SHORTEST:
            residuals = np.where(used, evaluation.residuals[i], np.nan)
            found = _fits(o, residuals)
            factor = problem.noise_factors.get(o.label, 1.0)
            share = _unseen(o, residuals * factor, found, when)
            if found:
                if any(fit.time_s < _SHORT for fit in found.values()):
                    followed = _followed_time(problem, evaluation, i)
                    found = _as_followed(o.noise_groups, found, followed)
                rms = np.sqrt(np.nanmean(residuals**2, axis=0))
                process, white, inflation = _model(o, found, sigma, rms, when, len(processes))
                factors[o.label] = white
                gain += sum(fit.gain for fit in found.values())
                if (inflation != 1.0).any():
                    long_run[o.label] = inflation
                    long_run_gain += sum(f.gain for f in found.values() if f.time_s < _SHORT)
            if share.any():
                missing = share * sigma / factor
                process = _with_unseen(process, o, missing, sigma, when, len(processes))
                # White and persisting noise together are what is stated.
                white = factors.get(o.label, np.ones(sigma.size) * factor)
                shown = np.maximum(np.sqrt(1.0 - share**2), LEAST_FACTOR)
                factors[o.label] = np.where(share > 0.0, shown, white)
        if o.scale_walk is not None and o.scale_walk.rate > 0.0 and np.ptp(when) > 0.0:
            process = _walking(process, o.label, len(processes), o.scale_walk, sigma, when)
        if process is not None and problem.chain.interpolates and o.unit == "rad":
            process = _beside_motion(process, when)
        if process is not None:
            processes.append(process)
    return CorrelatedNoise(tuple(processes), factors, long_run, gain, long_run_gain)


def _unseen(
    o: Observation,
    residuals: Array,
    found: Collection[tuple[int, ...]],
    time: Array,
) -> Array:
    """Return which share of the stated deviation persists although residuals do not show it, (d,).

    Over a record as short as its correlation time the trajectory follows what persists. What
    residuals lack of the stated variance is there all the same.

    Parameters
    ----------
    o : Observation
        Whose correlation time may be expected.
    residuals : ndarray, shape (M, d)
        Residuals in stated standard deviations; nan where a component was not used.
    found : collection of tuple of int
        Groups of components of which residuals show what persists.
    time : ndarray, shape (K,), s
        When it was used.
    """
    missing = np.zeros(len(o.components))
    if o.correlated is None or np.ptp(time) > _MANY * o.correlated.time:
        return missing
    for group in set(o.noise_groups).difference(found):
        own = residuals[:, list(group)]
        count = int(np.isfinite(own).sum())
        missing[list(group)] = _lack(float(np.nansum(own**2)) / max(count, 1), count)
    return missing


def _lack(shown: float, count: int) -> float:
    """Return which share of a deviation a variance lacks that so many residuals show of it."""
    lack = 1.0 - shown
    return float(np.sqrt(lack)) if count and lack > _SURE * np.sqrt(2.0 / count) else 0.0


def _used_time(problem: Problem, i: int) -> Array:
    """Return when an observation is used, s; outliers may be used later, and count."""
    o = problem.observations[i]
    outlier = problem.robust_weights.get(o.label, np.ones(1)) == 0.0
    return np.asarray(o.time[((problem.weights[i] > 0.0) | outlier).any(axis=1)])


def unseen_offsets(problem: Problem) -> dict[str, Array]:
    """Return which share of a position's stated deviation no residual shows, (d,) by label.

    Where neither white noise nor a process explains it, the trajectory follows it.
    """
    out = {}
    for o, weight in zip(problem.observations, problem.weights, strict=True):
        factor = problem.noise_factors.get(o.label)
        if factor is None or o.correlated is None or o.unit != "m":
            continue
        persists = [p.sigma for p in problem.processes if p.label == o.label]
        share = np.zeros(factor.size)
        for group in o.noise_groups:
            own = list(group)
            count = int(np.count_nonzero(weight[:, own]))
            if not any(sigma[own].any() for sigma in persists):
                share[own] = _lack(float(np.mean(factor[own] ** 2)), count)
        if share.any():
            out[o.label] = share
    return out


def _with_unseen(
    process: Process | None, o: Observation, missing: Array, sigma: Array, time: Array, index: int
) -> Process:
    """Return a process with a deviation (d,) that residuals do not show in some components."""
    assert o.correlated is not None
    tau = np.full(sigma.size, o.correlated.time)
    own = missing > 0.0
    if process is not None:
        missing = np.where(own, missing, process.sigma)
        tau = np.where(own, tau, process.tau)
    nodes = _node_times(time, missing, tau, sigma)
    return Process(o.label, index, missing, tau, nodes, least_sigma=missing)


def _walking(
    process: Process | None, label: str, index: int, walk: ScaleWalk, sigma: Array, time: Array
) -> Process:
    """Return a process with a scale that walks: the one there is, or one of the scale alone."""
    if process is None:
        tau = walk_time(time)
        most = np.max(np.abs(walk.measured), axis=0) * walk_sigma(walk, tau)
        nodes = node_times(time, tau, most, sigma)
        process = Process(label, index, np.zeros(sigma.size), np.ones(sigma.size), nodes)
    return replace(process, walk=walk)


def walking_alone(problem: Problem, i: int, index: int, walk: ScaleWalk) -> Process:
    """Return a scale of an observation that walks, whose rate is to be estimated, as a process.

    Parameters
    ----------
    problem : Problem
        Its measurements are weighed.
    i, index : int
        Number of the observation, and index of the process.
    walk : ScaleWalk
        The walk to start from.
    """
    sigma, when = _typical(problem.weights[i]), _used_time(problem, i)
    label = problem.observations[i].label
    return replace(_walking(None, label, index, walk, sigma, when), free=True)


def _beside_motion(process: Process, time: Array) -> Process:
    """Return an error of attitudes with nodes as far apart as its correlation time allows.

    Without an IMU, close nodes follow the motion itself. Measured: with nodes every 8 s, a heading
    error of 0.7 deg over 300 s took 64 off -2 log of the likelihood of four hours in a seaway, in
    which there was none; with nodes every 100 s it adds 26.
    """
    unseen = np.full(process.sigma.size, np.inf)
    return replace(process, time=_node_times(time, process.sigma, process.tau, unseen))


def _node_times(time: Array, sigma: Array, tau: Array, white: Array) -> Array:
    """Return times of nodes that serve all components (d,) that have a deviation."""
    active = sigma > 0.0
    return node_times(time, float(tau[active].min()), sigma[active], white[active])


def _typical(weight: Array) -> Array:
    """Return the median standard deviation of each component, 0 where none was used."""
    return np.array([1.0 / np.median(w[w > 0.0]) if w.any() else 0.0 for w in weight.T])


def _fits(o: Observation, residuals: Array) -> dict[tuple[int, ...], Correlation]:
    """Return the correlation of each group of components that has any."""
    expected = None if o.correlated is None else o.correlated.time
    out = {}
    for group in o.noise_groups:
        fit = fit_correlation(o.time, residuals[:, list(group)], expected_time_s=expected)
        if fit is not None and fit.white + fit.correlated > LEAST_FACTOR**2:
            out[group] = fit
    return out


def _followed_time(problem: Problem, evaluation: Evaluation, i: int) -> Array:
    """Return the time (d,), s, over which the trajectory follows each component of a sensor.

    Residuals have lost as many degrees of freedom as leverages sum up to: what is slower than the
    frequency that they fill, half of their number over the length of the record.
    """
    o = problem.observations[i]
    information = factorized(problem, evaluation)[0]
    followed = np.zeros(len(o.components))
    of_sensor = partial(filter, lambda rows: rows.source == o.label)
    parts = leverage(
        lambda: of_sensor(problem.observation_rows(evaluation)),
        evaluation.residuals[i].size,
        information,
    )
    for _, h in parts:
        followed += h.sum(axis=0)
    return float(np.ptp(o.time)) / (np.pi * np.maximum(followed, 1.0))


def _as_followed(
    groups: tuple[tuple[int, ...], ...],
    found: Mapping[tuple[int, ...], Correlation],
    followed: Array,
) -> dict[tuple[int, ...], Correlation]:
    """Return fits with a time to start from where the trajectory follows what is slower.

    There, noise of some components may seem to be white: it starts with the least correlated of
    the fits, and the graph finds how much of it there is.
    """
    out = dict(found)
    least = min(found.values(), key=lambda fit: fit.correlated)
    for group in groups:
        fit = found.get(group, least)
        if fit.time_s > _SEEN_SHARE * followed[list(group)].min():
            out[group] = replace(fit, time_s=max(fit.time_s, _START_TIME))
    return out


def _model(
    o: Observation,
    found: Mapping[tuple[int, ...], Correlation],
    sigma: Array,
    rms: Array,
    time: Array,
    index: int,
) -> tuple[Process | None, Array, Array]:
    """Return the process of an observation, and factors on its white noise and for seconds."""
    size = sigma.size
    white, inflation = np.ones(size), np.ones(size)
    process_sigma, tau = np.zeros(size), np.ones(size)
    times = [fit.time_s for fit in found.values()]
    longest = max(times) if o.correlated is None else max(*times, o.correlated.time)
    density_only = o.correlated is not None and float(np.ptp(time)) < _MANY * longest
    for group, fit in found.items():
        own = list(group)
        white[own] = max(np.sqrt(fit.white), LEAST_FACTOR)
        if fit.time_s < _SHORT:
            white[own] = np.sqrt(fit.white + fit.correlated)
            inflation[own] = np.sqrt(fit.long_run_factor(float(np.median(np.diff(time)))))
            continue
        process_sigma[own], tau[own] = sigma[own] * np.sqrt(fit.correlated), fit.time_s
        if density_only:
            total = sigma[own] * max(1.0, float(rms[own].max()))
            tau[own] *= (total / process_sigma[own]) ** 2
            process_sigma[own] = total
    if not process_sigma.any():
        return None, white, inflation
    active = process_sigma > 0.0
    tau[~active] = tau[active].max()
    nodes = _node_times(time, process_sigma, tau, sigma * white)
    least = process_sigma if density_only else None
    process = Process(o.label, index, process_sigma, tau, nodes, least)
    return process, white, inflation


def with_others(before: Sequence[Process], found: Sequence[Process]) -> tuple[Process, ...]:
    """Return processes as they were, with others that were found."""
    known = {p.label for p in before}
    free = (i for i in range(len(before) + len(found)) if i not in {p.index for p in before})
    others = (p for p in found if p.label not in known)
    return (*before, *(replace(p, index=i) for p, i in zip(others, free, strict=False)))


def with_closer_nodes(process: Process, problem: Problem, change: Mapping[str, Array]) -> Process:
    """Return a process with the nodes that its strength asks for, where these are far more.

    Parameters
    ----------
    process : Process
        Its deviation and time were found anew.
    problem : Problem
        What it is a process of.
    change : mapping of str to ndarray
        Factors (d,) on the white noise of each label, relative to what is applied.
    """
    labels = [o.label for o in problem.observations]
    if process.label not in labels or not process.sigma.any():
        return process
    i = labels.index(process.label)
    white = _typical(problem.weights[i]) * change.get(process.label, 1.0)
    nodes = _node_times(_used_time(problem, i), process.sigma, process.tau, white)
    if nodes.size < _CLOSER * process.time.size:
        return process
    return replace(process, time=nodes)


def noise_of(problem: Problem) -> tuple[Noise, ...]:
    """Return the noise of each observation against what is stated of it."""
    out = []
    for o, weight in zip(problem.observations, problem.weights, strict=True):
        if o.label not in problem.noise_factors:
            continue
        factor = problem.noise_factors[o.label]
        time, std = None, None
        for process in problem.processes:
            if process.label == o.label and process.sigma.any():
                applied = factor * problem.long_run.get(o.label, 1.0)
                stated = whole = _typical(weight) / applied
                if o.correlated is not None and o.correlated.sigma is not None:
                    whole = np.hypot(stated, o.correlated.sigma)
                known = whole > 0.0
                white, share = (
                    np.divide(each, whole, out=np.zeros(known.size), where=known)
                    for each in (factor * stated, process.sigma)
                )
                # Where only the density is known, its deviation is that of the whole.
                join = np.maximum if process.density_only else np.hypot
                factor = join(white, share)
                time = np.where(process.sigma > 0.0, process.tau, np.nan)
                std = process.sigma
        by_speed = _by_speed(problem, o)
        out.append(Noise(noise_name(o.label), factor, time, std, by_speed))
    return tuple(out)


def _by_speed(problem: Problem, o: Observation) -> NoiseBySpeed | None:
    """Return both parts of the noise of a velocity log, None where they are as stated."""
    growth = problem.noise_growth.get(o.label)
    if growth is None or o.noise_by_speed is None:
        return None
    factors = growth * np.sqrt(np.mean(problem.noise_factors[o.label] ** 2))
    std, fraction = (factors * o.noise_by_speed).tolist()
    return NoiseBySpeed(std, fraction, *o.noise_by_speed)
