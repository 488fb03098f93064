"""A calibration is no prior for the data that it came from."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from builders import build_solution, build_trial, edit
from calibrations import calibration
from planar import trial as planar_trial
from truth import TURNING, scenario

from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.calibration_file import encode_calibration, load_calibration
from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.files.solution_folder import load_solution, save_solution
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.replay import replay
from factorgraph_dvl.sensors.fingerprint import fingerprints, shared
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(manoeuvres=TURNING, noise=True), 1)


@pytest.fixture(scope="module")
def other():
    return simulate(scenario(manoeuvres=TURNING, noise=True), 2)


def with_prior(trial, inputs):
    found = replace(calibration(), inputs=inputs)
    return replace(trial, dvl=calibrated_by(trial.dvl, found, trial.body_axes, "before.json"))


def part(imu, rows):
    return Imu(imu.settings, imu.time[rows], imu.gyro[rows], imu.accel[rows], imu.source)


def test_a_trial_refuses_what_came_from_its_own_data(trial, other):
    with pytest.raises(DataError, match="the imu data of this trial itself"):
        with_prior(trial, trial.inputs)
    # One table in common is enough.
    for text in trial.inputs:
        with pytest.raises(DataError, match=f"the {text.partition(':')[0]} data"):
            with_prior(trial, (*other.inputs, text))
    assert with_prior(trial, other.inputs).dvl.prior is not None
    assert with_prior(trial, ()).dvl.prior is not None


def test_a_chain_of_priors_is_followed(trial, other):
    third = with_prior(other, trial.inputs)
    assert set(third.inputs) == {*other.inputs, *trial.inputs}
    with pytest.raises(DataError, match="of this trial itself"):
        with_prior(trial, third.inputs)


@pytest.mark.parametrize("parquet", [False, True])
def test_names_and_formats_do_not_matter(tmp_path, trial, parquet):
    save_trial(replace(trial, name="copy"), tmp_path / "copy", parquet=parquet)
    suffix = "parquet" if parquet else "csv"
    (tmp_path / "copy" / f"imu.{suffix}").rename(tmp_path / f"moved.{suffix}")
    edit(tmp_path / "copy" / "trial.yaml", f"imu.{suffix}", f"../moved.{suffix}")
    assert load_trial(tmp_path / "copy").inputs == trial.inputs


@pytest.mark.parametrize("rows", [slice(0, 3000), slice(2000, None), slice(0, None, 2)])
def test_a_part_of_a_record_is_recognised(trial, other, rows):
    whole = fingerprints([trial.imu])
    if rows.step is None:
        cut = fingerprints([part(trial.imu, rows)])
    else:
        thinned = replace(trial.imu, time=trial.imu.time[rows], gyro=trial.imu.gyro[rows],
                          accel=trial.imu.accel[rows])  # fmt: skip
        cut = fingerprints([thinned])
    assert shared(whole, cut) == shared(cut, whole) == "imu"
    assert shared(fingerprints([other.imu]), cut) == ""


def dive(seed):
    scene = scenario(
        manoeuvres=TURNING, noise=True, depth={"rate_hz": 2, "std_m": 0.05},
        turntable={"rate_hz": 10, "turns": [{"at_s": 10, "turn_deg": 90, "duration_s": 20}]},
    )  # fmt: skip
    return simulate(scene, seed)


def test_narrow_tables_are_recognised_by_runs_of_rows():
    a, b = dive(1), dive(2)
    sections = {text.partition(":")[0] for text in a.inputs}
    # The turntable turns by the same program in both.
    assert sections == {"imu", "gnss", "dvl", "depth"}
    assert shared(a.inputs, b.inputs) == ""
    depth = a.depth
    rows = slice(20, 120)
    later = replace(depth, time=depth.time[rows], depth=depth.depth[rows])
    assert shared(fingerprints([later]), a.inputs) == "depth"


def test_a_depth_that_stays_is_no_sign_of_the_same_data():
    depth = dive(1).depth
    calm = replace(depth, depth=np.zeros(depth.time.size))
    assert fingerprints([calm]) == ()


def test_planar_trials_have_fingerprints():
    a, b = planar_trial(1), planar_trial(2)
    assert {text.partition(":")[0] for text in a.inputs} == {"heading", "log", "depth", "beacons"}
    assert shared(a.inputs, planar_trial(1).inputs)
    assert shared(a.inputs, b.inputs) == ""


def test_a_short_stretch_in_common_is_none_of_the_data(trial, other):
    """Simulations of one seed may begin with the same samples."""
    gyro = other.imu.gyro.copy()
    accel = other.imu.accel.copy()
    n = gyro.shape[0] // 5
    gyro[:n], accel[:n] = trial.imu.gyro[:n], trial.imu.accel[:n]
    assert shared(fingerprints([replace(other.imu, gyro=gyro, accel=accel)]), trial.inputs) == ""


def test_every_solver_writes_what_its_result_came_from(tmp_path, trial):
    replayed, _ = replay(trial, rate_hz=1.0)
    for solution in (solve(trial), calibrate(trial, "least-squares")[0], replayed):
        assert solution.inputs == trial.inputs
        save_solution(solution, tmp_path / "out", force=True)
        assert load_solution(tmp_path / "out").inputs == trial.inputs
        save_trial(trial, tmp_path / "again", force=True)
        edit(tmp_path / "again" / "trial.yaml", "dvl:\n", "dvl:\n  calibration: ../out\n")
        with pytest.raises(DataError, match=r"dvl\.calibration: \.\./out: the calibration came"):
            load_trial(tmp_path / "again")


def test_a_saved_trial_keeps_the_fingerprints_of_its_prior(tmp_path, trial, other):
    save_trial(with_prior(other, trial.inputs), tmp_path / "t")
    assert set(load_trial(tmp_path / "t").inputs) == {*other.inputs, *trial.inputs}


def test_files_without_fingerprints_are_read_and_wrong_ones_refused(tmp_path):
    file = tmp_path / "calibration.json"
    content = json.loads(encode_calibration(build_solution()))
    del content["inputs"]
    file.write_text(json.dumps(content))
    assert load_calibration(file).inputs == ()
    for bad in ("imu", "imu:xyz", "imu:0123"):
        file.write_text(json.dumps(content | {"inputs": [bad]}))
        with pytest.raises(DataError, match="inputs"):
            load_calibration(file)


def test_lost_measurements_and_signed_zeros_make_no_difference():
    dvl = build_trial().dvl
    empty = replace(dvl, velocity=np.full_like(dvl.velocity, np.nan))
    assert fingerprints([empty]) == ()
    zero = replace(dvl, velocity=0.0 * dvl.velocity)
    assert fingerprints([zero]) == fingerprints([replace(dvl, velocity=-0.0 * dvl.velocity)])
