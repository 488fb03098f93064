"""Candidate reasons why two calibrations differ, from the two results alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.analysis.comparison.calibration_difference import (
    AGREE_SIGMAS,
    Component,
    Side,
)
from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.dvl import (
    BIAS,
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
)
from factorgraph_dvl.sensors.dvl_water import CURRENT
from factorgraph_dvl.solution import Solution

# Parameters of the DVL's measurement equation: if a result omits one, its effect biases the
# others.
_OF_THE_DVL = (LEVER_ARM, BIAS, TIME_OFFSET, CURRENT)
_CALIBRATED = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM)
_WITHOUT_LEVER_ARM = ("kalman-wahba", "kalman-nine-state")
# These compare the DVL with velocities that an inertial filter has smoothed.
_WHITE_NOISE = "kalman-"
# Chosen: over longer intervals, differences of reported angles average out the sway.
_LONGEST_INTERVAL_S = 0.5
# Chosen: reported σ are accurate to some percent.
_SMALLER = 0.95


def explain(
    a: Solution,
    b: Solution,
    components: Sequence[Component],
    efficient: Side | None = None,
) -> tuple[str, ...]:
    """Return candidate reasons for the components that differ, a sentence or two each.

    They come from the two results alone, so none of them is proven. The tuple is empty if
    nothing differs.

    Parameters
    ----------
    a, b : Solution
        The results.
    components : sequence of Component
        Result of `compare_calibrations`.
    efficient : Side, optional
        The result that was declared efficient.
    """
    differing = [c for c in components if c.verdict == "differ"]
    if not differing:
        return ()
    sides: tuple[tuple[Side, Solution, Solution], ...] = (("A", a, b), ("B", b, a))
    out: list[str] = []
    for side, own, other in sides:
        out += _not_converged(side, own)
        out += _white_noise(side, own, differing)
        out += _neglected(side, own, other)
    out += _parametrisation(components)
    for side, own, _ in sides:
        # Components that are not observable are not compared.
        relevant = (f for f in own.findings if f.code != Code.NOT_OBSERVABLE)
        out += [f"{side} has the warning: {finding}." for finding in relevant]
    return tuple(out) or (
        "Nothing in the two results explains the difference: check the data, the stated noise and "
        "the residuals.",
    )


def _not_converged(side: Side, own: Solution) -> Iterator[str]:
    if not own.converged:
        yield f"{side} did not converge: do not use its numbers."


def _white_noise(side: Side, own: Solution, differing: Sequence[Component]) -> Iterator[str]:
    touched = [c for c in differing if c.parameter in _CALIBRATED]
    if not own.solver.startswith(_WHITE_NOISE) or not touched:
        return
    stds = [(c.std_a, c.std_b) if side == "A" else (c.std_b, c.std_a) for c in touched]
    ratios = [mine / other for mine, other in stds if mine > 0.0 and other > 0.0]
    measured = (
        f" Where they differ, its σ are {_span(ratios)} times those of the other."
        if ratios
        else ""
    )
    yield (
        f"{side} ({own.solver}) models the error of its inertial velocity as white noise, but it "
        "is correlated in time: its σ is too small, and so is the σ of the difference."
        f"{measured}"
    )


def _neglected(side: Side, own: Solution, other: Solution) -> Iterator[str]:
    for name in _OF_THE_DVL:
        found = _significant(other, name)
        if found is None or not _is_fixed(own, name):
            continue
        if name == LEVER_ARM:
            yield _neglected_lever_arm(side, own, other, found)
        else:
            values = ", ".join(f"{v:.4g}" for v in found.value)
            yield (
                f"{side} does not estimate {name}, which the other estimates as {values}: its "
                f"effect on the velocity biases the parameters that {side} estimates."
            )


def _neglected_lever_arm(side: Side, own: Solution, other: Solution, found: Estimate) -> str:
    fixed = next((e.value for e in own.estimates if e.name == found.name), np.zeros(3))
    missing = found.value - np.nan_to_num(fixed)
    length = float(np.linalg.norm(missing))
    by_design = f" ({own.solver})" if own.solver in _WITHOUT_LEVER_ARM else ""
    text = (
        f"{side}{by_design} does not estimate the lever arm; the one it uses differs by "
        f"{length:.3g} m from the estimate of the other."
    )
    for solution in (other, own):
        neglected = _velocity_of(missing, solution)
        if neglected is not None:
            speed, share = neglected
            return text + (
                f" At the angular rates of the trajectory, this is a velocity error of "
                f"{speed:.2g} m/s RMS, {100.0 * share:.2g} % of the speed. It biases misalignment "
                "and scale where it repeats in turns, and adds noise elsewhere."
            )
    return text


def _velocity_of(lever_arm: Array, solution: Solution) -> tuple[float, float] | None:
    """Return the RMS of omega x l, m/s, and its share of the vehicle's; None if unknown."""
    trajectory = solution.trajectory
    if trajectory.time.size < 3:
        return None
    omega = _angular_rate(trajectory, solution)
    speed = float(np.sqrt(np.mean(np.sum(trajectory.velocity**2, axis=1))))
    if omega.size == 0 or not speed > 0.0:
        return None
    rms = float(np.sqrt(np.mean(np.sum(np.cross(omega, lever_arm) ** 2, axis=1))))
    return rms, rms / speed


def _angular_rate(trajectory: Trajectory, solution: Solution) -> Array:
    interval = np.diff(trajectory.time)
    nRb = rotation_from_rph(trajectory.rph, solution.body_axes)
    turn = np.swapaxes(nRb[:-1], 1, 2) @ nRb[1:]
    short = interval < _LONGEST_INTERVAL_S
    return log_so3(turn[short]) / interval[short, None]


def _parametrisation(components: Sequence[Component]) -> Iterator[str]:
    reported = set()
    for c in components:
        if c.reason.startswith("different parametrisation") and c.parameter not in reported:
            reported.add(c.parameter)
            yield (
                f"The results have {c.parameter} in different parametrisations "
                f"({c.reason.split(': ')[-1]}): "
                "what the smaller set cannot represent biases other parameters."
            )


def too_sure(components: Sequence[Component], efficient: Side | None) -> Iterator[str]:
    """Yield a sentence if a result claims smaller σ than the efficient one."""
    if efficient is None:
        return
    other = "B" if efficient == "A" else "A"
    names = []
    for c in components:
        best, claimed = (c.std_a, c.std_b) if efficient == "A" else (c.std_b, c.std_a)
        if c.verdict != "not comparable" and 0.0 < claimed < _SMALLER * best:
            names.append(c.name)
    if names:
        yield (
            f"{other} states a smaller σ than {efficient}, which was declared efficient, for "
            f"{', '.join(names)}. No unbiased estimate from the same data can be better: either "
            f"the σ of {other} is too small, or {efficient} is not efficient."
        )


def _significant(solution: Solution, name: str) -> Estimate | None:
    """Return a parameter whose estimate differs significantly from zero; None otherwise."""
    for e in solution.estimates:
        if e.name == name:
            known = np.asarray(e.observable, dtype=bool) & (e.std > 0.0)
            if np.any(known & (np.abs(e.value) > AGREE_SIGMAS * e.std)):
                return e
    return None


def _is_fixed(solution: Solution, name: str) -> bool:
    """Whether a calibration does not estimate a parameter; False for a bare trajectory."""
    if not solution.estimates:
        return False
    found = [e for e in solution.estimates if e.name == name]
    return not found or bool(np.all(found[0].std == 0.0))


def _span(ratios: Sequence[float]) -> str:
    low, high = min(ratios), max(ratios)
    return f"{low:.2g}" if f"{low:.2g}" == f"{high:.2g}" else f"{low:.2g} to {high:.2g}"
