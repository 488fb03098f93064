"""Scales that walk at random although a trial does not state it, in place of lasting noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.units import HOUR
from factorgraph_dvl.graph.clocks import parameters_of
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.protocol import ScaleWalk
from factorgraph_dvl.solvers.change_along_trial import certain, changes_at, largest
from factorgraph_dvl.solvers.correlated_noise import walking_alone
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.model import Estimated

# Factors on the rate that noise has at the usual speed, from which the estimate starts. Chosen:
# what a whole trial says of a rate is within this.
_STARTS = (1.0, 3.0, 1.0 / 3.0)
_KEY = "scale_walk_std_sqrt_h"


def in_place_of(problem: Problem, process: Process) -> Iterator[Process]:
    """Yield scales that walk in place of noise that persists; none where it has no scale.

    A first-order process of deviation σ and time τ has the density 2 σ² / τ of a walk.

    Parameters
    ----------
    problem : Problem
        What it is a process of.
    process : Process
        Noise that persists.
    """
    if process.walk is not None or not process.sigma.any():
        return
    for i, walk in _walks(problem):
        if problem.observations[i].label != process.label:
            continue
        speed = np.sqrt(np.mean(walk.measured**2, axis=0))
        density = process.sigma * np.sqrt(2.0 / process.tau)
        largest = int(np.argmax(density))
        if speed[largest] > 0.0:
            rate = float(density[largest] / speed[largest])
            yield from _about(problem, i, process.index, walk, rate)


def instead_of_a_change(problem: Problem, minimum: Minimum) -> Iterator[tuple[Process, float]]:
    """Yield scales that walk where the most probable change along the trial is of their sensor.

    Each with what that change takes off the objective: a walk that takes off less is none.

    Parameters
    ----------
    problem, minimum : Problem or Minimum
        Problem, and its minimum.
    """
    changes = changes_at(problem, minimum)
    most = largest(certain(changes))
    if most is None:
        return
    taken = {p.label for p in problem.processes}
    index = max((p.index for p in problem.processes), default=-1) + 1
    for i, walk in _walks(problem):
        o = problem.observations[i]
        if o.label in taken or most.parameter.name not in parameters_of(o):
            continue
        sizes = [
            abs(c.change.size) * c.parameter.si
            for c in changes
            if c.parameter.name == walk.parameter
        ]
        if sizes:
            rate = max(sizes) / float(np.sqrt(np.ptp(o.time)))
            for walking in _about(problem, i, index, walk, rate):
                yield walking, most.change.fall


def _walks(problem: Problem) -> Iterator[tuple[int, ScaleWalk]]:
    """Yield the observations whose scale may walk, by number, and what is stated of it."""
    for i, o in enumerate(problem.observations):
        if o.scale_walk is not None and np.ptp(o.time) > 0.0:
            yield i, o.scale_walk


def _about(
    problem: Problem, i: int, index: int, walk: ScaleWalk, rate: float
) -> Iterator[Process]:
    """Yield a scale that walks, from several rates about one."""
    for start in _STARTS:
        yield walking_alone(problem, i, index, replace(walk, rate=start * rate))


def scale_walk_findings(at: Estimated) -> tuple[Finding, ...]:
    """Return a finding of each scale that was found to walk."""
    walks = ((p.label, p.free_walk) for p in at.problem.processes)
    return tuple(
        Finding(
            Code.ESTIMATED_INSTEAD,
            message("estimated_instead.scale_walk", name=_KEY, value=walk.rate * np.sqrt(HOUR)),
            sensor=label,
            parameter=walk.parameter,
        )
        for label, walk in walks
        if walk is not None
    )
