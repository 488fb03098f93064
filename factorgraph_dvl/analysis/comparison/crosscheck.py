"""Two results of one trial against each other, and each against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from factorgraph_dvl.analysis.comparison.calibration_difference import (
    Component,
    Joint,
    Side,
    compare_calibrations,
    joint_test,
    rotation_angles,
)
from factorgraph_dvl.analysis.comparison.explanation import explain, too_sure
from factorgraph_dvl.analysis.comparison.motion_difference import MotionDifference, compare_motions
from factorgraph_dvl.analysis.error_statistics import (
    CalibrationErrors,
    TrajectoryErrors,
    calibration_errors,
    trajectory_errors,
)
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Reference


@dataclass(frozen=True)
class AgainstTruth:
    """Errors of one result; None where there is nothing to compare.

    Parameters
    ----------
    calibration : CalibrationErrors or None
        Errors of the components whose truth is known.
    trajectory : TrajectoryErrors or None
        Errors at the epochs of the reference.
    """

    calibration: CalibrationErrors | None
    trajectory: TrajectoryErrors | None


@dataclass(frozen=True)
class CrossCheck:
    """Two results against each other.

    Parameters
    ----------
    a, b : Solution
        The results.
    efficient : Side or None
        The result that was declared efficient; None = neither.
    components : tuple of Component
        Every calibration component of either result.
    angles : dict of str to float
        Angles between the rotations of A and B, deg, by parameter.
    joint : Joint or None
        Test of all comparable components; None if there are none.
    motion : MotionDifference or None
        Difference of the trajectories; None without common epochs.
    truth_a, truth_b : AgainstTruth
        Errors of each result.
    explanation : tuple of str
        Candidate reasons for the differences.
    notes : tuple of str
        Limits of the comparison.
    """

    a: Solution
    b: Solution
    efficient: Side | None
    components: tuple[Component, ...]
    angles: dict[str, float]
    joint: Joint | None
    motion: MotionDifference | None
    truth_a: AgainstTruth
    truth_b: AgainstTruth
    explanation: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def has_truth(self) -> bool:
        """Whether any error is known."""
        return any(
            part is not None
            for against in (self.truth_a, self.truth_b)
            for part in (against.calibration, against.trajectory)
        )


def crosscheck(
    a: Solution,
    b: Solution,
    *,
    efficient: Side | None = None,
    truth: Mapping[str, ArrayLike] | None = None,
    reference: Reference | None = None,
) -> CrossCheck:
    """Compare two results, and both with the truth where it is known.

    Parameters
    ----------
    a, b : Solution
        The results; external ones may have no estimates, no epochs, or no standard deviations
        (nan).
    efficient : Side, optional
        The result that uses all data with a correct model, so that its errors are uncorrelated
        with the difference; ignored if the trials differ.
    truth : mapping of str to array_like, optional
        True calibration by reported name, in reported units.
    reference : Reference, optional
        True trajectory.

    Raises
    ------
    DataError
        If the results have nothing in common and there is no truth for either.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> check = fd.crosscheck(fd.solve(trial), fd.kalman(trial, "least-squares"))
    >>> {c.name: c.verdict for c in check.components}["lever_arm_x_m"]
    'agree'
    """
    notes = [f"{side} did not converge" for side, s in (("A", a), ("B", b)) if not s.converged]
    if a.trial and b.trial and a.trial != b.trial:
        notes.append(
            f"A is from trial {a.trial}, B from {b.trial}: data and perhaps mounting differ"
        )
        if efficient is not None:
            notes.append(
                "the Hausman variance needs the same data: the upper bounds are shown instead"
            )
            efficient = None
    if a.body_axes != b.body_axes:
        notes.append(f"A has body axes {a.body_axes}, B {b.body_axes}")
    components = compare_calibrations(a, b, efficient)
    motion = compare_motions(a.trajectory, b.trajectory, efficient)
    if motion is None and a.trajectory.time.size and b.trajectory.time.size:
        notes.append(
            "the trajectories have no epochs in common, and neither is dense enough "
            "(20 Hz) to interpolate"
        )
    truth_a, truth_b = (_against_truth(s, truth or {}, reference) for s in (a, b))
    found = CrossCheck(
        a=a,
        b=b,
        efficient=efficient,
        components=components,
        angles=rotation_angles(a, b),
        joint=joint_test(a, b, components),
        motion=motion,
        truth_a=truth_a,
        truth_b=truth_b,
        explanation=explain(a, b, components, efficient),
        notes=(*notes, *too_sure(components, efficient)),
    )
    both = any(np.isfinite(c.difference) for c in components)
    if not both and motion is None and not found.has_truth:
        raise DataError(
            "the two results have nothing in common",
            expected="the same calibration parameters, or trajectories with common epochs",
            hint=". ".join(notes),
        )
    return found


def _against_truth(
    solution: Solution, truth: Mapping[str, ArrayLike], reference: Reference | None
) -> AgainstTruth:
    calibration = calibration_errors(solution, truth)
    trajectory = None
    if reference is not None and solution.trajectory.time.size:
        trajectory = trajectory_errors(solution, reference)
    return AgainstTruth(
        calibration if calibration.names else None,
        trajectory if trajectory is not None and trajectory.time.size else None,
    )
