from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from truth import CONFIGS, merged

from factorgraph_dvl.cli import main
from factorgraph_dvl.simulation import parse_scenario, plan_motion


def run_cli(capsys, *args):
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    text = capsys.readouterr()
    return caught.value.code, text.out, text.err


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, out = tmp_path / "plan.yaml", tmp_path / "out"
    text = (CONFIGS / "plans" / "harbour.yaml").read_text().partition("required:")[0]
    plan.write_text(text + "required: {misalignment_z_deg: 0.02, scale_error: 0.001}\n")
    code, text, _ = run_cli(capsys, "plan", plan, "--out", out)
    assert code == 0
    found = json.loads((out / "plan.json").read_text())
    assert found["missed"] == ["misalignment_z_deg"]
    proposal = found["proposal"]
    assert proposal["met"]
    assert f"Add {proposal['added_s']:.0f} s" in text
    for name in ("observability.json", "history.csv", "std_along_trial.png", "directions.png"):
        assert (out / name).exists()
    assert json.loads((out / "observability.json").read_text())["kind"] == "plan"
    # What is proposed can be put into the plan as it stands.
    data = yaml.safe_load(plan.read_text())
    data["manoeuvres"] += proposal["manoeuvres"]
    del data["required"]
    assert plan_motion(parse_scenario(data)).duration == pytest.approx(
        found["duration_s"] + proposal["added_s"]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"required": {"lever_arm": 1}}, "required.lever_arm: lever_arm is not estimated"),
        ({"required": [1]}, "required is [1]"),
        ({"manoeuvres": [{"loop_s": 1}]}, "exactly one of"),
        ({"nonsense": 1}, "nonsense"),
    ],
)
def test_wrong_plans(change, message, tmp_path: Path, capsys) -> None:
    file, out = tmp_path / "plan.yaml", tmp_path / "out"
    data = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text())
    file.write_text(yaml.safe_dump(merged(data, change)))
    if isinstance(change.get("required"), dict):
        file.write_text(yaml.safe_dump({**data, **change}))
    code, _, err = run_cli(capsys, "plan", file, "--out", out, "--quiet")
    assert code == 2
    assert "plan.yaml" in err
    assert message in err
    assert not out.exists()


@pytest.mark.parametrize("name", ["no gnss", "no dvl", "adrift", "two seconds"])
def test_plans_that_tell_nothing(name, tmp_path: Path, capsys) -> None:
    changes = {
        "no gnss": {
            "gnss": None,
            "trial": {"gnss": None, "initial": {"position_std_m": [1, 1, 1]}},
        },
        "no dvl": {"dvl": None, "required": None, "trial": {"dvl": None}},
        "adrift": {"manoeuvres": [{"straight_s": 20}], "required": None},
        "two seconds": {"manoeuvres": [{"straight_s": 2}], "required": None},
    }[name]
    data = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text())
    data = merged({**data, "required": None}, {**changes, "required": None})
    file = tmp_path / "plan.yaml"
    file.write_text(yaml.safe_dump(data))
    code, _, err = run_cli(capsys, "plan", file, "--out", tmp_path / "out", "--no-figures")
    assert code == 0, err
    found = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert found["proposal"] is None
    for component in found["predicted"].values():
        assert component["std"] is not None
