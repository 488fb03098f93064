"""Minima of rounds as stages of a solve: an interrupted run need not search for them again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.stages import Stages, finished
from factorgraph_dvl.statistics.square_root_information import eliminated


@dataclass(frozen=True)
class _Place:
    """Values of all variables as arrays."""

    states: States
    parameters: dict[str, Array]


@dataclass(frozen=True)
class _Kept:
    """A minimum as stages keep it.

    `linear_at` is where its square root of the information was linear: this is far smaller, and
    found from there again.
    """

    place: _Place
    linear_at: _Place | None
    converged: bool
    iterations: int


def finished_minimum(
    stages: Stages | None,
    stage: str,
    problem: Problem,
    start: gtsam.Values,
    minimise: Callable[[Problem, gtsam.Values], Minimum],
) -> Minimum:
    """Return the minimum of a stage: the one that was kept, else a new one, which is kept.

    It is the same to the last digit, and the problem is left the same.

    Parameters
    ----------
    stages : Stages, optional
        Where it is kept, and taken from.
    stage : str
        Name of the stage.
    problem : Problem
        What is minimised.
    start : gtsam.Values
        Where the search for it starts.
    minimise : callable
        Searches, as `solvers.levenberg_marquardt.minimise`.
    """
    if stages is None:
        return minimise(problem, start)
    new: list[Minimum] = []

    def compute() -> _Kept:
        new.append(minimise(problem, start))
        return _kept(problem, new[0])

    kept = finished(stages, stage, _Kept, compute)
    return new[0] if new else _again(problem, start, kept)


def _kept(problem: Problem, minimum: Minimum) -> _Kept:
    """Return what stages keep of a minimum."""
    evaluation, linear_at = minimum.evaluation, minimum.linear_at
    return _Kept(
        _Place(evaluation.states, evaluation.parameters),
        None if linear_at is None else _Place(*problem.arrays(linear_at)),
        minimum.converged,
        minimum.iterations,
    )


def _again(problem: Problem, start: gtsam.Values, kept: _Kept) -> Minimum:
    """Return a minimum that was kept, and weigh measurements as its search does."""
    problem.weigh(problem.evaluate(start))
    square_root = None
    if kept.linear_at is not None:
        before = problem.evaluate(_values(problem, kept.linear_at))
        gaussian, ordering = problem.linearize(before), problem.ordering(branches=False)
        square_root = eliminated(gaussian, ordering, before.values.dims())
    evaluation = problem.evaluate(_values(problem, kept.place))
    return Minimum(evaluation, square_root, kept.converged, kept.iterations)


def _values(problem: Problem, place: _Place) -> gtsam.Values:
    return problem.same_values(place.states, place.parameters)
