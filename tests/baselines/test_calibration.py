"""From a trial to a solution by the point-set methods: all of them, and the command."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from builders import write_trial
from findings import of_code
from kalman_trials import STILL, VARIED, angle_between
from truth import scenario

from factorgraph_dvl.baselines import DVL_METHODS, METHODS, calibration, kalman
from factorgraph_dvl.baselines.navigation import navigate
from factorgraph_dvl.cli import main
from factorgraph_dvl.cli.solve import KalmanMethod
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.solution_folder import load_solution
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="module", autouse=True)
def navigation():
    """Navigate a trial once: it does not depend on the method that calibrates from it."""
    known = {}

    def once(trial, pings, *, smoothed=True):
        key = (id(trial.imu), id(trial.gnss), pings.tobytes(), smoothed)
        if key not in known:
            # With the trial: so long as it is there, no other has its identity.
            known[key] = trial, navigate(trial, pings, smoothed=smoothed)
        return known[key][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "navigate", once)
        yield


# As published they are for small angles, or know the misalignment roughly.
SMALL_ANGLES = ("luo-2024", "nine-state-linear", "nine-state-ukf")
# They leave the angle about the bow open, or come to it slowly; tests/baselines/test_rivals.py.
ABOUT_THE_BOW = ("kinsey-whitcomb", "three-points")
# Fits of research ships average over minutes; tests/baselines/test_ship_adcp.py has theirs.
OF_SHORT_TRIALS = [m for m in DVL_METHODS if m not in ("joyce", "pollard-read")]


HALF_TURNS = ([0, 0, 180], [0, 180, 0])


@pytest.fixture(
    scope="module",
    params=[*(pytest.param(t, marks=pytest.mark.slow) for t in HALF_TURNS), [100, -80, 60]],
    ids=str,
)
def turned(request):
    """A trial without noise, and its large misalignment."""
    dvl = {"misalignment_deg": request.param}
    return simulate(scenario(manoeuvres=VARIED, dvl=dvl, imu={"rate_hz": 50})), request.param


@pytest.mark.parametrize(
    "method", [m for m in OF_SHORT_TRIALS if m not in (*SMALL_ANGLES, *ABOUT_THE_BOW)]
)
def test_without_noise_large_misalignments_are_exact(method, turned):
    trial, misalignment = turned
    knows_arm = method in ("nine-state", "wahba")
    if knows_arm:
        known = msgspec.structs.replace(trial.dvl.settings, lever_arm_m=(1, 1.2, 1.4))
        trial = replace(trial, dvl=replace(trial.dvl, settings=known))
    solution = kalman(trial, method)
    assert solution.converged
    assert solution.solver == f"kalman-{method}"
    assert angle_between(solution, misalignment) < 1e-3
    np.testing.assert_allclose(solution.estimate("scale_error").value, 0.005, atol=1e-4)
    if not knows_arm:
        np.testing.assert_allclose(
            solution.estimate("lever_arm_m").value, [1, 1.2, 1.4], atol=2e-3
        )


@pytest.fixture(
    scope="module",
    params=[
        STILL,
        pytest.param({**STILL, "start": {"speed_m_s": 0}}, marks=pytest.mark.slow),
        pytest.param({"dvl": {"no_lock_s": [[0.0, 100.0]]}}, marks=pytest.mark.slow),
        {"trial": {"dvl": {"misalignment_std_deg": [0, 0, 0], "scale_error_std": 0}}},
    ],
    ids=["straight", "at rest", "no lock", "fixed"],
)
def uninformed(request):
    """A trial that does not determine the misalignment."""
    return simulate(scenario(noise=True, **request.param), 1)


@pytest.mark.parametrize("method", [m for m in OF_SHORT_TRIALS if m != "nine-state-ukf"])
def test_what_is_not_observable_is_said(method, uninformed):
    solution = kalman(uninformed, method)
    assert np.all(np.isfinite(solution.covariance))
    assert not solution.estimate("misalignment_deg").observable.all()
    assert all(np.all(np.isfinite(e.value)) for e in solution.estimates)
    assert of_code(solution.findings, Code.NOT_OBSERVABLE)
    n = sum(e.value.size for e in solution.estimates) - 6
    assert not solution.covariance[:n, n:].any()


@pytest.fixture(scope="module")
def nearly_aligned():
    """A trial without noise, and with a small misalignment."""
    claims = {"dvl": {"misalignment_std_deg": [10, 10, 10]}}
    dvl = {"misalignment_deg": [0.5, -0.3, 0.8], "lever_arm_m": [0, 0, 0]}
    return simulate(scenario(manoeuvres=VARIED, dvl=dvl, imu={"rate_hz": 50}, trial=claims))


@pytest.mark.parametrize("method", SMALL_ANGLES)
def test_small_misalignments_come_out_as_published(method, nearly_aligned):
    solution = kalman(nearly_aligned, method)
    assert solution.solver == f"kalman-{method}"
    assert angle_between(solution, [0.5, -0.3, 0.8]) < 0.1
    np.testing.assert_allclose(solution.estimate("scale_error").value, 0.005, atol=1e-3)


@pytest.mark.parametrize(
    ("method", "text"),
    [
        ("kinsey-whitcomb", "no standard deviations of its own"),
        ("differential-evolution", "no standard deviations of its own"),
        ("three-points", "errors of the positions alone"),
        ("wahba", None),
    ],
)
def test_a_method_says_what_its_standard_deviations_are_not(method, text, nearly_aligned):
    said = of_code(kalman(nearly_aligned, method).findings, Code.METHOD_LIMITS)
    of_sigma = [s for s in said if "no standard deviations" in s or "positions alone" in s]
    assert len(of_sigma) == (text is not None)
    assert all(text in s for s in of_sigma)


def test_bad_input():
    trial = simulate(scenario())
    with pytest.raises(DataError, match="needs GNSS positions"):
        kalman(replace(trial, gnss=None))
    with pytest.raises(DataError, match="no DVL"):
        kalman(replace(trial, dvl=None))
    with pytest.raises(ConfigError, match="method is 'ukf'"):
        kalman(trial, "ukf")
    with pytest.raises(ConfigError, match="rate_hz"):
        kalman(trial, rate_hz=0.0)
    with pytest.raises(ConfigError, match="through the water"):
        kalman(simulate(scenario(dvl={"reference": "water"})))
    late = replace(trial.gnss, time=trial.gnss.time + 1e4)
    with pytest.raises(DataError, match="no GNSS position while"):
        kalman(replace(trial, gnss=late))


def run(*args):
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    return caught.value.code


def test_command_line(tmp_path, capsys):
    # Wahba takes the lever arm as known.
    claims = {"dvl": {"lever_arm_m": [1, 1.2, 1.4]}}
    trial = write_trial(tmp_path, simulate(scenario(noise=True, trial=claims), 0))
    out = tmp_path / "out"
    named = [m.value for m in KalmanMethod]
    # The linear filter is an option of the iterated one.
    assert named == [m for m in METHODS if m != "nine-state-linear"]
    assert run("kalman", trial, "--out", out, "--quiet", "--no-figures", "--rate", "5") == 0
    assert {p.name for p in out.iterdir()} == {
        "calibration.json",
        "instrument.yaml",
        "trajectory.csv",
        "history.csv",
        "residuals.parquet",
        "report.html",
        "run.json",
    }
    solution = load_solution(out)
    assert solution.solver == "kalman-point-set"
    np.testing.assert_allclose(np.diff(solution.trajectory.time), 0.2)
    columns = ["time_s", "misalignment_z_deg", "misalignment_z_deg_std", "lever_arm_z_m_std"]
    history = read_table(out / "history.csv", columns)
    assert history["misalignment_z_deg_std"][-1] < history["misalignment_z_deg_std"][0]
    again = ("kalman", trial, "--out", out, "--method", "wahba", "--no-figures")
    assert run(*again) == 2
    assert run(*again, "--force") == 0
    assert not (out / "history.csv").exists()
    assert run("kalman", trial, "--out", tmp_path / "x", "--method", "ukf") == 2
    (trial / "gnss.csv").write_text("time_s,lat_deg,lon_deg,height_m\n1,,,\n2,,,\n")
    assert run("kalman", trial, "--out", tmp_path / "y") == 2
    assert "none of its rows contains a measurement" in " ".join(capsys.readouterr().err.split())
    # Without its lever arm the motion contradicts the answer, which is written all the same.
    (tmp_path / "no-arm").mkdir()
    unknown = write_trial(tmp_path / "no-arm", simulate(scenario(noise=True), 0))
    wahba = ("kalman", unknown, "--out", tmp_path / "z", "--method", "wahba", "--no-figures")
    assert run(*wahba) == 1
    assert "the model does not fit the data" in capsys.readouterr().err
    assert (tmp_path / "z" / "calibration.json").exists()


def test_a_window_that_is_left_out_is_said():
    claims = {"dvl": {"averaging_s": 0.5}}
    trial = simulate(scenario(manoeuvres=VARIED[:2], trial=claims, imu={"rate_hz": 50}))
    (found,) = of_code(kalman(trial, "wahba").findings, Code.ERROR_LEFT_OUT)
    assert "dvl.averaging_s" in found
