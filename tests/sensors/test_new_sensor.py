"""A sensor is added by its file, its model in the simulator, and a line in each catalogue."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import factorgraph_dvl

PACKAGE = Path(factorgraph_dvl.__file__).parent
WHEEL = Path(__file__).parent / "wheel"

SCENARIO = {
    "name": "wheel",
    "start": {"lat_deg": 36, "lon_deg": 121, "heading_deg": 30, "speed_m_s": 4},
    "manoeuvres": [{"straight_s": 15}, {"turn_deg_s": 6, "duration_s": 25, "ramp_s": 4}],
    "imu": {"rate_hz": 100, "gyro_noise_deg_sqrt_h": 0.01, "accel_noise_ug_sqrt_hz": 50},
    "gnss": {"rate_hz": 2, "position_std_m": [0.5, 0.5, 1], "velocity_std_m_s": [0.1, 0.1, 0.1]},
    "wheel": {"rate_hz": 2, "scale_error": 0.05},
    "trial": {"imu": {"gyro_bias_std_deg_h": 0.05, "accel_bias_std_ug": 100}},
}
RUN = """
from factorgraph_dvl.cli import main
for line in {commands!r}:
    try:
        main(line)
    except SystemExit as end:
        assert not end.code, (line, end.code)
"""


def add_line(path: Path, before: str, line: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count(before) == 1, before
    path.write_text(text.replace(before, f"{line}{before}"), encoding="utf-8")


@pytest.fixture
def with_wheel(tmp_path: Path) -> Path:
    """A folder with a package that knows the wheel."""
    package = tmp_path / "factorgraph_dvl"
    # With what is compiled: it is as old as the sources.
    shutil.copytree(PACKAGE, package)
    for part, name in (("sensors", "sensor"), ("simulation", "model")):
        shutil.copy(WHEEL / f"{name}.py", package / part / "wheel.py")
    sensors, instruments = (package / part / "catalogue.py" for part in ("sensors", "simulation"))
    add_line(sensors, "AIDS: tuple", "from factorgraph_dvl.sensors.wheel import Wheel\n")
    add_line(sensors, "Usbl),\n)\n\n\n", "Wheel, ")
    add_line(
        instruments,
        "\n\nclass Instrument",
        "\nfrom factorgraph_dvl.simulation.wheel import WheelTruth, simulate_wheel",
    )
    add_line(
        instruments,
        '    "turntable"',
        '    "wheel": Instrument(WheelTruth, simulate_wheel),\n',
    )
    return tmp_path


def test_a_new_sensor_is_simulated_solved_and_reported(
    with_wheel: Path,
) -> None:
    scenario, trial, out = (with_wheel / name for name in ("scenario.yaml", "trial", "out"))
    scenario.write_text(yaml.safe_dump(SCENARIO), encoding="utf-8")
    commands = [
        ["simulate", str(scenario), "--out", str(trial), "--seed", "1"],
        ["inspect", str(trial)],
        ["solve", str(trial), "--out", str(out)],
    ]
    done = subprocess.run(
        [sys.executable, "-c", RUN.format(commands=commands)],
        env={**os.environ, "PYTHONPATH": str(with_wheel)},
        cwd=with_wheel,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (trial / "wheel.csv").read_text().startswith("time_s,speed_m_s")
    assert "speed_std_m_s" in yaml.safe_load((trial / "trial.yaml").read_text())["wheel"]
    found = json.loads((out / "calibration.json").read_text())["parameters"]["wheel_scale_error"]
    assert abs(found["value"][0] - 0.05) < 4.0 * found["std"][0] < 0.05
    assert found["observable"] == [True]
    assert "wheel_scale_error" in done.stdout
    assert (out / "figures" / "wheel_residuals.png").exists()
