"""Noise of the IMU between what is stated and what its record has, from the motion between states.

The record bounds the noise from above (`imu.noise`): what vibrates at high frequencies is part of
it. What is stated bounds it from below. An INS that is made of the same record agrees with it to
a tenth of the noise that both have; its residuals say nothing of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np

from factorgraph_dvl.graph.inertial_chain import ACCEL_NOISE, GYRO_NOISE
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.statistics.leverage import leverage
from factorgraph_dvl.statistics.rows import native_rows
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation
from factorgraph_dvl.statistics.variance_components import NoiseFactor

IMU_NOISE = (GYRO_NOISE, ACCEL_NOISE)
# Segments from which the noise is estimated. Chosen: it is then known to some per cent.
_SEGMENTS = 500
# Keys of the settings that state each of them.
NOISE_KEYS = {GYRO_NOISE: "gyro_noise_deg_sqrt_h", ACCEL_NOISE: "accel_noise_ug_sqrt_hz"}


def squares_of(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    sources: Iterable[str],
    every: int = 1,
) -> dict[str, tuple[float, float]]:
    """Return the squares of residuals by source, and what they are by chance.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    evaluation : Evaluation
        Its minimum.
    information : SquareRootInformation
        Information there.
    sources : iterable of str
        Labels of native factors.
    every : int, default 1
        One of so many factors is taken.
    """
    wanted = set(sources)

    def rows() -> Iterator[Rows]:
        return (r for r in native_rows(problem, evaluation, every) if r.source in wanted)

    squares, freedom = dict.fromkeys(sorted(wanted), 0.0), dict.fromkeys(sorted(wanted), 0.0)
    count = 0
    for each in rows():
        squares[each.source] += float(np.sum(each.vector**2))
        count += each.vector.size
    for each, h in leverage(rows, count, information):
        freedom[each.source] += float(np.sum(1.0 - h))
    return {name: (squares[name], max(freedom[name], 0.0)) for name in squares}


def sampled_segments(problem: Problem) -> int:
    """Return of how many segments one shows the noise of the IMU well enough."""
    return max(problem.chain.count // _SEGMENTS, 1)


def lower_noise(problem: Problem, minimum: Minimum, sources: Collection[str]) -> dict[str, float]:
    """Return factors below 1 on the noise of the IMU, by key of its settings.

    By the fixed point of the restricted likelihood, as of other sensors (`variance_components`);
    those that may be chance are left out.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    minimum : Minimum
        Where it ended.
    sources : collection of str
        `GYRO_NOISE` or `ACCEL_NOISE`, or both.
    """
    every = sampled_segments(problem)
    found = squares_of(problem, minimum.evaluation, minimum.information, sources, every)
    out = {}
    for source, (squares, freedom) in found.items():
        factor = float(NoiseFactor.of(squares, freedom).after(np.ones(1))[0])
        if factor < 1.0:
            out[NOISE_KEYS[source]] = factor
    return out
