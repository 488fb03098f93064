"""Errors that are not estimated, and by how much they move every variable.

The estimate is that without them, and what depends on them has a covariance P + K Kᵀ, with K its
change with each of their components, which are independent and of unit variance (Schmidt's
consider analysis; Bierman, Factorization Methods for Discrete Sequential Estimation, 1977,
ch. VIII). With whitened rows J of the graph that change by B, K = -P Jᵀ B.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.deflection import deflection_along
from factorgraph_dvl.geometry.units import ARCSEC, STANDARD_GRAVITY
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.inertial_chain import InertialChain
from factorgraph_dvl.graph.keys import STATE_SIZE
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.solvers.correlated_noise import unseen_offsets
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.record_scores import (
    by_noise,
    of_whole,
    record_sums_in_turn,
    squares_at,
)
from factorgraph_dvl.statistics.rows import add_transposed_product

# IMU factors that are read at once. Chosen: some ten megabytes.
_CHUNK = 4096
# Lengths of windows over plausible ones, over which is integrated. Chosen: to four digits.
_LENGTHS = np.concatenate([[0.0], np.geomspace(1e-4, 5.0, 4000)])


@dataclass(frozen=True)
class ConsideredError:
    """An error that is not estimated.

    Parameters
    ----------
    cause, assumed : str
        Row of the error budget.
    changes : mapping of int to ndarray
        Change of every variable with each component, (size, h) by key.
    """

    cause: str
    assumed: str
    changes: Mapping[int, Array]


def considered_errors(problem: Problem, minimum: Minimum) -> tuple[ConsideredError, ...]:
    """Return the errors of a problem that are considered.

    Parameters
    ----------
    problem, minimum : Problem or Minimum
        Problem, and its minimum.
    """
    evaluation, information = minimum.evaluation, minimum.information
    found: list[tuple[str, str, dict[int, Array]]] = []
    chain = problem.chain
    if isinstance(chain, InertialChain) and chain.imu.gravity_deflection_std_arcsec > 0.0:
        std = chain.imu.gravity_deflection_std_arcsec
        sums = _by_deflection(chain, problem, evaluation, std * ARCSEC)
        found.append(("deflection of the vertical", f"{std:g}″", sums))
    for label, sums in _by_offsets(problem, evaluation):
        found.append((f"slow errors of {label}", "all that residuals do not show", sums))
    out = []
    for cause, assumed, sums in found:
        changes = information.covariance_with([sums]).times(-1.0)
        out.append(ConsideredError(cause, assumed, changes))
    return (*out, *_by_windows(problem, minimum))


def _by_windows(problem: Problem, minimum: Minimum) -> Iterator[ConsideredError]:
    """Yield the windows over which sensors may average, and that are not estimated.

    The root mean square of the square of the length is considered, by what the data say of it.
    """
    usual = {p.name: p for p in problem.all_parameters if p.spec.usual and not p.estimated}
    for bound in problem.bound:
        p = usual.get(bound.observation.averaging or "")
        if p is None or p.spec.plausible is None or problem.chain.interpolates:
            continue
        if p.mean.any() or not bound.weight.any():
            continue
        unknown = {p.name: np.full(1, np.inf)}
        squares = of_whole(p.name, squares_at(problem, bound, minimum))
        sums = record_sums_in_turn(problem, bound, minimum.evaluation, unknown, squares)
        moved = minimum.information.covariance_with([sums.by_key])
        taken_up = moved.after(sums.by_key)
        known = max(float((sums.square - taken_up)[0, 0]), 0.0)
        # Means over windows that share pings are rare.
        between = np.diff(np.unique(bound.observation.time))
        longest = min(p.spec.plausible, float(np.median(between)) if between.size else np.inf)
        noise = by_noise(problem, bound, minimum.evaluation).sum()
        size = likely_square(float(sums.score[0] - noise), known, longest)
        label = bound.observation.label
        upto = f"up to {np.sqrt(2.0 * size):.2g} s"
        yield ConsideredError(f"averaging of {label}", upto, moved.times(-size))


def likely_square(score: float, information: float, plausible: float) -> float:
    """Return the root mean square, s², of the square m of the length of a window.

    As probable as not, a sensor measures in no time. Else its window has a normal distribution
    above zero. The data change both by the likelihood of m, exp(score m - information m² / 2).

    Parameters
    ----------
    score, information : float
        Slope of the log likelihood by m at zero, 1/s², and its information, 1/s⁴.
    plausible : float
        Standard deviation of the normal distribution, s.
    """
    length = plausible * _LENGTHS
    m = length**2
    exponent = score * m - 0.5 * information * m**2 - 0.5 * _LENGTHS**2
    highest = max(float(exponent.max()), 0.0)
    density = np.sqrt(2.0 / np.pi) * np.exp(exponent - highest)
    averages = float(np.trapezoid(density, _LENGTHS))
    return float(np.sqrt(np.trapezoid(density * m**2, _LENGTHS) / (averages + np.exp(-highest))))


def _by_offsets(
    problem: Problem, evaluation: Evaluation
) -> Iterator[tuple[str, dict[int, Array]]]:
    """Yield Bᵀ J of positions by an offset of each component, (h, size) by key, with the label.

    It is what the stated deviation has more than residuals show: an error that persists, which
    the trajectory follows.
    """
    unseen = unseen_offsets(problem)
    if not unseen:
        return
    # Of the deviation that rows are weighed by.
    columns = {
        label: np.diag(share / problem.white_factors[label])[:, share > 0.0]
        for label, share in unseen.items()
    }
    found: dict[str, dict[int, Array]] = {label: {} for label in unseen}
    for rows in problem.observation_rows(evaluation):
        if rows.source in found:
            used = np.any(rows.matrix, axis=2)[:, :, None]
            add_transposed_product(rows, used * columns[rows.source], found[rows.source])
    yield from found.items()


def _by_deflection(
    chain: InertialChain, problem: Problem, evaluation: Evaluation, std: float
) -> dict[int, Array]:
    """Return Bᵀ J of the IMU factors by the components of a deflection, (h, size) by key.

    A deflection tilts gravity: the state that is predicted at the end of a segment moves.
    """
    seg, states = chain.segments, evaluation.states
    middle = 0.5 * (states.p_n[seg.origin] + states.p_n[seg.origin + 1])
    along = std * STANDARD_GRAVITY * deflection_along(middle[:, :2])
    duration = seg.duration[:, None, None]
    pushed = states.nRb[seg.origin + 1, :2].transpose(0, 2, 1) @ along * duration
    moved = np.concatenate([np.zeros_like(pushed), 0.5 * duration * pushed, pushed], axis=1)
    native, sizes = problem.native(evaluation), evaluation.values.dims()
    sums: dict[int, Array] = {}
    for begin in range(0, chain.count, _CHUNK):
        some = range(begin, min(begin + _CHUNK, chain.count))
        factors = [native.at(k) for k in some]
        rows = np.stack([factor.augmentedJacobian()[:, :-1] for factor in factors])
        change = rows[:, :, STATE_SIZE : 2 * STATE_SIZE] @ moved[some.start : some.stop]
        both = -change.transpose(0, 2, 1) @ rows
        for factor, own in zip(factors, both, strict=True):
            edge = 0
            for key in list(factor.keys()):
                sums[key] = sums.get(key, 0.0) + own[:, edge : edge + sizes[key]]
                edge += sizes[key]
    return sums
