"""Damaged and absurd files: every reader answers with an error that names what is wrong."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
import yaml
from builders import build_solution, build_trial
from everything import EVERYTHING, PLANAR
from hypothesis import given, settings
from hypothesis import strategies as st
from truth import CONFIGS

from factorgraph_dvl.errors import FactorgraphDvlError
from factorgraph_dvl.files.external_results import (
    load_results,
    load_truth,
    read_calibration_values,
)
from factorgraph_dvl.files.segments_file import read_segments
from factorgraph_dvl.files.solution_folder import load_solution, save_solution
from factorgraph_dvl.files.trial_folder import load_trial, read_record, save_trial
from factorgraph_dvl.files.trial_yaml import TrialSettings
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.sensors.depth import Depth, DepthSettings
from factorgraph_dvl.settings.yaml_file import parse_yaml
from factorgraph_dvl.simulation import load_scenario, parse_scenario, simulate

SEED = 20240131
# No file here takes longer than this to be refused; a hang takes for ever.
SLOWEST_S = 10.0

VALUES = (
    *("1e308", "-1e308", "1e-308", "1e30", "-1", "0", "999999999", "9e18", ".nan", ".inf", "nan"),
    *("-inf", "1e999", "1" * 400, "0x1F", "true", "null", "", "''", "text", "[]", "{}", "[1, 2]"),
    *("[[1], 2]", "{a: 1}", "&a [*a]", "*a", "!!python/none", "2022-10-12", '"\\e[31m\\x9b"'),
    *("\u202eabc", "/dev/zero", "../..", "'\\0'", "|", "- - -", "{", "]", ":", "\t", "%", "@"),
)
IMU = {
    "gyro_noise_deg_sqrt_h": 0.01,
    "gyro_bias_std_deg_h": 1,
    "accel_noise_ug_sqrt_hz": 100,
    "accel_bias_std_ug": 1000,
}
SEGMENTS = "segments:\n  - {start_s: 0, end_s: 12, label: alongside}\n"
TYPED_IN = (
    "body_axes: RFU\nparameters:\n  misalignment_deg: [1, 2, 3]\n"
    "  scale_error: {value: 0.01, std: 0.001}\n  lever_arm_m: {value: [1, 2, 3], std: [1, 1, 1]}\n"
)


def look(path: Path) -> None:
    """Load a trial, and survey it."""
    survey(load_trial(path))


def look_with_calibration(path: Path) -> None:
    trial = load_trial(path)
    assert trial.dvl is not None
    trial.dvl.parameters()


Case = tuple[Path, Path, Callable[[Path], object]]


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    """What is damaged, what is given to the reader, and the reader."""
    home = tmp_path_factory.mktemp("readers")
    every = simulate(parse_scenario(EVERYTHING))
    save_trial(every, home / "csv")
    save_trial(every, home / "parquet", parquet=True)
    save_trial(simulate(parse_scenario(PLANAR)), home / "planar")
    save_solution(replace(build_solution(), body_axes="RFU"), home / "solution")
    save_trial(build_trial(seconds=10.0), home / "dive")
    shutil.copy(home / "solution" / "calibration.json", home / "dive")
    settings_file = home / "dive" / "trial.yaml"
    described = yaml.safe_load(settings_file.read_text())
    described["dvl"]["calibration"] = "calibration.json"
    settings_file.write_text(yaml.safe_dump(described))
    (home / "segments.yaml").write_text(SEGMENTS)
    (home / "typed.yaml").write_text(TYPED_IN)
    shutil.copy(CONFIGS / "cruise-beams.yaml", home / "scenario.yaml")
    shutil.copy(CONFIGS / "plans" / "harbour.yaml", home / "plan.yaml")

    def in_folder(name: str, read: Callable[[Path], object]) -> list[Case]:
        return [(file, home / name, read) for file in sorted((home / name).iterdir())]

    def alone(name: str, read: Callable[[Path], object]) -> Case:
        return home / name, home / name, read

    calibration = home / "solution" / "calibration.json"
    out = [
        *in_folder("csv", look),
        *in_folder("parquet", look),
        *in_folder("planar", look),
        *in_folder("solution", load_solution),
        (calibration, calibration, lambda path: read_calibration_values(path, "RFU")),
        (home / "dive" / "calibration.json", home / "dive", look_with_calibration),
        alone("segments.yaml", read_segments),
        alone("typed.yaml", lambda path: load_results(path, path)),
        alone("typed.yaml", lambda path: load_truth(None, path)),
        alone("typed.yaml", lambda path: read_calibration_values(path, "RFU")),
        alone("scenario.yaml", load_scenario),
        alone("plan.yaml", load_scenario),
    ]
    table = home / "solution" / "trajectory.csv"
    out.append((table, table, lambda path: load_results(path, path)))
    return [case for case in out if case[0].is_file()]


def damage(content: bytes, rng: random.Random) -> bytes:
    """Return a file's content with something wrong in it."""
    kind = rng.randrange(14)
    at = rng.randrange(len(content) + 1)
    if kind == 0:
        out = bytearray(content)
        for _ in range(rng.choice((1, 3, 20))):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
        return bytes(out)
    if kind == 1:
        return content[:at]
    if kind == 2:
        return content[:at] + bytes(rng.randrange(256) for _ in range(8)) + content[at:]
    if kind == 3:
        return rng.choice((b"", b"\n", b"\0" * 50, b"PAR1", b"{}", b"[" * 5000, b"{a: " * 3000))
    if kind == 4:
        return b"\xef\xbb\xbf" + content
    if kind == 5:
        return content.replace(b"\n", b"\r\n")
    if kind == 6:
        return content.decode("utf-8", "replace").encode("utf-16")
    if kind == 7:
        return content[:at] + content[at // 2 :]
    lines = content.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    if kind == 8:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 9:
        del lines[i]
    else:
        # A value, after a colon or a comma, becomes another.
        mark = b":" if b":" in lines[i] and rng.random() < 0.7 else b","
        parts = lines[i].split(mark)
        where = rng.randrange(len(parts))
        parts[where] = b" " + rng.choice(VALUES).encode()
        lines[i] = mark.join(parts)
    return b"\n".join(lines)


def fuzz(cases: list[Case], count: int, seconds: float) -> tuple[int, list[str]]:
    """Return how many inputs were read, and what came out of readers that should not."""
    rng = random.Random(SEED)
    bad: list[str] = []
    start = perf_counter()
    done = 0
    while done < count and perf_counter() - start < seconds:
        file, given_to_reader, read = cases[done % len(cases)]
        sound = file.read_bytes()
        broken = damage(sound, rng)
        file.write_bytes(broken)
        before = perf_counter()
        try:
            with suppress(FactorgraphDvlError):
                read(given_to_reader)
        except BaseException as error:
            bad.append(f"{done} {file.parent.name}/{file.name}: {type(error).__name__}: {error}")
            keep = os.environ.get("FACTORGRAPH_DVL_FUZZ_KEEP")
            if keep:
                Path(keep, f"{done}-{file.name}").write_bytes(broken)
        finally:
            file.write_bytes(sound)
        took = perf_counter() - before
        if took > SLOWEST_S:
            bad.append(f"{done} {file.parent.name}/{file.name}: took {took:.1f} s")
        done += 1
    return done, bad


def test_sound_files_are_read(cases: list[Case]) -> None:
    for _, given_to_reader, read in cases:
        read(given_to_reader)


def test_damaged_files_raise_nothing_else(cases: list[Case]) -> None:
    done, bad = fuzz(cases, 150, 25.0)
    assert done >= len(cases)
    assert not bad, "\n".join(bad)


@pytest.mark.slow
def test_many_damaged_files_raise_nothing_else(cases: list[Case]) -> None:
    done, bad = fuzz(cases, 1500, 3600.0)
    assert done == 1500
    assert not bad, f"{len(bad)} of {done}\n" + "\n".join(bad)


# Whatever YAML can hold, of moderate size.
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4)
    ),
    max_leaves=8,
)


@settings(
    derandomize=True,
    max_examples=60,
    deadline=None,
)
@given(data=st.data())
def test_any_value_of_any_key_is_read_or_refused(data: st.DataObject) -> None:
    section = data.draw(st.sampled_from(sorted(EVERYTHING)))
    value = data.draw(ANYTHING)
    scenario = dict(EVERYTHING)
    inner = scenario[section]
    if isinstance(inner, dict) and data.draw(st.booleans()):
        scenario[section] = inner | {data.draw(st.sampled_from(sorted(inner))): value}
    else:
        scenario[section] = value
    with suppress(FactorgraphDvlError):
        parse_scenario(scenario)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(
    key=st.sampled_from(("file", "std_m", "lever_arm_m", "sea_surface_height_m")), value=ANYTHING
)
def test_any_setting_of_a_trial_is_read_or_refused(key: str, value: object) -> None:
    described = {"format": 1, "imu": IMU, "depth": {key: value}}
    with suppress(FactorgraphDvlError):
        parse_yaml(yaml.safe_dump(described), TrialSettings, source="trial.yaml")


@settings(derandomize=True, max_examples=60, deadline=None)
@given(cells=st.lists(st.tuples(st.floats(), st.floats()), min_size=1, max_size=5))
def test_any_numbers_in_a_table_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, cells: list[tuple[float, float]]
) -> None:
    path = tmp_path_factory.mktemp("tables")
    rows = "".join(f"{time!r},{depth!r}\n" for time, depth in cells)
    (path / "depth.csv").write_text("time_s,depth_m\n" + rows)
    with suppress(FactorgraphDvlError):
        record = read_record(path, Depth, DepthSettings(), [])
        assert np.all(np.diff(record.time) > 0.0)
        assert np.all(np.isnan(record.depth) | (np.abs(record.depth) <= 12e3))
