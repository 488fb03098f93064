"""Why two calibrations differ, as far as the two results themselves tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from factorgraph_dvl.analysis.comparison.calibration_difference import (
    AGREE_SIGMAS,
    Component,
    Side,
)
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Estimate, Solution, Trajectory

# What the DVL's measurement equation holds: a result that lacks one of these puts its
# effect into the others.
_OF_THE_DVL = ("lever_arm_m", "dvl_bias_m_s", "time_offset_s", "current_m_s")
_CALIBRATED = ("misalignment_deg", "scale_error", "lever_arm_m")
_WITHOUT_LEVER_ARM = ("kalman-wahba", "kalman-nine-state")
# All of them hold the DVL against velocities that an inertial filter has smoothed.
_WHITE_NOISE = "kalman-"
# Differences of reported angles are the angular rate only over short intervals.
_LONGEST_INTERVAL_S = 0.5


def explain(
    a: Solution,
    b: Solution,
    components: Sequence[Component],
    efficient: Side | None = None,
) -> tuple[str, ...]:
    """Return candidate reasons for the components that differ, a sentence or two each.

    Only what the two results state is used, so that each is a candidate and no proof;
    nothing is returned if nothing differs.

    Parameters
    ----------
    a, b : Solution
        The results.
    components : sequence of Component
        Of `compare_calibrations`.
    efficient : Side, optional
        Which result was said to be efficient.
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
        # What is not observable is not compared, and no reason.
        told = (w for w in own.warnings if "not observable" not in w)
        out += [f"{side} itself warns: {warning}." for warning in told]
    return tuple(out) or (
        "The two results hold nothing that explains it: look at the data, the noise that was "
        "stated for them, and the residuals.",
    )


def _not_converged(side: Side, own: Solution) -> Iterator[str]:
    if not own.converged:
        yield f"{side} did not converge: its numbers are not to be used."


def _white_noise(side: Side, own: Solution, differing: Sequence[Component]) -> Iterator[str]:
    touched = [c for c in differing if c.parameter in _CALIBRATED]
    if not own.solver.startswith(_WHITE_NOISE) or not touched:
        return
    stds = [(c.std_a, c.std_b) if side == "A" else (c.std_b, c.std_a) for c in touched]
    ratios = [mine / other for mine, other in stds if mine > 0.0 and other > 0.0]
    measured = (
        f" For what differs it claims {_span(ratios)} times the σ of the other." if ratios else ""
    )
    yield (
        f"{side} ({own.solver}) takes the error of its inertial velocity for white noise, though "
        "it is correlated in time: its σ does not contain that and is too small, and with it the "
        f"σ of the difference.{measured}"
    )


def _neglected(side: Side, own: Solution, other: Solution) -> Iterator[str]:
    for name in _OF_THE_DVL:
        found = _significant(other, name)
        if found is None or not _is_held(own, name):
            continue
        if name == "lever_arm_m":
            yield _neglected_lever_arm(side, own, other, found)
        else:
            values = ", ".join(f"{v:.4g}" for v in found.value)
            yield (
                f"{side} does not estimate {name}, which the other finds to be {values}: what it "
                "does to the velocity goes into the parameters that are there."
            )


def _neglected_lever_arm(side: Side, own: Solution, other: Solution, found: Estimate) -> str:
    held = next((e.value for e in own.estimates if e.name == found.name), np.zeros(3))
    missing = found.value - np.nan_to_num(held)
    length = float(np.linalg.norm(missing))
    by_design = f" ({own.solver})" if own.solver in _WITHOUT_LEVER_ARM else ""
    text = (
        f"{side}{by_design} does not estimate the lever arm, and is {length:.3g} m off from what "
        "the other finds."
    )
    for solution in (other, own):
        neglected = _velocity_of(missing, solution)
        if neglected is not None:
            speed, share = neglected
            return text + (
                f" With the angular rates of the trajectory that is a velocity of {speed:.2g} m/s "
                f"RMS, {100.0 * share:.2g} % of the vehicle's, which goes into misalignment and "
                "scale as far as it repeats in turns, and into the noise otherwise."
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
    told = set()
    for c in components:
        if c.reason.startswith("other parametrisation") and c.parameter not in told:
            told.add(c.parameter)
            yield (
                f"The results have {c.parameter} in different parametrisations "
                f"({c.reason.split(': ')[-1]}): what the "
                "fewer numbers cannot follow goes into other parameters."
            )


def too_sure(components: Sequence[Component], efficient: Side | None) -> Iterator[str]:
    """Yield where a result claims more than the efficient one can know."""
    if efficient is None:
        return
    other = "B" if efficient == "A" else "A"
    names = []
    for c in components:
        best, claimed = (c.std_a, c.std_b) if efficient == "A" else (c.std_b, c.std_a)
        if c.verdict != "not comparable" and 0.0 < claimed < 0.95 * best:
            names.append(c.name)
    if names:
        yield (
            f"{other} claims smaller σ than {efficient}, which is said to be efficient, for "
            f"{', '.join(names)}. No unbiased estimate of the same data can have that: either the "
            f"σ of {other} is too small or {efficient} is not efficient."
        )


def _significant(solution: Solution, name: str) -> Estimate | None:
    """Return a parameter that is estimated and not zero."""
    for e in solution.estimates:
        if e.name == name:
            known = np.asarray(e.observable, dtype=bool) & (e.std > 0.0)
            if np.any(known & (np.abs(e.value) > AGREE_SIGMAS * e.std)):
                return e
    return None


def _is_held(solution: Solution, name: str) -> bool:
    """Whether a calibration does not estimate a parameter; a bare trajectory has none to hold."""
    if not solution.estimates:
        return False
    found = [e for e in solution.estimates if e.name == name]
    return not found or bool(np.all(found[0].std == 0.0))


def _span(ratios: Sequence[float]) -> str:
    low, high = min(ratios), max(ratios)
    return f"{low:.2g}" if f"{low:.2g}" == f"{high:.2g}" else f"{low:.2g} to {high:.2g}"
