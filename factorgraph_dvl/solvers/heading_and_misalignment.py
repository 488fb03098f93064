"""The misalignment about the vertical, with the error of the heading and without it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.attitude import HEADING_OFFSET, Attitude, heading_error
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.trial import Trial

_MISALIGNMENT = "misalignment_deg"
# Component of an attitude that is the heading.
_HEADING = 2
# Horizontal part of an axis that has a bearing. Chosen: at least one axis has more.
_LEVEL = 0.5
# Share of the stated standard deviation of the mean heading error from which on the data do not
# show it. Chosen: as that of directions that are left to the prior.
_UNKNOWN = 0.8


def heading_and_misalignment(trial: Trial, found: SolvedProblem) -> Iterator[Finding]:
    """Say how well the misalignment is known relative to the mean of the compass.

    A heading that is too large by e looks like a misalignment by e about the vertical: without an
    IMU data show their sum, with the mean of e over the trial. Where they leave of the mean of e
    what is stated of it, neither is determined alone.
    """
    problem, sensor = found.problem, trial.attitude
    parameters = {p.name: p for p in problem.parameters}
    if trial.imu is not None or sensor is None or _MISALIGNMENT not in parameters:
        return
    lasting = _lasting(problem)
    if lasting is None and HEADING_OFFSET not in parameters:
        return
    values = found.minimum.evaluation.parameters
    mean, by_error = _mean_error(problem, lasting, values, sensor)
    frd = frd_from_body(trial.body_axes)
    down = frd[2]
    alone = {problem.key(_MISALIGNMENT): down[None]}
    P = found.covariances.information.covariance_of([alone, alone | by_error, by_error])
    std, relative_std, error_std = (float(x) for x in np.sqrt(np.diag(P)) / DEG)
    left = error_std / _stated_std(problem, lasting, by_error)
    apart = message("heading_error.undetermined", left=100.0 * left) if left > _UNKNOWN else ""
    axis, angle = foremost(values[_MISALIGNMENT] @ frd.T)
    text = message(
        "heading_error.bearing",
        axis=axis,
        angle=angle,
        std=std,
        relative=angle - mean / DEG,
        relative_std=relative_std,
        apart=apart,
    )
    yield Finding(Code.HEADING_ERROR, text, parameter=_MISALIGNMENT)


def foremost(axes: Array) -> tuple[str, float]:
    """Return which horizontal axis of a DVL points ahead most, and its bearing.

    Parameters
    ----------
    axes : ndarray, shape (3, 3)
        Axes x, y, z, a row each, in forward, starboard, down of the vehicle.

    Returns
    -------
    name : str
        Name of the axis.
    bearing : float, deg
        Bearing from the bow, positive to starboard.
    """
    is_level = np.hypot(axes[:, 0], axes[:, 1]) > _LEVEL
    index = int(np.argmax(np.where(is_level, axes[:, 0], -np.inf)))
    forward, starboard, _ = axes[index]
    return "xyz"[index], float(np.degrees(np.arctan2(starboard, forward)))


def _lasting(problem: Problem) -> Process | None:
    """Return the error of the attitude that persists, None if there is none."""
    of_attitude = {o.label for o in problem.observations if "heading" in o.components}
    for process in problem.processes:
        if process.label in of_attitude and process.sigma[_HEADING] > 0.0:
            return process
    return None


def _mean_error(
    problem: Problem, lasting: Process | None, values: dict[str, Array], sensor: Attitude | Ins
) -> tuple[float, dict[int, Array]]:
    """Return the mean error of the heading, rad, and its derivatives (1, n) by key."""
    measured = ~np.isnan(sensor.rph[:, _HEADING])
    time = sensor.time[measured]
    stated, by = heading_error(time, sensor.rph[measured, _HEADING], values, 0.0)
    weight = np.gradient(time)
    weight /= weight.sum()
    mean = float(weight @ stated)
    out = {problem.key(n): (weight @ each)[None] for n, each in by.items() if n in problem.columns}
    if lasting is not None:
        error, by_node = lasting.mean(values[lasting.name])
        mean += float(error[_HEADING])
        out |= {key: each[[_HEADING]] for key, each in by_node.items()}
    return mean, out


def _stated_std(problem: Problem, lasting: Process | None, by_error: dict[int, Array]) -> float:
    """Return the standard deviation, deg, that is stated of the mean error of the heading."""
    variance = sum(
        float(np.sum((by_error[problem.key(p.name)] * p.sigma) ** 2))
        for p in problem.parameters
        if problem.key(p.name) in by_error
    )
    if lasting is not None:
        weight = np.array(
            [by_error[lasting.key(j)][0, _HEADING] for j in range(lasting.time.size)]
        )
        apart = np.abs(lasting.time[:, None] - lasting.time)
        variance += float(weight @ np.exp(-apart / lasting.tau[_HEADING]) @ weight)
    return float(np.sqrt(variance)) / DEG
