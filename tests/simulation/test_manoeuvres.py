from __future__ import annotations

import numpy as np
import pytest
from plans import CALM
from truth import CONFIGS, scenario

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.simulation import load_scenario, plan_motion, simulate


def test_figure_eight_and_stop():
    parts = [{"figure_eight_deg_s": 6, "ramp_s": 3}, {"stop_s": 10, "acceleration_m_s2": 0.4}]
    motion = plan_motion(scenario(manoeuvres=parts, **CALM))
    circle = 360.0 / 6.0 + 3.0
    assert motion.duration == pytest.approx(2 * circle + 10.0 + 10.0 + 10.0)
    start = float(motion.course(0.0))
    time = np.linspace(0.0, circle, 200)
    assert float(motion.course(circle)) - start == pytest.approx(2 * np.pi)
    assert np.all(np.diff(motion.course(time)) >= 0.0)
    assert float(motion.course(2 * circle)) == pytest.approx(start)
    assert motion.speed(2 * circle + np.array([0.0, 10.0, 15.0, 20.0, 30.0])) == pytest.approx(
        [4.0, 0.0, 0.0, 0.0, 4.0], abs=1e-9
    )
    at_rest = scenario(start={"speed_m_s": 0}, manoeuvres=[{"stop_s": 10}])
    assert plan_motion(at_rest).duration == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("manoeuvre", "message"),
    [
        ({"figure_eight_deg_s": 0}, "must not be 0"),
        ({"figure_eight_deg_s": 90, "ramp_s": 5}, "must not exceed"),
        ({"stop_s": -1}, ">= 0"),
        ({"stop_s": 1, "acceleration_m_s2": 0}, "> 0"),
    ],
)
def test_wrong_manoeuvres(manoeuvre, message):
    with pytest.raises(ConfigError, match=r"manoeuvres\[0\]") as caught:
        scenario(manoeuvres=[manoeuvre])
    assert message in str(caught.value)


def test_a_plan_is_simulated_like_any_scenario():
    trial = simulate(CONFIGS / "plans" / "harbour.yaml", seed=3)
    assert trial.dvl is not None
    assert set(load_scenario(CONFIGS / "plans" / "harbour.yaml").required) == {
        "misalignment_deg", "scale_error", "lever_arm_m",
    }  # fmt: skip
