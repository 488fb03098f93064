"""Dead reckoning: exact with the truth, wrong by the right amount without, and its figures."""

from __future__ import annotations

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from running import run  # noqa: F401
from scipy.integrate import quad
from truth import CONFIGS, CONING, config, scenario, with_ins

from factorgraph_dvl.analysis.dead_reckoning.before_after import before_after
from factorgraph_dvl.analysis.dead_reckoning.integration import (
    DeadReckonedTrack,
    dead_reckon,
    displaced,
    integrated,
    lever_arm_error,
    mounting_of,
)
from factorgraph_dvl.analysis.dead_reckoning.track_error import score
from factorgraph_dvl.baselines import sins
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.geometry.earth import ECCENTRICITY_SQUARED, RATE, SEMI_MAJOR, LocalFrame
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.imu.attitude_record import orientations
from factorgraph_dvl.simulation import load_scenario, plan_motion, simulate
from factorgraph_dvl.simulation.compass import InsTruth
from factorgraph_dvl.trial import Reference

HALF_TURN = [
    {"straight_s": 20},
    {"turn_deg_s": 6, "duration_s": 30, "ramp_s": 4},
    {"straight_s": 20},
]


def attitude_of(trial, motion=None):
    return AttitudeHistory(trial.imu, motion or trial.reference, trial.body_axes, np.zeros(3))


def reckoned(scn, **values):
    trial = simulate(scn, 0)
    return before_after(trial, trial.calibration_truth | values, attitude_of(trial).at)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_with_the_true_calibration_the_track_is_exact(body_axes):
    scn = scenario(
        body_axes=body_axes,
        current_m_s=[0.3, -0.2, 0.0],
        gnss={"lever_arm_m": [0.3, -1.5, 4.0]},
        dvl={"bias_m_s": [0.01, -0.02, 0.03], "time_offset_s": 0.08, "scale_error": 0.05},
        trial={"dvl": {"bias_std_m_s": [1, 1, 1], "time_offset_std_s": 1}},
    )
    result = reckoned(scn)
    # Trapezoids under swell of 0.27 Hz at 5 Hz leave millimetres.
    assert np.abs(result.calibrated.score.error).max() < 0.01
    assert result.calibrated.track.time[0] == pytest.approx(0.2)
    for wrong in (
        {"time_offset_s": np.array([0.0])},
        {"dvl_bias_m_s": np.zeros(3)},
        {"misalignment_deg": -np.array([2.0, 2.0, 30.0])},
        {"lever_arm_m": np.array([-1.0, -1.2, -1.4])},
    ):
        assert reckoned(scn, **wrong).calibrated.score.horizontal.max() > 0.05, wrong


def test_errors_by_hand():
    # Straight, upright, without waves: 60 s at 4 m/s, misread by 2 % and by 1 deg to port.
    scn = scenario(
        manoeuvres=[{"straight_s": 60}],
        sway={},
        dvl={"misalignment_deg": [0, 0, 1], "scale_error": 0.02, "lever_arm_m": [0, 0, 0]},
    )
    result = reckoned(scn)
    s = result.uncalibrated.score
    distance = 4.0 * (s.time[-1] - s.time[0])
    assert s.path.total == pytest.approx(distance, rel=1e-6)
    # Turned to starboard, the DVL sees the vessel go to port.
    assert s.across[-1] == pytest.approx(-1.02 * np.sin(1 * DEG) * distance, rel=1e-4)
    assert s.along[-1] == pytest.approx((1.02 * np.cos(1 * DEG) - 1.0) * distance, rel=1e-3)
    end = float(s.horizontal[-1])
    assert s.percent(end) == pytest.approx(100.0 * end / distance, rel=1e-6)


def test_a_neglected_lever_arm_makes_the_position_jump_by_its_closed_form():
    arm = [-0.93, 1.12, -0.34]
    result = reckoned(scenario(manoeuvres=HALF_TURN, dvl={"lever_arm_m": arm}))
    effect = result.lever_arm
    assert effect.disagreement < 0.01
    # Half a turn takes the arm to the other side: twice its horizontal length.
    jump = np.linalg.norm(effect.measured[-1, :2] - effect.measured[0, :2])
    assert jump == pytest.approx(2.0 * np.hypot(*arm[:2]), abs=0.1)
    assert result.without_lever_arm.score.horizontal.max() > 2.5
    assert result.calibrated.score.horizontal.max() < 0.01


def test_lever_arm_error_by_hand():
    about = rotation_from_rph(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]]), "FRD")
    # Ahead of the IMU: first to the north, then to the east.
    np.testing.assert_allclose(
        lever_arm_error(about, np.array([2.0, 0.0, 0.0]))[1], [2.0, -2.0, 0.0], atol=1e-12
    )


def test_the_error_of_the_first_fix_is_not_in_the_score():
    trial = simulate(scenario(), 0)
    geodetic = trial.gnss.geodetic.copy()
    geodetic[:5] = displaced(geodetic[:5], np.full((5, 3), [8.0, -5.0, 3.0]))
    off = replace(trial, gnss=replace(trial.gnss, geodetic=geodetic))
    result = before_after(off, trial.calibration_truth, attitude_of(trial).at)
    assert np.abs(result.calibrated.score.error).max() < 0.01
    # What is compared starts at one point.
    for run_of in (result.uncalibrated, result.without_lever_arm):
        np.testing.assert_array_equal(
            run_of.track.geodetic[0], result.calibrated.track.geodetic[0]
        )


def test_gaps_of_the_lock_are_bridged_and_counted():
    scn = scenario(
        manoeuvres=HALF_TURN, sway={}, dvl={"no_lock_s": [[30, 40]], "lever_arm_m": [0, 0, 0]}
    )
    result = reckoned(scn)
    assert result.calibrated.track.bridged == pytest.approx(10.2, abs=0.21)
    # Interpolated in body, where the velocity is steady while the vessel turns by 60 deg.
    assert result.calibrated.score.horizontal.max() < 0.02


def test_integration_follows_the_ellipsoid():
    time = np.arange(0.0, 4000.1, 0.5)
    start = np.array([60.0 * DEG, 10.0 * DEG, -50.0])
    north = np.tile([0.0, 5.0, 0.0], (time.size, 1))
    lat, lon, height = integrated(time, north, start)[-1]

    def meridian(x):
        return (
            SEMI_MAJOR
            * (1 - ECCENTRICITY_SQUARED)
            / (1 - ECCENTRICITY_SQUARED * np.sin(x) ** 2) ** 1.5
            - 50.0
        )

    assert quad(meridian, start[0], lat)[0] == pytest.approx(20e3, abs=1e-5)
    assert (lon, height) == (start[1], -50.0)
    east = integrated(time, north[:, [1, 0, 2]], start)[-1]
    radius = SEMI_MAJOR / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(start[0]) ** 2) - 50.0
    assert (east[1] - start[1]) * radius * np.cos(start[0]) == pytest.approx(20e3, abs=1e-6)


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
def test_gyros_carry_the_attitude_between_epochs(sampling):
    scn = scenario(sway=CONING, imu={"sampling": sampling}, reference_rate_hz=2)
    trial = simulate(scn, 0)
    time = np.arange(10.03, 60.0, 0.17)
    found = attitude_of(trial).at(time)
    exact = plan_motion(scn).at(time)
    nRb = rotation_from_rph(exact.rph, "RFU")
    assert found.covered.all()
    assert np.abs(log_so3(nRb.transpose(0, 2, 1) @ found.nRb)).max() < 1e-5
    assert np.abs(found.omega_eb_b - exact.omega_eb_b).max() < 2e-3
    # Without the turn of the Earth the rate would be off by it everywhere.
    assert np.abs(np.mean(found.omega_eb_b - exact.omega_eb_b, axis=0)).max() < 0.1 * RATE


def test_attitude_is_known_only_where_source_and_imu_are():
    trial = simulate(scenario(imu={"gaps_s": [[30, 32]]}), 0)
    reference = trial.reference
    first = reference.time < 50
    cut = Reference(
        *(getattr(reference, n)[first] for n in ("time", "geodetic", "velocity", "rph"))
    )
    covered = attitude_of(trial, cut).at(np.array([-1.0, 10.0, 31.0, 45.0, 55.0])).covered
    assert covered.tolist() == [False, True, False, True, False]


def test_sins_keeps_its_attitude_when_gnss_ends():
    circuit = config("cruise").manoeuvres[2]["manoeuvres"]
    scn = config("cruise", start={"speed_m_s": 4}, manoeuvres=circuit[:6])
    trial = simulate(scn, 0)
    motion, bias, _ = sins(trial, align_s=200.0)
    assert isinstance(motion, Trajectory)
    found = AttitudeHistory(trial.imu, motion, "RFU", bias).at(trial.dvl.time)
    exact = plan_motion(scn).at(trial.dvl.time)
    error = log_so3(rotation_from_rph(exact.rph, "RFU").transpose(0, 2, 1) @ found.nRb) / DEG
    assert found.covered.mean() > 0.99
    assert np.abs(error[found.covered]).max() < 0.1


def straight_track(time, speed_e, speed_n, start=(36 * DEG, 121 * DEG, 0.0)):
    velocity = np.stack([speed_e, speed_n, np.zeros_like(speed_e)], axis=1)
    geodetic = integrated(time, velocity, np.array(start))
    return DeadReckonedTrack(time, geodetic, velocity, np.zeros((time.size, 3)), 0.0)


def test_reciprocal_legs_cancel_at_the_end_but_not_over_straight_stretches():
    time = np.arange(0.0, 4401.0, 1.0)
    ahead = np.where(time < 2200, 5.0, -5.0)
    zero = np.zeros_like(time)
    truth = straight_track(time, ahead, zero)
    track = straight_track(time, 1.01 * ahead, -0.002 * ahead)
    s = score(track, truth.motion, along=truth)
    assert s.percent(float(s.horizontal[-1])) < 0.02
    assert s.percent(float(s.horizontal.max())) == pytest.approx(0.51, abs=0.01)
    for stretches, count in zip(s.stretches, (20, 4, 2), strict=True):
        assert stretches.count == count
        assert stretches.median == pytest.approx(100.0 * np.hypot(0.01, 0.002), rel=0.01)
        assert stretches.along == pytest.approx(1.0, rel=0.01)
        assert stretches.across == pytest.approx(0.2, rel=0.01)


def test_a_short_trial_has_no_stretches():
    s = reckoned(scenario(manoeuvres=HALF_TURN)).calibrated.score
    assert [x.count for x in s.stretches] == [0, 0, 0]
    assert np.isnan(s.stretches[0].median)


def test_gnss_scores_without_its_lever_arm():
    scn = scenario(gnss={"lever_arm_m": [3.0, -2.0, 8.0]})
    trial = simulate(scn, 0)
    attitude = attitude_of(trial)
    bare = replace(trial, reference=None)
    result = before_after(bare, trial.calibration_truth, attitude.at)
    assert result.scored_by == "GNSS"
    assert np.abs(result.calibrated.score.error).max() < 0.01


def test_trials_that_cannot_be_dead_reckoned_are_refused():
    trial = simulate(scenario(), 0)
    attitude = attitude_of(trial)
    with pytest.raises(DataError, match="no DVL"):
        mounting_of(replace(trial, dvl=None))
    lost = replace(trial.dvl, velocity=np.full_like(trial.dvl.velocity, np.nan))
    with pytest.raises(DataError, match="fewer than two pings"):
        dead_reckon(replace(trial, dvl=lost), mounting_of(trial), attitude.at)
    with pytest.raises(DataError, match="no position to start from"):
        dead_reckon(replace(trial, gnss=None), mounting_of(trial), attitude.at)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("deadreckon")
    trial = simulate(scenario(noise=True, gnss={"lever_arm_m": [0.3, -1.5, 4.0]}), 0)
    save_trial(trial, path / "trial")
    return path


def test_command_writes_its_folder(run, folder):  # noqa: F811
    trial = folder / "trial"
    result = run("deadreckon", trial, trial / "truth.json", "--out", folder / "out")
    assert result.code == 0, result.err
    assert "end point" in result.out
    names = sorted(p.name for p in (folder / "out").iterdir())
    assert names == [
        "deadreckon.json", "errors.png", "lever_arm.png", "track-uncalibrated.csv", "track.csv",
        "tracks.png",
    ]  # fmt: skip
    data = json.loads((folder / "out" / "deadreckon.json").read_text())
    for key in (
        "distance_m", "end_point_error_m", "end_point_percent", "global_error_m", "global_percent",
        "rms_along_m", "rms_across_m", "straight",
    ):  # fmt: skip
        assert key in data
        assert key in data["uncalibrated"]
    assert data["end_point_error_m"] <= data["global_error_m"]
    assert data["global_percent"] < 0.1 * data["uncalibrated"]["global_percent"]
    assert data["straight"][0]["median_percent"] is None
    header = (folder / "out" / "track.csv").read_text().splitlines()[0]
    assert header.startswith("time_s,lat_deg,lon_deg,height_m,vel_e_m_s")


def test_the_tracks_have_a_compass_and_marks_of_time(folder):
    from factorgraph_dvl.files.trial_folder import load_trial
    from factorgraph_dvl.report.figures.dead_reckoning import tracks_figure

    trial = load_trial(folder / "trial")
    attitude = attitude_of(trial)
    found = before_after(trial, trial.calibration_truth, attitude.at)
    (ax,) = tracks_figure(trial, found).axes
    assert ax.get_title("right") == "N ↑"
    assert {"20 s", "40 s"} <= {text.get_text() for text in ax.texts}


def test_command_takes_the_attitude_of_a_solution_or_the_reference(run, folder, tmp_path):  # noqa: F811
    from builders import build_solution

    from factorgraph_dvl.files.trial_folder import load_trial

    trial = load_trial(folder / "trial")
    r = trial.reference
    square = np.tile(np.eye(3), (r.time.size, 1, 1))
    motion = Trajectory(r.time, r.geodetic, r.velocity, r.rph, square, square, square)
    save_solution(build_solution(trajectory=motion, body_axes="RFU"), tmp_path / "solution")
    found = {}
    for source in ("reference", str(tmp_path / "solution")):
        out = tmp_path / ("out-" + source.rpartition("/")[2])
        result = run(
            "deadreckon", folder / "trial", folder / "trial" / "truth.json",
            "--out", out, "--attitude", source, "--no-figures",
        )  # fmt: skip
        assert result.code == 0, result.err
        found[source] = json.loads((out / "deadreckon.json").read_text())["end_point_error_m"]
        assert ("is from trial" in result.err) == (source != "reference")
    assert np.ptp(list(found.values())) < 1e-6


def test_a_score_that_ends_before_the_track_says_so(run, folder, tmp_path):  # noqa: F811
    from factorgraph_dvl.files.trial_folder import load_trial

    trial = load_trial(folder / "trial")
    early = trial.reference.time <= 20.0
    r = trial.reference
    short = Reference(r.time[early], r.geodetic[early], r.velocity[early], r.rph[early])
    save_trial(replace(trial, reference=short), tmp_path / "trial")
    result = run(
        "deadreckon", tmp_path / "trial", folder / "trial" / "truth.json",
        "--out", tmp_path / "out", "--no-figures",
    )  # fmt: skip
    assert result.code == 0, result.err
    assert "reference ends at 20.0 s" in result.err
    data = json.loads((tmp_path / "out" / "deadreckon.json").read_text())
    assert data["scored_until_s"] == pytest.approx(20.0, abs=0.11)


BAD = {
    "no such folder": (
        ("TRIAL/truth.json", "--attitude", "nowhere"),
        "there is no folder nowhere",
    ),
    "align with reference": (
        ("TRIAL/truth.json", "--attitude", "reference", "--align", "60"),
        "--align",
    ),
    "no file": (("nowhere.json",), "nowhere.json"),
    "no calibration": (("TRIAL/trial.yaml",), "trial.yaml"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_usage_leaves_nothing(run, folder, tmp_path, case):  # noqa: F811
    options, message = BAD[case]
    trial = folder / "trial"
    given = [o.replace("TRIAL", str(trial)) for o in options]
    result = run("deadreckon", trial, *given, "--out", tmp_path / "out")
    assert result.code == 2
    assert message in result.err
    assert not (tmp_path / "out").exists()


def test_frames_of_the_track_are_local(folder):
    # The heading of a track is that of the attitude, its height that of the fix.
    trial = simulate(scenario(sway={}), 0)
    track = dead_reckon(trial, mounting_of(trial, trial.calibration_truth), attitude_of(trial).at)
    frame = LocalFrame(*track.geodetic[0])
    assert np.abs(frame.position(*track.geodetic.T)[:, 2]).max() < 0.02


def test_without_gnss_the_reference_gives_the_attitude_and_initial_the_start(run, tmp_path):  # noqa: F811
    initial = {"attitude_std_deg": [1, 1, 1], "position_std_m": [5, 5, 5]}
    trial = simulate(scenario(gnss=None, trial={"initial": initial}), 0)
    save_trial(trial, tmp_path / "trial")
    result = run(
        "deadreckon", tmp_path / "trial", tmp_path / "trial" / "truth.json",
        "--out", tmp_path / "out", "--no-figures",
    )  # fmt: skip
    assert result.code == 0, result.err
    data = json.loads((tmp_path / "out" / "deadreckon.json").read_text())
    assert data["attitude"] == "reference"
    assert data["global_error_m"] < 0.05


def test_an_ins_gives_start_and_score():
    made = msgspec.structs.replace(
        load_scenario(CONFIGS / "ship.yaml"), manoeuvres=[{"straight_s": 60}], noise=False
    )
    trial = replace(simulate(with_ins(made, InsTruth(rate_hz=1))), reference=None)
    truth = trial.calibration_truth
    result = before_after(trial, truth, orientations(trial.attitude, trial.body_axes))
    assert result.scored_by == "INS"
    assert np.abs(result.calibrated.score.error).max() < 0.1
