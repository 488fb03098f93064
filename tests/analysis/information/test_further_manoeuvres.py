from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_solution

from factorgraph_dvl.analysis.information.further_manoeuvres import further_manoeuvres
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution


def estimate(name: str, components: tuple[str, ...], std: Array) -> Estimate:
    zero = np.zeros(std.size)
    known = std < 0.5
    return Estimate(name, components, zero, std, zero, np.ones(std.size), known)


def with_std(misalignment: Array, scale: float, lever_arm: Array) -> Solution:
    axes = "xyz"
    estimates = (
        estimate("misalignment_deg", tuple(f"misalignment_{a}_deg" for a in axes), misalignment),
        estimate("scale_error", ("scale_error",), np.array([scale])),
        estimate("lever_arm_m", tuple(f"lever_arm_{a}_m" for a in axes), lever_arm),
    )
    std = np.concatenate([e.std for e in estimates])
    found = build_solution(estimates=estimates, covariance=np.diag(std**2))
    return replace(found, body_axes="FRD")


GOOD = np.full(3, 0.01)


def test_a_calibration_within_its_limits_needs_no_manoeuvre() -> None:
    assert further_manoeuvres(with_std(GOOD, 1e-4, GOOD)) == ()


def test_a_method_that_takes_the_lever_arm_as_known_has_none() -> None:
    solution = with_std(np.ones(3), 1e-4, GOOD)
    axes = "xyz"
    bias = estimate("dvl_bias_m_s", tuple(f"dvl_bias_{a}_m_s" for a in axes), GOOD)
    assert further_manoeuvres(replace(solution, estimates=(*solution.estimates[:2], bias))) == ()


def test_turns_determine_the_horizontal_lever_arm_alone() -> None:
    lever_arm = np.array([1.0, 1.0, 1.0])
    found = {m.name: m for m in further_manoeuvres(with_std(GOOD, 1e-4, lever_arm))}
    assert found["turns"].names == ("lever_arm_x_m", "lever_arm_y_m")
    # Pitching about y moves a DVL that is off along x and z.
    assert found["pitching"].names == ("lever_arm_x_m", "lever_arm_z_m")
    assert found.keys() == {"turns", "pitching"}


def test_a_known_case_in_closed_form() -> None:
    """Straight ahead, J = v for the scale: 1/σ² = 1/σ₀² + M v²/s²."""
    (found,) = (m for m in further_manoeuvres(with_std(GOOD, 0.02, GOOD)) if m.name == "straight")
    speed = np.linalg.norm(build_solution().trajectory.velocity[0])
    expected = 1.0 / np.sqrt(1.0 / 0.02**2 + 240.0 * speed**2 / 0.01**2)
    assert found.names == ("scale_error",)
    assert found.after[0] == pytest.approx(expected, rel=1e-3)


def test_roll_needs_motion_across_the_bow() -> None:
    misalignment = np.array([1.0, 1.0, 1.0])
    for m in further_manoeuvres(with_std(misalignment, 1e-4, GOOD)):
        assert "misalignment_x_deg" not in m.names or m.name in ("turns", "pitching")
