from __future__ import annotations

import pytest
from plans import STRAIGHT, required_of
from truth import CONFIGS, scenario

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.planning import predict
from factorgraph_dvl.simulation import load_scenario


def test_requirements():
    prediction = predict(scenario(**STRAIGHT))
    found = required_of(
        prediction, misalignment_deg=(0.1, 0.2, 0.3), lever_arm_m=0.5, lever_arm_z_m=20.0
    )
    assert {r.component: r.required for r in found} == {
        "misalignment_x_deg": 0.1,
        "misalignment_y_deg": 0.2,
        "misalignment_z_deg": 0.3,
        "lever_arm_x_m": 0.5,
        "lever_arm_y_m": 0.5,
        "lever_arm_z_m": 20.0,
    }
    assert [r.component for r in found if r.met] == ["lever_arm_z_m"]
    with pytest.raises(ConfigError, match=r"required\.lever_arm: .* is not estimated"):
        required_of(prediction, lever_arm=0.1)
    with pytest.raises(ConfigError, match="2 numbers are given; expected 1, or 3"):
        required_of(prediction, lever_arm_m=(0.1, 0.1))


@pytest.mark.parametrize("value", ["0", "-1", "[]", "much", "[1, x]", "{a: 1}", ".nan"])
def test_wrong_requirements(value, tmp_path):
    text = (CONFIGS / "plans" / "harbour.yaml").read_text()
    file = tmp_path / "plan.yaml"
    file.write_text(text.partition("required:")[0] + f"required:\n  scale_error: {value}\n")
    with pytest.raises(ConfigError, match=r"plan.yaml.*required"):
        load_scenario(file)
