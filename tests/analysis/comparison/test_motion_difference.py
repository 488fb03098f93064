from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_solution
from comparisons import dense, moved, scale

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.analysis.comparison.motion_difference import compare_motions
from factorgraph_dvl.geometry.units import DEG


def test_trajectories_by_hand() -> None:
    a = build_solution().trajectory
    b = replace(moved(a, -0.5), position_cov=9.0 / 16.0 * a.position_cov)
    motion = compare_motions(a, b, "B")
    assert motion is not None
    up, heading = motion.spreads[2], motion.spreads[8]
    assert up.rms == pytest.approx(0.5)
    assert heading.largest == pytest.approx(0.001 / DEG)
    assert motion.difference[0, 8] == pytest.approx(-0.001 / DEG)
    # √(0.1² - 0.075²) for the position, √2 · 0.001 rad for the attitude.
    assert motion.kinds == ("Hausman",) * 3 + ("upper bound",) * 6
    assert up.rms_sigmas == pytest.approx(0.5 / (0.1 * np.sqrt(7.0) / 4.0))
    assert heading.rms_sigmas == pytest.approx(np.sqrt(0.5))
    assert (up.within_2_sigma, heading.within_2_sigma) == (0.0, 1.0)


@pytest.mark.parametrize("swap", [False, True])
def test_the_denser_trajectory_is_interpolated(swap: bool) -> None:
    fine, coarse = dense(10.0, 50.0), moved(dense(8.0, 1.0, 0.507), 1.0)
    motion = compare_motions(fine, coarse) if not swap else compare_motions(coarse, fine)
    assert motion is not None
    np.testing.assert_array_equal(motion.time, coarse.time)
    sign = -1.0 if swap else 1.0
    np.testing.assert_allclose(motion.difference[:, 2], -sign, atol=1e-7)
    np.testing.assert_allclose(motion.difference[:, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(motion.std[:, 0] ** 2, 2.0 * (1.0 + motion.time), atol=0.02)


def test_no_common_epochs_are_said() -> None:
    a = scale(1.0, 1.0, trajectory=dense(4.0, 10.0))
    b = scale(1.0, 1.0, trajectory=dense(4.0, 10.0, 0.05))
    check = crosscheck(a, b)
    assert check.motion is None
    assert "no epochs in common" in check.notes[0]
