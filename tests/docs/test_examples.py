"""The examples, the README's Python and the shipped trial do what they say."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from factorgraph_dvl import load_solution, load_trial, simulate, solve
from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.report.entries import entries_of

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "data" / "seed-a-phase-90"


def test_example_calibrates_the_shipped_trial(monkeypatch, capsys):
    script = ROOT / "examples" / "calibrate.py"
    monkeypatch.setattr("sys.argv", [str(script)])
    runpy.run_path(str(script), run_name="__main__")
    printed = dict(re.findall(r"(\w+) = +(\S+) ±", capsys.readouterr().out))
    truth = load_trial(SHIPPED).calibration_truth
    assert float(printed["lever_arm_z_m"]) == pytest.approx(truth["lever_arm_m"][2], abs=0.003)
    assert float(printed["misalignment_z_deg"]) == pytest.approx(30.0, abs=0.05)


def test_the_yaw_that_the_first_pages_explain_is_that_of_the_shipped_trial():
    entries = entries_of(instrument_of(solve(load_trial(SHIPPED))))
    (yaw,) = (entry for entry in entries if entry.name == "yaw")
    for page in ("getting-started.md", "getting-started.zh.md"):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        ((value, std),) = re.findall(r"`([\d.]+) ± ([\d.]+)` deg", text)
        assert yaw.value == pytest.approx(float(value), abs=0.1 * float(std))


def test_python_of_the_readme(monkeypatch, tmp_path, capsys):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- test: python -->\n```python\n(.*?)```", text, flags=re.DOTALL)
    assert len(blocks) == 1
    for name in ("data", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "observable: [ True  True  True]" in printed
    assert "verdict: good\n" in printed
    assert load_solution(tmp_path / "out-python").converged


def test_yaml_of_the_readme_is_a_trial(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(format: 1\n.*?)```", text, flags=re.DOTALL)
    shipped = load_trial(SHIPPED)
    for name in ("imu", "gnss", "dvl"):
        shutil.copy(SHIPPED / f"{name}.parquet", tmp_path)
        # The certificate has a section of the instrument, too, but no file.
        section = re.compile(rf"^{name}: {{", flags=re.MULTILINE)
        block = section.sub(f"{name}: {{file: {name}.parquet, ", block)
    (tmp_path / "trial.yaml").write_text(block, encoding="utf-8")
    trial = load_trial(tmp_path)
    assert trial.body_axes == "FRD"
    assert trial.imu.time.size == shipped.imu.time.size


def test_shipped_trial_is_what_its_command_makes():
    shipped = load_trial(SHIPPED)
    made = simulate(ROOT / "configs" / "seed-a-phase-90.yaml", seed=1)
    # The last digits are those of the machine's sine; a height is the difference of two lengths
    # of the size of the Earth, whose last digit is 1e-9 m.
    for got, expected in (
        (shipped.imu.time, made.imu.time),
        (shipped.imu.gyro, made.imu.gyro),
        (shipped.imu.accel, made.imu.accel),
        (shipped.gnss.geodetic[:, :2], made.gnss.geodetic[:, :2]),
        (shipped.gnss.velocity, made.gnss.velocity),
        (shipped.dvl.velocity, made.dvl.velocity),
        (shipped.reference.rph, made.reference.rph),
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-11)
    height = shipped.gnss.geodetic[:, 2]
    np.testing.assert_allclose(height, made.gnss.geodetic[:, 2], rtol=0.0, atol=4e-9)
    assert shipped.calibration_truth.keys() == made.calibration_truth.keys()


@pytest.mark.parametrize("name", ["solve", "test"])
def test_readme_marks_its_commands(name):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.search(rf"<!-- command: {name} -->\n```sh\npython3 -m venv .*\n```\n", text)
