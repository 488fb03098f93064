"""Settings do what the vehicle or the instrument makes of them, by its own document."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import format_logs as logs
import numpy as np
import pytest
from calibrations import calibration
from running import Run, run
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.vehicle_settings import TARGETS, settings_text
from factorgraph_dvl.cli.options import Target
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.files.calibration_file import encode_calibration
from factorgraph_dvl.files.formats.vehicles import telemetry
from factorgraph_dvl.solution import Calibration

__all__ = ["run"]
# Right, forward, up to forward, right, down; and to forward, port, up.
FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ALPHAS = [np.array([1.0, -2.0, -88.0]), np.array([2.0, 3.0, 170.0]), np.array([-1.0, 0.5, 25.0])]
# ArduPilot's enumeration of rotations, as it turns a vector (x, y, z) of the sensor.
TURNS = {
    0: lambda x, y, z: (x, y, z),
    2: lambda x, y, z: (-y, x, z),
    4: lambda x, y, z: (-x, -y, z),
    6: lambda x, y, z: (y, -x, z),
}


def known(alpha: np.ndarray, late: float | None = None) -> Calibration:
    """Return a calibration without limits, whose DVL has stamps that are late."""
    found = replace(calibration(alpha=alpha), limits={})
    if late is None:
        return found
    one, yes = np.ones(1), np.ones(1, dtype=bool)
    clock = Estimate(
        "time_offset_s", ("time_offset_s",), late * one, 1e-3 * one, 0.0 * one, one, yes
    )
    n = len(found.covariance)
    covariance = np.zeros((n + 1, n + 1))
    covariance[:n, :n], covariance[n, n] = found.covariance, 1e-6
    return replace(found, estimates=(*found.estimates, clock), covariance=covariance)


def from_dvl(alpha: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return C_d^b in other axes than right, forward, up, by the definition of the parameter."""
    return to @ Rotation.from_rotvec(alpha, degrees=True).as_matrix().T @ to.T


def settings(text: str) -> dict[str, str]:
    return dict(line.split(",") for line in text.splitlines() if not line.startswith("#"))


def numbers(text: str) -> np.ndarray:
    return np.array([float(x) for x in text.split()])


@pytest.mark.parametrize("alpha", ALPHAS)
def test_urdf(alpha: np.ndarray) -> None:
    """XYZ and RPY about fixed axes, as the specification of joints has them."""
    text = settings_text(known(alpha), "urdf")
    joint = ElementTree.fromstring(f"<robot>{text}</robot>").find("joint")
    assert joint is not None
    assert joint.find("parent").attrib == {"link": "imu_link"}  # type: ignore[union-attr]
    origin = joint.find("origin").attrib  # type: ignore[union-attr]
    np.testing.assert_allclose(numbers(origin["xyz"]), FLU @ [1.0, 2.0, 3.0])
    turned = Rotation.from_euler("xyz", numbers(origin["rpy"])).as_matrix()
    np.testing.assert_allclose(turned, from_dvl(alpha, FLU), atol=2e-6)
    assert np.abs(turned - from_dvl(alpha, FLU).T).max() > 0.1


@pytest.mark.parametrize("alpha", ALPHAS)
def test_tf(alpha: np.ndarray) -> None:
    text = settings_text(known(alpha), "tf").splitlines()[-1]
    found = dict(re.findall(r"--([a-z-]+) (\S+)", text))
    assert (found["frame-id"], found["child-frame-id"]) == ("imu_link", "dvl_link")
    place = [float(found[name]) for name in "xyz"]
    np.testing.assert_allclose(place, FLU @ [1.0, 2.0, 3.0])
    # The quaternion that tf2 makes of roll, pitch, yaw.
    r, p, y = (float(found[name]) / 2.0 for name in ("roll", "pitch", "yaw"))
    (cr, cp, cy), (sr, sp, sy) = np.cos([r, p, y]), np.sin([r, p, y])
    quaternion = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    turned = Rotation.from_quat(quaternion).as_matrix()
    np.testing.assert_allclose(turned, from_dvl(alpha, FLU), atol=2e-6)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_ardupilot_has_the_velocity_of_the_vehicle(alpha: np.ndarray) -> None:
    """Movements of the DVL, turned and moved as AP_VisualOdom and the filter do it."""
    text = settings_text(known(alpha, late=0.12), "ardupilot")
    found = settings(text)
    assert found["VISO_DELAY_MS"] == "120"
    assert float(found["VISO_SCALE"]) == pytest.approx(1.0 / 1.01, abs=1e-5)
    offset = np.array([float(found[f"VISO_POS_{axis}"]) for axis in "XYZ"])
    np.testing.assert_allclose(offset, FRD @ [1.0, 2.0, 3.0])
    # The vehicle goes ahead and turns; its DVL sees that where it is mounted.
    velocity, omega = np.array([1.0, 0.2, -0.1]), np.array([0.02, -0.05, 0.3])
    seen = from_dvl(alpha, FRD).T @ (velocity + np.cross(omega, FRD @ [1.0, 2.0, 3.0]))
    turned = np.array(TURNS[int(found["VISO_ORIENT"])](*seen))
    rest = re.search(r"rest is yaw (\S+), pitch (\S+), roll (\S+) deg", text)
    assert rest is not None
    left = Rotation.from_euler("ZYX", [float(x) for x in rest.groups()], degrees=True)
    # What is left is small, except where the DVL is turned by an odd angle.
    assert np.abs(left.as_rotvec(degrees=True)).max() < 30.0
    quarter = np.array([TURNS[int(found["VISO_ORIENT"])](*axis) for axis in np.eye(3)]).T
    turned = quarter @ left.as_matrix() @ quarter.T @ turned
    np.testing.assert_allclose(turned - np.cross(omega, offset), velocity, atol=3e-4)


def test_ardupilot_counts_the_delay_from_when_a_movement_came_in(tmp_path: Path) -> None:
    """`writeBodyFrameOdom`: the mean velocity of a movement counts at its arrival - VISO_DELAY_MS.

    The vehicle gathers speed; each movement is over 0.2 s, and arrives 0.05 s after its end. What
    import writes is late by 0.05 s, and what ArduPilot subtracts must be half an interval more.
    """
    pytest.importorskip("pymavlink")
    interval, latency, acceleration = 0.2, 0.05, 0.3
    data = b""
    for i in range(1, 40):
        end = 100.0 + interval * i
        delta = 0.5 * acceleration * (end**2 - (end - interval) ** 2)
        arrival = logs.START + end + latency
        values = (0, round(interval * 1e6), 0.0, 0.0, 0.0, delta, 0.0, 0.0, 100.0)
        data += logs.telemetry("VISION_POSITION_DELTA", arrival, *values)
    (tmp_path / "a.tlog").write_bytes(data)
    batches = telemetry.read(tmp_path / "a.tlog")
    found = np.concatenate([b.records for b in batches if b.kind == "dvl"])
    stamps = found["time"] + found["delay"] - logs.START
    ahead = found["velocity"][:, 0]
    np.testing.assert_allclose(ahead, acceleration * (stamps - latency), rtol=1e-6)
    counts_at = found["time"] - logs.START - (latency + interval / 2.0)
    np.testing.assert_allclose(ahead, acceleration * counts_at, rtol=1e-6)
    text = settings_text(known(ALPHAS[0], late=latency), "ardupilot")
    assert settings(text)["VISO_DELAY_MS"] == "50"
    assert "add half of the" in text


def test_ardupilot_takes_what_it_has_room_for() -> None:
    text = settings_text(known(ALPHAS[0], late=0.4), "ardupilot")
    assert "VISO_DELAY_MS" not in settings(text)
    assert "# VISO_DELAY_MS is 0 to 250: 400 is not" in text
    assert "time offset was not estimated" in settings_text(known(ALPHAS[0]), "ardupilot")
    sideways = settings_text(known(np.array([0.0, 80.0, 0.0])), "ardupilot")
    assert "VISO_ORIENT" not in settings(sideways)
    assert "enter it in your navigation software" in sideways


def test_ardupilot_gets_no_position_from_another_point_than_the_imu() -> None:
    without = replace(known(ALPHAS[0]), inputs=("gnss: 1", "dvl: 2"))
    text = settings_text(without, "ardupilot")
    assert not [name for name in settings(text) if name.startswith("VISO_POS")]
    assert "2.000, 1.000, -3.000 m from the GNSS antenna, not from the IMU" in text


@pytest.mark.parametrize("alpha", ALPHAS)
def test_water_linked(alpha: np.ndarray) -> None:
    """Clockwise rotation of the DVL in the vehicle: what is ahead of the DVL is that far off."""
    text = settings_text(known(alpha), "water-linked")
    (line,) = (line for line in text.splitlines() if line.startswith("{"))
    command = json.loads(line)
    assert command["command"] == "set_config"
    offset = command["parameters"]["mounting_rotation_offset"]
    ahead = from_dvl(alpha, FRD)[:, 0]
    bearing = np.degrees(np.arctan2(ahead[1], ahead[0]))
    assert abs((bearing - offset + 180.0) % 360.0 - 180.0) <= 0.005
    assert 0 <= offset < 360
    assert "scale error: 1.000 %" in text
    # The DVL turns what it sends; the navigation software turns that by what is left.
    angles = re.search(r"after the offset, roll (\S+), pitch (\S+), yaw (\S+) deg", text)
    assert angles is not None
    left = Rotation.from_euler("ZYX", [float(x) for x in angles.groups()][::-1], degrees=True)
    sent = Rotation.from_euler("z", offset, degrees=True)
    turned = (left * sent).as_matrix()
    np.testing.assert_allclose(turned, from_dvl(alpha, FRD), atol=3e-4)


def test_nucleus_has_no_setting() -> None:
    text = settings_text(known(ALPHAS[2]), "nucleus")
    assert all(line.startswith("#") for line in text.splitlines())
    assert "enter it in your navigation software" in text
    assert "yaw 25" in text


@pytest.mark.parametrize("target", TARGETS)
def test_red_and_grey_values_are_comments(target: str) -> None:
    found = known(ALPHAS[0])
    blind = tuple(
        replace(e, observable=np.zeros(e.value.size, dtype=bool)) for e in found.estimates
    )
    text = settings_text(replace(found, estimates=blind), target)
    assert all(line.startswith(("#", "<!--")) for line in text.splitlines())
    if target != "nucleus":
        assert "the trial did not determine it: do not enter" in text


def test_targets_of_the_commands_are_those_there_are() -> None:
    assert {target.value for target in Target} == set(TARGETS)
    with pytest.raises(ConfigError, match="no target `px4`"):
        settings_text(known(ALPHAS[0]), "px4")


@pytest.mark.parametrize("target", TARGETS)
def test_commands_write_them(target: str, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "calibration.json"
    file.write_bytes(encode_calibration(known(ALPHAS[0])))
    shown = run("instrument", file, "--for", target)
    assert shown.code == 0
    assert shown.out == settings_text(known(ALPHAS[0]), target)
    assert run("export", tmp_path, "--to", target).code == 0
    (path,) = tmp_path.glob(f"dvl-{target}.*")
    assert path.read_text() == shown.out
