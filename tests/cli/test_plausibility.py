"""What `inspect` calls an error, the commands that solve say in the same words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from builders import build_solution, write_trial
from planar import changed
from planar import trial as planar_trial
from truth import CONFIGS, scenario

from factorgraph_dvl import solve
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import DataError, SolveError
from factorgraph_dvl.files.calibration_file import load_calibration
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.plausibility.survey import explained, survey
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.replay import replay
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="module")
def honest():
    return simulate(scenario(noise=True), 1)


def late(trial):
    return replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + 1000.0))


def in_a_gap(trial):
    """Every ping lies where the IMU did not run."""
    imu, dvl = trial.imu, trial.dvl
    runs = (imu.time < 30.0) | (imu.time > 40.0)
    pings = (dvl.time > 31.0) & (dvl.time < 39.0)
    return replace(
        trial,
        imu=replace(imu, time=imu.time[runs], gyro=imu.gyro[runs], accel=imu.accel[runs]),
        dvl=replace(dvl, time=dvl.time[pings], velocity=dvl.velocity[pings], std=dvl.std[pings]),
    )


def silent(trial):
    nothing = np.full_like(trial.dvl.velocity, np.nan)
    return replace(trial, dvl=replace(trial.dvl, velocity=nothing))


def radians(trial):
    geodetic = trial.gnss.geodetic * [DEG, DEG, 1.0]
    return replace(trial, gnss=replace(trial.gnss, geodetic=geodetic))


def radians_without_velocity(trial):
    spoilt = radians(trial)
    nothing = np.full_like(trial.gnss.velocity, np.nan)
    return replace(spoilt, gnss=replace(spoilt.gnss, velocity=nothing))


def zeros(trial):
    geodetic = trial.gnss.geodetic.copy()
    geodetic[7] = 0.0
    return replace(trial, gnss=replace(trial.gnss, geodetic=geodetic))


def east_mirrored(trial):
    return replace(
        trial, gnss=replace(trial.gnss, velocity=trial.gnss.velocity * [-1.0, 1.0, 1.0])
    )


def upside_down(trial):
    return replace(trial, body_axes="FRD")


@pytest.fixture
def run(capsys):
    def run(*args):
        with pytest.raises(SystemExit) as exit_info:
            main([*map(str, args)])
        captured = capsys.readouterr()
        return exit_info.value.code, captured.out, captured.err

    return run


def errors_of(run, trial_path):
    code, out, _ = run("inspect", trial_path)
    *lines, count = out.splitlines()
    found = [line.removeprefix("error: ") for line in lines if line.startswith("error")]
    assert code == 1
    # Errors come last, with their number.
    assert lines[-len(found) :] == [f"error: {text}" for text in found]
    assert count.startswith(f"Errors: {len(found)}.")
    return found


@pytest.fixture(
    scope="module",
    params=[late, in_a_gap, silent, radians, radians_without_velocity],
    ids=lambda spoil: spoil.__name__,
)
def unusable(request, honest, tmp_path_factory):
    """A trial whose records cannot be used, and what is said of them."""
    spoilt = request.param(honest)
    said = [str(f) for f in survey(spoilt).errors if f.unusable]
    assert said
    return write_trial(tmp_path_factory.mktemp("unusable"), spoilt), said


def test_records_that_cannot_be_used_are_errors_to_inspect(unusable, run):
    trial, said = unusable
    assert set(said) <= set(errors_of(run, trial))


@pytest.mark.parametrize("command", ["solve", "replay", "kalman"])
def test_records_that_cannot_be_used_are_refused(command, unusable, tmp_path, run):
    trial, said = unusable
    code, _, err = run(command, trial, "--out", tmp_path / "out", "--no-figures", "--quiet")
    assert code == 2
    assert all(text in err for text in said)
    assert "--anyway" in err
    assert not (tmp_path / "out").exists()


def test_a_refusal_is_overridden(honest, tmp_path, run):
    trial = write_trial(tmp_path, late(honest))
    (said,) = errors_of(run, trial)
    out = tmp_path / "out"
    code, _, err = run("solve", trial, "--out", out, "--no-figures", "--quiet", "--anyway")
    assert code == 1
    assert said in err
    assert said in load_calibration(out).warnings
    assert not (out / "instrument.yaml").exists()


@pytest.mark.parametrize(
    ("command", "spoil"),
    [
        ("solve", east_mirrored),
        pytest.param("replay", upside_down, marks=pytest.mark.slow),
        pytest.param("kalman", east_mirrored, marks=pytest.mark.slow),
    ],
)
def test_what_contradicts_is_a_finding_of_the_result(command, spoil, honest, tmp_path, run):
    trial = write_trial(tmp_path, spoil(honest))
    said = errors_of(run, trial)
    assert said
    arguments = ("--out", tmp_path / "out", "--rate", "1", "--no-figures", "--quiet")
    code, _, err = run(command, trial, *arguments)
    assert code == 1
    assert all(text in err for text in said)
    if (tmp_path / "out").exists():
        assert set(said) <= set(load_calibration(tmp_path / "out").warnings)
        assert not (tmp_path / "out" / "instrument.yaml").exists()


@pytest.fixture(scope="module")
def values(tmp_path_factory):
    """A file of calibration values."""
    path = tmp_path_factory.mktemp("values") / "values.json"
    path.write_text('{"misalignment_deg": [2, 2, 30], "lever_arm_m": [1, 1.2, 1.4]}')
    return path


@pytest.mark.parametrize("command", ["observability", "deadreckon"])
def test_what_is_made_of_a_trial_repeats_its_errors(command, honest, values, tmp_path, run):
    trial = write_trial(tmp_path, upside_down(honest))
    more = (values,) if command == "deadreckon" else ()
    arguments = (command, trial, *more, "--no-figures", "--quiet")
    (said,) = errors_of(run, trial)
    code, _, err = run(*arguments, "--out", tmp_path / "out")
    assert code == 1
    assert said in err
    assert "not to be used" in err
    spoilt = write_trial(tmp_path / "late", late(honest))
    code, _, err = run(command, spoilt, *more, "--no-figures", "--out", tmp_path / "none")
    assert code == 2
    assert "do not overlap" in err
    assert not (tmp_path / "none").exists()


def test_the_observability_of_a_contradicted_solution_is_one(honest, tmp_path, run):
    spoilt = build_solution().with_findings(survey(upside_down(honest)).errors)
    save_solution(spoilt, tmp_path / "solved")
    code, _, err = run("observability", tmp_path / "solved", "--out", tmp_path / "out", "--quiet")
    assert code == 1
    assert "not to be used" in err


def test_a_plan_is_checked_as_a_trial_is(tmp_path, run):
    plan = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text(encoding="utf-8"))
    del plan["required"]
    plan["dvl"]["no_lock_s"] = [[0, 1000]]
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan), encoding="utf-8")
    arguments = ("plan", tmp_path / "plan.yaml", "--no-figures", "--quiet")
    code, _, err = run(*arguments, "--out", tmp_path / "out")
    assert code == 2
    assert "DVL: none of its rows contains a measurement" in err
    assert not (tmp_path / "out").exists()
    code, _, err = run(*arguments, "--out", tmp_path / "out", "--anyway")
    assert code == 1
    assert "DVL: none of its rows" in err


def test_a_steady_plan_is_not_frozen(tmp_path, run):
    plan = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text(encoding="utf-8"))
    del plan["required"]
    steady = {"manoeuvres": [{"straight_s": 60}], "sway": {}, "current_m_s": [0, 0, 0]}
    plan["start"]["speed_m_s"] = 2
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(plan | steady), encoding="utf-8")
    arguments = ("plan", tmp_path / "plan.yaml", "--no-figures", "--quiet")
    code, _, err = run(*arguments, "--out", tmp_path / "out")
    assert (code, "not to be used" in err) == (0, False)


def test_python_refuses_what_the_commands_refuse(honest):
    for spoilt in (late(honest), zeros(honest)):
        for run in (solve, replay):
            with pytest.raises(DataError, match="anyway=True"):
                run(spoilt)
    assert errors_in(solve(late(honest), anyway=True)) == errors_in(survey(late(honest)))


def test_a_solution_repeats_the_errors_of_its_records(honest):
    spoilt = east_mirrored(honest)
    assert errors_in(survey(spoilt))
    assert errors_in(solve(spoilt))[:1] == errors_in(survey(spoilt))


def test_a_failure_names_the_errors_of_the_records(honest):
    errors = survey(upside_down(honest)).errors
    with pytest.raises(SolveError) as caught, explained(errors):
        raise SolveError("no minimum")
    assert caught.value.__notes__ == list(map(str, errors))


def errors_in(found):
    return tuple(f for f in found.findings if f.severity == "error")


def test_an_honest_trial_is_neither(honest, tmp_path, run):
    trial = write_trial(tmp_path, honest)
    code, _, err = run("solve", trial, "--out", tmp_path / "out", "--no-figures", "--quiet")
    assert (code, "error" in err) == (0, False)
    assert (tmp_path / "out" / "instrument.yaml").exists()


def test_beacons_of_another_time_are_refused_in_the_plane(tmp_path, run):
    t = planar_trial(6)
    moved = changed(t, replace(t.beacons, time=t.beacons.time + 1e5))
    save_trial(moved, tmp_path / "t")
    (said,) = errors_of(run, tmp_path / "t")
    code, _, err = run("solve", tmp_path / "t", "--out", tmp_path / "out", "--quiet")
    assert code == 2
    assert said in err


def test_a_stated_clock_offset_counts(honest):
    settings = type(honest.dvl.settings)(time_offset_s=1000.0)
    dvl = replace(honest.dvl, time=honest.dvl.time + 1000.0, settings=settings)
    assert not survey(replace(honest, dvl=dvl)).errors


@pytest.mark.parametrize("seed", range(3))
def test_sway_of_a_slow_vessel_is_no_wrong_unit(seed):
    sway = {
        "roll": [{"amplitude_deg": 8, "frequency_hz": 0.25}],
        "pitch": [{"amplitude_deg": 5, "frequency_hz": 0.3, "phase_deg": 60}],
    }
    slow = {"lat_deg": 36, "lon_deg": 121, "heading_deg": 30, "speed_m_s": 0.5}
    scene = scenario(
        noise=True, start=slow, manoeuvres=[{"straight_s": 90}], sway=sway,
        dvl={"lever_arm_m": [3, 2, -6]},
    )  # fmt: skip
    assert survey(simulate(scene, seed)).errors == ()


def test_every_error_has_a_code(honest):
    for spoil in (late, silent, radians, zeros, east_mirrored, upside_down):
        errors = survey(spoil(honest)).errors
        assert errors
        assert all(isinstance(f, Finding) and f.code for f in errors)


def test_fixes_at_zero_in_a_file_are_missing_and_counted(honest, tmp_path):
    trial = load_trial(write_trial(tmp_path, zeros(honest)))
    assert [str(note) for note in trial.notes if note.code == Code.INVALID_VALUES] == [
        "GNSS: 1 fixes at 0, 0 in gnss.csv were taken as missing"
    ]
    assert not any(f.code == Code.ZERO_FIXES for f in survey(trial).findings)
