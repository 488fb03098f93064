"""Scores of parameters that change one record only, from the factorisation that there is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import gtsam
import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.bound_observation import BoundObservation
from factorgraph_dvl.graph.observation_rows import some_of
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.statistics.rows import add_transposed_product
from factorgraph_dvl.statistics.scores import Scores, places_of
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Measurements whose derivatives are there at once. Chosen: some ten megabytes.
_CHUNK = 4096
# Measurements that show a window, and in how many stretches. Chosen: a quarter of a second.
_ENOUGH, _STRETCHES = 10_000, 20
# Time between values that show a curvature, s. Chosen: they are the mean over 0.3 s within 2 %.
_BETWEEN = 0.1
# Means that are tried, and the longest of them over the length that curvature shows. Chosen: a
# motion within which a window holds whole periods looks as if it were a third as long.
_MEANS, _LONGEST = 20, 4.0
# Standard deviations from which on a misfit is one. Chosen: seldom by chance.
_CERTAIN = 3.0

# Returns derivatives (M, d, n) of some measurements of a record, by name of the parameter.
Derivatives = Callable[[IntArray, BoundObservation, Motion], Mapping[str, Array]]


@dataclass(frozen=True)
class RecordSums:
    """What the rows of a record say of parameters that change it alone, nothing eliminated.

    With J the whitened derivatives by C components, A those by all variables, r the residuals.

    Parameters
    ----------
    score : ndarray, shape (C,)
        -Jᵀ r.
    square : ndarray, shape (C, C)
        JᵀJ.
    by_key : dict of int to ndarray
        JᵀA, (C, size) by key.
    """

    score: Array
    square: Array
    by_key: dict[int, Array]


def record_scores(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    information: SquareRootInformation,
    candidates: Mapping[str, Array],
    motion: Motion,
    derivatives: Mapping[str, Array] = MappingProxyType({}),
) -> Scores:
    """Return scores and information of parameters that change one record only.

    With J the whitened derivatives by them, A those by all variables, P the covariance of these
    and r the residuals,

        S = -Jᵀ r,    I = JᵀJ - JᵀA P AᵀJ:

    the score tests of `statistics.scores`, at the price of no elimination.

    Parameters
    ----------
    problem : Problem
        Problem without these parameters.
    bound : BoundObservation
        The observation, or some of its measurements, weighed and attached.
    evaluation : Evaluation
        The minimum.
    information : SquareRootInformation
        Information on all variables there.
    candidates : mapping of str to ndarray
        Standard deviations (n,) of the wide prior of each, SI; they may be infinite.
    motion : Motion
        Motion where the observation is attached.
    derivatives : mapping of str to ndarray, optional
        Derivatives (M, d, n) by some of the parameters, in place of those of the observation.
    """
    sums = record_sums(problem, bound, evaluation, candidates, motion, derivatives)
    return scores_of(sums, information, candidates)


def scores_of(
    sums: RecordSums,
    information: SquareRootInformation,
    candidates: Mapping[str, Array],
    step: gtsam.VectorValues | None = None,
) -> Scores:
    """Return the scores of parameters whose sums are known.

    Parameters
    ----------
    sums : RecordSums
        Sums over all rows that depend on them.
    information : SquareRootInformation
        Information on all variables.
    candidates : mapping of str to ndarray
        Standard deviations (n,) of the wide prior of each, SI; they may be infinite.
    step : gtsam.VectorValues, optional
        Step to the minimum, if the sums are of elsewhere.
    """
    score = sums.score
    if step is not None:
        score = score - sum(rows @ step.at(key) for key, rows in sums.by_key.items())
    square = sums.square - information.covariance_of([sums.by_key])
    wide = np.concatenate(list(candidates.values()))
    return Scores(places_of(candidates), score, square, wide)


def record_sums(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    candidates: Mapping[str, Array],
    motion: Motion,
    derivatives: Mapping[str, Array] = MappingProxyType({}),
) -> RecordSums:
    """Return what the rows of a record say of parameters; arguments as of `record_scores`."""
    values = evaluation.parameters
    own, processes = bound.parameters(problem.parameters), problem.processes_of(bound)
    wanted = [p.name for p in own]
    lin = bound.linearized(motion, values, [*wanted, *candidates], processes)
    lin.d_parameters.update(derivatives)
    edges = np.cumsum([0, *(sigma.size for sigma in candidates.values())]).tolist()
    keys = bound.keys_at(bound.nodes(processes), processes, [problem.key(n) for n in wanted])
    sizes = tuple(bound.sizes(processes, own))
    o = bound.observation
    score, square = np.zeros(edges[-1]), np.zeros((edges[-1], edges[-1]))
    taken_up: dict[int, Array] = {}
    for begin in range(0, o.time.size, _CHUNK):
        some = slice(begin, min(begin + _CHUNK, o.time.size))
        rows, residual = bound.jacobian(
            lin, some, motion, evaluation.states, values, wanted, processes, {}
        )
        by_names = np.concatenate([lin.d_parameters[name][some] for name in candidates], axis=2)
        by_names = bound.weight[some][:, :, None] * by_names
        part = Rows(o.label, o.components, keys[some], sizes, rows, residual, begin)
        add_transposed_product(part, by_names, taken_up)
        flat = by_names.reshape(-1, edges[-1])
        score -= flat.T @ residual.ravel()
        square += flat.T @ flat
    return RecordSums(score, square, taken_up)


def record_sums_in_turn(
    problem: Problem,
    bound: BoundObservation,
    evaluation: Evaluation,
    candidates: Mapping[str, Array],
    derivatives: Derivatives | None = None,
) -> RecordSums:
    """Return `record_sums` of a long record, some of its rows after the other.

    Parameters
    ----------
    problem : Problem
        Problem without these parameters.
    bound : BoundObservation
        The observation.
    evaluation : Evaluation
        The minimum.
    candidates : mapping of str to ndarray
        Standard deviations (n,) of the wide prior of each, SI; they may be infinite.
    derivatives : callable, optional
        Returns derivatives of some rows by the parameters, in place of those of the observation.
    """
    every = []
    for some in _in_turn(bound.observation.time.size):
        part, motion = part_of(problem, bound, some, evaluation)
        own = {} if derivatives is None else derivatives(some, part, motion)
        every.append(record_sums(problem, part, evaluation, candidates, motion, own))
    return in_all(every)


def in_all(every: Sequence[RecordSums]) -> RecordSums:
    """Return the sums of several parts, or records, of the same parameters."""
    by_key: dict[int, Array] = {}
    for each in every:
        for key, rows in each.by_key.items():
            by_key[key] = by_key[key] + rows if key in by_key else rows
    score, square = (np.sum([getattr(e, n) for e in every], axis=0) for n in ("score", "square"))
    return RecordSums(score, square, by_key)


def _in_turn(count: int) -> Iterator[IntArray]:
    """Yield which of so many measurements are there at once."""
    for begin in range(0, count, _CHUNK):
        yield np.arange(begin, min(begin + _CHUNK, count))


def of_whole(name: str, whole: Array) -> Derivatives:
    """Return what gives the derivatives of some measurements out of those (M, d, n) of all."""
    return lambda some, *_: {name: whole[some]}


def squares_at(problem: Problem, bound: BoundObservation, minimum: Minimum) -> Array:
    """Return `by_square` of a whole record at a minimum, worked out once."""
    name = f"squares of {bound.observation.label}"
    if name not in minimum.kept:
        evaluation = minimum.evaluation
        each = (
            part_of(problem, bound, some, evaluation)
            for some in _in_turn(bound.observation.time.size)
        )
        found = [by_square(problem, *part, evaluation) for part in each]
        minimum.kept[name] = np.concatenate(found)
    return np.asarray(minimum.kept[name])


def unexplained(bound: BoundObservation, residual: Array) -> float:
    """Return the squares of residuals beyond what they differ by from one to the next.

    Zero where it may be chance.
    """
    used = bound.weight.all(axis=1)
    own = residual[used]
    if len(own) < 2:
        return 0.0
    noise = 0.5 * np.mean(np.diff(own, axis=0) ** 2, axis=0)
    beyond = float(np.sum(own**2 - noise))
    chance = float(np.sqrt(2.0 * np.sum(noise**2) * len(own)))
    return beyond if beyond > _CERTAIN * chance else 0.0


def window_part(count: int) -> IntArray:
    """Return which of so many measurements show a window."""
    if count <= _ENOUGH:
        return np.arange(count)
    length = _ENOUGH // _STRETCHES
    first = np.linspace(0, count - length, _STRETCHES).astype(int)
    return (first[:, None] + np.arange(length)).ravel()


def part_of(
    problem: Problem, bound: BoundObservation, some: IntArray, evaluation: Evaluation
) -> tuple[BoundObservation, Motion]:
    """Return some measurements of an observation as they are evaluated, and their motion."""
    i = problem.bound.index(bound)
    at, motion, whole = evaluation.attached[i], evaluation.motions[i], bound.observation
    if some.size == whole.time.size:
        return replace(bound, attachment=at), motion
    part = replace(
        bound,
        observation=some_of(whole, some),
        attachment=rows_of(at, some),
        usable=bound.usable[some],
        weight=bound.weight[some],
    )
    return part, rows_of(motion, some)


def by_square(
    problem: Problem, bound: BoundObservation, motion: Motion, evaluation: Evaluation
) -> Array:
    """Return derivatives (M, d, 1) of measurements by the square of the length of a window, 1/s².

    Of what is predicted, ρ(t), the mean over a window of length T is ρ + T²/24 d²ρ/dt².
    """
    values, chain = evaluation.parameters, bound.chain
    time, shift = bound.times(values), chain.shift(values)
    covered = np.ones(time.size, dtype=bool)
    processes = problem.processes_of(bound)
    out = -2.0 * bound.residual(motion, values, processes)
    for when in (time - _BETWEEN, time + _BETWEEN):
        there = bound.motion(chain.attach(when, shift), evaluation.states, values)
        out += bound.residual(there, values, processes)
        covered &= chain.covers(when)
    out /= 24.0 * _BETWEEN**2
    out[~covered] = 0.0
    return out[:, :, None]


def by_lengths(
    problem: Problem,
    bound: BoundObservation,
    motion: Motion,
    evaluation: Evaluation,
    length: float,
) -> tuple[Array, Array]:
    """Return lengths about one, s, and what means over them change of measurements.

    Means are those of the trapezoidal rule; ends of the trial, which they pass, do not change.

    Parameters
    ----------
    problem : Problem
        Problem without the window.
    bound : BoundObservation
        The observation, or some of its measurements, attached.
    motion : Motion
        Motion where it is attached.
    evaluation : Evaluation
        The minimum.
    length : float
        Length, s.

    Returns
    -------
    lengths : ndarray, shape (n,), s
        Lengths, ascending.
    changes : ndarray, shape (M, d, n)
        Means less what they are means of.
    """
    values, chain = evaluation.parameters, bound.chain
    time, shift = bound.times(values), chain.shift(values)
    processes = problem.processes_of(bound)
    middle = bound.residual(motion, values, processes)
    ends, total = [middle, middle], np.zeros_like(middle)
    covered = np.ones(time.size, dtype=bool)
    step = 0.5 * _LONGEST * length / _MEANS
    out = np.zeros((*middle.shape, _MEANS))
    for k in range(1, _MEANS + 1):
        for side, sign in enumerate((-1.0, 1.0)):
            when = time + sign * k * step
            there = bound.motion(chain.attach(when, shift), evaluation.states, values)
            end = bound.residual(there, values, processes)
            total += 0.5 * (ends[side] + end)
            ends[side] = end
            covered &= chain.covers(when)
        out[covered, :, k - 1] = (total / (2.0 * k) - middle)[covered]
    return np.arange(1.0, _MEANS + 1.0) * 2.0 * step, out


def by_noise(problem: Problem, bound: BoundObservation, evaluation: Evaluation) -> Array:
    """Return the score that noise of the IMU has by the square of the length, 1/s², on average.

    Of each measurement of a record, (M,). Residuals have the noise that bends what is predicted,
    whatever the sensor does; those of means have hardly any of it.
    """
    values, i = evaluation.parameters, problem.bound.index(bound)
    window = bound.window(values)
    lin = bound.by_motion(evaluation.motions[i], values, problem.processes_of(bound))
    bend = bound.chain.curved(evaluation.attached[i], lin, _BETWEEN)
    if bend is None or (window is not None and abs(window.length) > _BETWEEN):
        return np.zeros(bound.observation.time.size)
    score = np.where(bound.weight > 0.0, bound.weight**2 * bend, 0.0)
    return np.asarray(np.sum(score, axis=1)) / (24.0 * _BETWEEN**2)
