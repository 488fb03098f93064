"""What is to be entered in a DVL: the same everywhere, and right when it is entered."""

from __future__ import annotations

import re
from dataclasses import replace
from html import escape, unescape
from pathlib import Path

import numpy as np
import pytest
import yaml
from builders import build_solution
from calibrations import calibration
from running import Run, run

from factorgraph_dvl import load_solution, load_trial, save_trial
from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.analysis.mount import mount_in_words
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.texts import chinese, text_of
from factorgraph_dvl.report.entries import conventions, entries_of, entries_table
from factorgraph_dvl.report.files.instrument import instrument_text
from factorgraph_dvl.report.table import plain

__all__ = ["run"]
SHORT = Path(__file__).parents[2] / "examples" / "short.yaml"
# Right, forward, up to forward, right, down.
SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ROW = re.compile(r"│ ([a-z ]+?) +│ +(-?[\d.]+) ± ([\d.]+) │")


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return Rz(yaw) Ry(pitch) Rx(roll) of angles in deg, written out."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.deg2rad([roll, pitch, yaw])) for f in (np.cos, np.sin))
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return about_z @ about_y @ about_x


def printed(run: Run, trial: Path, out: Path) -> dict[str, tuple[float, float]]:
    """Return the numbers that `solve` prints to be entered, and their standard deviations."""
    result = run("solve", trial, "--out", out, "--no-figures", "--quiet")
    assert result.code == 0
    assert len(result.out.splitlines()) <= 30
    return {name: (float(value), float(std)) for name, value, std in ROW.findall(result.out)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "arm"),
    [
        ([1.0, -2.0, 20.0], [0.8, 1.2, -1.0]),
        ([-3.0, 4.0, -45.0], [-0.6, 2.0, -2.0]),
    ],
)
def test_a_dvl_that_is_configured_as_printed_is_aligned(
    mounting: list[float], arm: list[float], tmp_path: Path, run: Run
) -> None:
    # Given as the attitude of the DVL in the vehicle, in the convention of what is printed.
    C_db = turned(*mounting)
    scenario = yaml.safe_load(SHORT.read_text())
    vector = np.array(_rotation_vector(SWAPPED.T @ C_db.T @ SWAPPED))
    scenario["dvl"] |= {"misalignment_deg": np.rad2deg(vector).tolist(), "lever_arm_m": arm}
    (tmp_path / "scenario.yaml").write_text(yaml.safe_dump(scenario))
    for seed in ("1", "2"):
        made = run(
            "simulate", tmp_path / "scenario.yaml", "--out", tmp_path / seed, "--seed", seed
        )
        assert made.code == 0
    found = printed(run, tmp_path / "1", tmp_path / "first")
    names = ("roll", "pitch", "yaw")
    arms = ("lever arm forward", "lever arm starboard", "lever arm down")
    truth = dict(zip((*names, *arms), [*mounting, *(SWAPPED @ arm)], strict=True))
    truth["scale error"] = 0.5
    assert found.keys() == truth.keys()
    for name, true in truth.items():
        value, std = found[name]
        assert abs(value - true) < 4.0 * std, name

    # Another trial of the same vessel, whose instrument applies what was printed.
    trial = load_trial(tmp_path / "2")
    assert trial.dvl is not None
    assert trial.imu is not None
    C = SWAPPED.T @ turned(*(found[name][0] for name in names)) @ SWAPPED
    velocity = trial.dvl.velocity / (1.0 + 0.01 * found["scale error"][0]) @ C.T
    # A sample of the IMU is the mean of the interval that ends with it.
    middle = trial.imu.time - 0.5 * float(np.median(np.diff(trial.imu.time)))
    rate = np.stack([np.interp(trial.dvl.time, middle, x) for x in trial.imu.gyro.T], axis=1)
    lever = SWAPPED.T @ [found[name][0] for name in arms]
    dvl = replace(trial.dvl, velocity=velocity - np.cross(rate, lever))
    save_trial(replace(trial, dvl=dvl), tmp_path / "configured")
    again = printed(run, tmp_path / "configured", tmp_path / "second")
    for name, (value, std) in again.items():
        # What was entered has an error of its own.
        assert abs(value) < 4.0 * np.hypot(std, found[name][1]), name
        assert abs(value) < 0.3


def _rotation_vector(C: np.ndarray) -> np.ndarray:
    """Return the rotation vector of a rotation by less than half a turn."""
    angle = np.arccos(0.5 * (np.trace(C) - 1.0))
    axis = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    return axis * angle / (2.0 * np.sin(angle))


def test_page_terminal_and_file_have_the_same_numbers(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    assert run("simulate", SHORT, "--out", tmp_path / "t", "--seed", "1").code == 0
    result = run("solve", tmp_path / "t", "--out", out, "--no-figures")
    entries = entries_of(instrument_of(load_solution(out)))
    content = yaml.safe_load((out / "instrument.yaml").read_text())["enter_in_dvl"]
    page = (out / "report.html").read_text(encoding="utf-8")
    verdict = page[page.index('id="verdict"') : page.index('id="calibration"')]
    cells = [unescape(cell) for cell in re.findall(r'<td class="number">(.*?)</td>', verdict)]
    shown = ROW.findall(result.out)
    assert [name for name, _, _ in shown] == [e.name for e in entries]
    for entry, (_, value, std), cell in zip(entries, shown, cells, strict=True):
        assert value == entry.text
        assert cell == f"{value} ± {std}"
        assert content[entry.key] == float(value)
    # So are the words for the mount.
    for said in mount_in_words(instrument_of(load_solution(out)).axes):
        assert text_of(said) in result.out
        assert text_of(said) in (out / "instrument.yaml").read_text()
        assert escape(text_of(said)) in verdict
        assert escape(text_of(said, "zh")) in verdict
    lines = result.out.splitlines()
    assert lines[-1] == f"Open {out}/report.html"
    assert lines.index("Verdict: good") < lines.index(next(x for x in lines if "roll" in x))
    assert "Error budget" not in result.out
    more = run("solve", tmp_path / "t", "--out", out, "--no-figures", "--details", "--force")
    assert "Error budget" in more.out
    assert "misalignment_x" in more.out


def test_what_is_red_or_grey_is_a_comment_with_the_reason() -> None:
    arm = next(e for e in calibration().estimates if e.name == "lever_arm_m")
    unseen = replace(arm, observable=np.array([True, False, True]))
    found = calibration(alpha=np.array([0.0, 0.0, 10.0]))
    others = tuple(unseen if e is arm or e.name == arm.name else e for e in found.estimates)
    # Of the axes right, forward, up, the last is red, and the second of the lever arm grey.
    found = replace(found, estimates=others, limits={"misalignment_deg": 0.11, "lever_arm_m": 1.0})
    text = instrument_text(found)
    assert text.startswith("# Verdict: doubtful\n#   warning: ")
    assert "  # yaw_deg: 10.00  # red: σ is more than twice its limit" in text
    assert "  # lever_arm_forward_m: 2.000  # grey: the trial did not determine it" in text
    content = yaml.safe_load(text)
    assert content["enter_in_dvl"].keys() == {
        *("roll_deg", "pitch_deg", "scale_error_percent"),
        *("lever_arm_starboard_m", "lever_arm_down_m"),
    }
    # Nothing that is made of them is left to be typed either.
    assert content["nortek"] is None
    assert content["trdi"] is None
    assert content["delph"] == {"scale_factor_percent": 1.0}
    assert "lever_arm_m" not in content


def test_the_lever_arm_starts_where_body_quantities_do() -> None:
    for inputs, origin in (
        (("imu:0123456789abcdef", "gnss:0123456789abcdef"), "IMU"),
        (("ins:0123456789abcdef", "gnss:0123456789abcdef"), "INS"),
        (("attitude:0123456789abcdef", "gnss:0123456789abcdef"), "GNSS antenna"),
        ((), "IMU"),
    ):
        text = instrument_text(replace(calibration(), inputs=inputs))
        assert f"# Lever arm: from the {origin} to the DVL." in text


@pytest.mark.parametrize(
    ("maker", "rows"),
    [
        ("Teledyne RDI", {"TRDI EA": "1000", "TRDI EI": "0", "TRDI EJ": "0"}),
        ("Nortek", {"Nortek roll": "0.00", "Nortek pitch": "0.00", "Nortek yaw": "10.00"}),
        (
            "Water Linked AS",
            {
                "Water Linked mounting rotation offset": "10.00",
                "after the offset: roll": "0.00",
                "after the offset: pitch": "0.000",
                "after the offset: yaw": "0.00",
            },
        ),
        ("someone", {}),
    ],
)
def test_the_maker_s_own_names_are_in_the_table(maker: str, rows: dict[str, str]) -> None:
    terms = instrument_of(calibration(alpha=np.array([0.0, 0.0, 10.0])))
    table = entries_table(terms, maker)
    shown = {plain(row[0]): plain(row[1]).split(" ± ") for row in table.rows[7:]}
    assert {name: value for name, (value, _) in shown.items()} == rows
    # Each has its sign rule, and the caption says what to check first.
    assert all(plain(row[3]) for row in table.rows)
    said = " ".join(conventions(terms, maker))
    assert ("if its settings were 0 in the trial" in said) == bool(rows)
    for phrase in (*conventions(terms, maker), *(plain(row[3]) for row in table.rows)):
        assert chinese(phrase) != phrase


def test_a_result_without_a_dvl_has_nothing_to_enter() -> None:
    with pytest.raises(DataError, match="no lever_arm_m"):
        instrument_text(build_solution())


def test_the_sum_of_mount_and_compass_comes_first() -> None:
    text = message(
        "heading_error.bearing",
        axis="y",
        angle=-1.5,
        std=0.3,
        relative=-1.4,
        relative_std=0.02,
        apart="",
    )
    own = calibration(alpha=np.array([0.0, 0.0, 1.5]))
    found = replace(
        own, findings=(Finding(Code.HEADING_ERROR, text, parameter="misalignment_deg"),)
    )
    shown = instrument_text(found)
    assert "# Mount and compass: the y axis of the DVL points -1.5" in shown
    assert shown.index("Mount and compass") < shown.index("enter_in_dvl")
    assert "Mount and compass" not in instrument_text(own)
