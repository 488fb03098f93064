from __future__ import annotations

from typing import Any

import numpy as np
from comparisons import estimate, lever_arm, result

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.solution import Solution


def test_explanations_come_from_the_results() -> None:
    a = result(estimate("scale_error", 1.0, 0.1), lever_arm([1.0, 0.0, 0.0]))

    def told(b: Solution, **options: Any) -> str:
        return "\n".join(crosscheck(a, b, **options).explanation)

    off = estimate("scale_error", 9.0, 0.05)
    assert told(result(estimate("scale_error", 1.0, 0.1))) == ""
    assert "Nothing in the two results explains" in told(result(off, lever_arm([1.0, 0.0, 0.0])))
    assert "B did not converge" in told(result(off, converged=False))
    white = told(result(off, solver="kalman-point-set"))
    assert "B (kalman-point-set) models the error of its inertial velocity as white" in white
    assert "its σ are 0.5 times those of the other" in white
    neglected = told(result(off, solver="kalman-wahba"))
    assert (
        "B (kalman-wahba) does not estimate the lever arm; the one it uses differs by 1 m"
        in neglected
    )
    assert "B does not estimate the lever arm" in told(result(off, lever_arm([0, 0, 0], 0.0)))
    sure = estimate("scale_error", 1.0, 0.05)
    assert "B states a smaller σ than A" in "".join(
        crosscheck(a, result(sure), efficient="A").notes
    )
    assert "B has the warning: residuals too large." in told(
        result(off, findings=(Finding(Code.LARGE_RESIDUALS, "residuals too large"),))
    )
    bias = estimate("dvl_bias_m_s", [0.1, 0.0, 0.0], [0.01] * 3)
    assert "A does not estimate dvl_bias_m_s, which the other estimates" in told(result(off, bias))


def test_a_neglected_lever_arm_is_given_as_a_velocity() -> None:
    time = np.arange(100) / 10.0
    rph = np.stack([0.0 * time, 0.0 * time, 0.2 * time], axis=1)
    cov = np.tile(np.eye(3), (100, 1, 1))
    velocity = np.tile([4.0, 0.0, 0.0], (100, 1))
    turning = Trajectory(time, 0.1 * np.ones((100, 3)), velocity, rph, cov, cov, cov)
    a = result(estimate("scale_error", 1.0, 0.1), lever_arm([3.0, 4.0, 7.0]), trajectory=turning)
    b = result(estimate("scale_error", 9.0, 0.1), trajectory=turning)
    (text,) = crosscheck(a, b).explanation
    # 0.2 rad/s about the vertical, 5 m from it.
    assert "a velocity error of 1 m/s RMS, 25 % of the speed" in text
