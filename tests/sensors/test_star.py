"""The star tracker: the sky, the record, the factor, the start, the bound, bad input."""

from __future__ import annotations

import os
from dataclasses import replace

import erfa
import numpy as np
import pytest
from builders import edit
from findings import of_code
from jacobians import check_jacobians, random_motion
from msgspec.structs import replace as replace_settings
from scipy.spatial.transform import Rotation
from truth import CONFIGS, config, exact_motion

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    nees_band,
    trajectory_errors,
)
from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.baselines.star_filter import run_filter, star_attitudes
from factorgraph_dvl.baselines.strapdown import compose, prepare
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.solution_folder import load_solution
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.geometry.celestial import (
    attitudes_from_vectors,
    earth_from_inertial,
    spread,
)
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import ARCSEC, DEG
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.star_catalogue import star_catalogue_findings
from factorgraph_dvl.sensors.star import Star, StarAttitude, StarSettings
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.state_times import dense_epochs

SEEDS = int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "50"))
EPOCH = "2018-12-01T05:30:00Z"
MOUNTING_DEG = [10.0, -25.0, 130.0]
SHORT = {"manoeuvres": [{"straight_s": 50}]}
# As printed by Liu, Yu and Xu (2020).
PRINTED = np.array(
    [[-0.14613, 0.47536, 0.44398], [-0.21920, 0.71304, 0.66598], [-0.42345, 0.27501, 0.70360]]
)
UNKNOWN = {"star": {"mounting_deg": [0, 0, 0], "mounting_std_deg": [180, 180, 180]}}


def bound(duration, rate=2.0, sigma=5.0):
    """Least standard deviation of a drift, deg/h, without noise of the gyros."""
    n = duration * rate
    return sigma * np.sqrt(12.0 / (n * (n**2 - 1.0))) * rate


def star_of(trial):
    (star,) = trial.others
    return star


def turn(a, b):
    """Angle between rotations, arcsec."""
    return np.linalg.norm(log_so3(np.swapaxes(a, -1, -2) @ b), axis=-1) / ARCSEC


# The sky


def test_earth_rotation_by_hand():
    # At J2000.0 in UT1 the Earth rotation angle is 0.7790572732640 turns, and precession has
    # only begun: what is left is nutation, 14 arcsec, and the bias of the frame.
    found = earth_from_inertial("2000-01-01T12:00:00Z", np.array([0.0]))[0]
    angle = 2.0 * np.pi * 0.7790572732640
    by_hand = np.array(
        [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    assert turn(found, by_hand) < 20.0
    assert turn(found.T, by_hand) > 3600.0


def test_years_beyond_the_known_leap_seconds_are_no_warning(recwarn):
    far = simulate(config("star", epoch="2099-12-01T05:30:00Z", **SHORT), 1)
    frame = far.frame()
    assert np.isfinite(star_attitudes(star_of(far), far.epoch, frame.lat, frame.lon).nRb).all()
    assert np.isfinite(earth_from_inertial(far.epoch, np.array([0.0]))).all()
    assert not recwarn.list


@pytest.mark.parametrize("epoch", [EPOCH, "2018-12-01T06:30:00+01:00", "2018-12-01T05:30:00"])
def test_earth_rotation_is_that_of_the_whole_transformation(epoch):
    time = np.array([-30.0, 0.0, 700.5, 86400.0])
    found = earth_from_inertial(epoch, time, ut1_utc=0.3)
    day, fraction = 2458453.5, (5.5 * 3600.0 + time) / 86400.0
    # TAI - UTC was 37 s.
    whole = erfa.c2t06a(
        day, fraction + (37.0 + 32.184) / 86400.0, day, fraction + 0.3 / 86400.0, 0, 0
    )
    assert turn(found, whole).max() < 1e-5


def test_ut1_turns_the_earth_by_15_arcsec_a_second():
    a, b = (earth_from_inertial(EPOCH, np.array([0.0]), ut1) for ut1 in (0.0, 0.5))
    assert turn(a, b) == pytest.approx(7.52, abs=0.01)


def test_nothing_jumps_at_a_leap_second():
    # The last one so far was at the end of 2016.
    time = np.array([0.0, 1.0, 2.0])
    found = earth_from_inertial("2016-12-31T23:59:59Z", time)
    assert np.ptp(turn(found[:-1], found[1:])) < 1e-6


def test_the_constant_earth_rate_fits_the_stars():
    a, b = earth_from_inertial(EPOCH, np.array([0.0, 600.0]))
    rate = log_so3(a @ b.T) / 600.0 - np.array([0.0, 0.0, 7.292115e-5])
    # The bound of the drift after 300 s is 2e-3 deg/h.
    assert np.linalg.norm(rate) / DEG * 3600.0 < 1e-6


# Attitudes from star vectors


def random_rotations(count, seed=0):
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(count, 4)))


def test_the_printed_vectors_give_the_attitude():
    # The first is 2/3 of the second, so that eq. 5 of the paper, with an inverse of U Uᵀ,
    # has none: its matrix is of rank 2.
    assert np.linalg.matrix_rank(PRINTED, tol=1e-4) == 2
    iRs = random_rotations(1)
    body = iRs.inv().apply(PRINTED)
    star = Star.from_vectors(StarSettings(), np.zeros(3), body, PRINTED, "stars.csv")
    found = Rotation.from_quat(star.quaternion[0, [1, 2, 3, 0]])
    # Five decimals leave the first two not quite parallel; exact vectors turn exactly.
    assert (found.inv() * iRs[0]).magnitude() < 1e-12


def test_parallel_vectors_are_refused():
    time = np.array([0.0, 0.0, 0.5, 0.5, 1.0])
    rows = [PRINTED[1], PRINTED[2], PRINTED[0], PRINTED[1], PRINTED[2]]
    with pytest.raises(DataError, match=r"stars.csv lines 4 to 5: all body vectors at 0.5 s"):
        Star.from_vectors(StarSettings(), time, np.array(rows), np.array(rows), "stars.csv")
    rows = PRINTED[[1, 2, 0, 2, 1]]
    with pytest.raises(DataError, match=r"stars.csv line 6: all body"):
        Star.from_vectors(StarSettings(), time[[0, 0, 2, 2, 4]], rows, rows, "stars.csv")
    opposite = np.array([PRINTED[0], -PRINTED[1]])
    assert spread(opposite / np.linalg.norm(opposite, axis=1)[:, None], np.array([0])) < 1e-4


def test_vectors_scatter_as_their_covariance_says():
    rng = np.random.default_rng(1)
    epochs, sigma = 3000, 5.0 * ARCSEC
    catalogue = np.tile(PRINTED / np.linalg.norm(PRINTED, axis=1)[:, None], (epochs, 1))
    true = random_rotations(epochs)
    body = true.inv()[np.repeat(np.arange(epochs), 3)].apply(catalogue)
    noise = rng.normal(0.0, sigma, body.shape)
    noise -= np.sum(noise * body, axis=1, keepdims=True) * body
    body = body + noise
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    found, unit = attitudes_from_vectors(body, catalogue, np.arange(0, 3 * epochs, 3))
    away = log_so3(found.transpose(0, 2, 1) @ true.as_matrix())
    nees = np.einsum("mi,mij,mj->m", away, np.linalg.inv(sigma**2 * unit), away)
    low, high = nees_band(3, epochs, 0.997)
    assert low < nees.mean() < high
    # About the stars, which lie 27 degrees apart, it is known worst.
    assert np.sqrt(np.linalg.eigvalsh(unit)[:, 2].mean()) > 1.5


def test_a_record_of_vectors_goes_through_files(tmp_path):
    trial = simulate(config("star", **SHORT, star={"stars": PRINTED.tolist()}), 0)
    save_trial(trial, tmp_path / "trial")
    loaded = load_trial(tmp_path / "trial")
    assert loaded.epoch.startswith("2018-12-01T05:30:00")
    a, b = star_of(trial), star_of(loaded)
    np.testing.assert_allclose(a.quaternion, b.quaternion, atol=1e-15)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-12)
    header = (tmp_path / "trial" / "star.csv").read_text().splitlines()[:4]
    assert header[0].startswith("time_s,star,body_x")
    assert [row.split(",")[:2] for row in header[1:]] == [["0.5", "1"], ["0.5", "2"], ["0.5", "3"]]


# The factor


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_zero_error_at_the_truth(body_axes):
    scene = config(
        "star",
        **SHORT,
        body_axes=body_axes,
        noise=False,
        star={"mounting_deg": MOUNTING_DEG, "ut1_utc_s": 0.4},
    )
    trial = simulate(scene)
    fix = trial.gnss.geodetic[0]
    frame = LocalFrame(fix[0] - 0.01, fix[1] + 0.01, 0.0, scene.epoch)
    (o,) = star_of(trial).observations(frame, "RFU")
    motion = exact_motion(plan_motion(scene), frame, o.time)
    values = {"star_mounting_deg": exp_so3(np.array(MOUNTING_DEG) * DEG)}
    assert np.abs(o.residual(motion, values)).max() < 1e-5
    turned = {"star_mounting_deg": values["star_mounting_deg"].T}
    assert np.linalg.norm(o.residual(motion, turned), axis=1).min() > 3600.0
    upside = replace(o, nRs=o.nRs.transpose(0, 2, 1))
    assert np.median(np.linalg.norm(upside.residual(motion, values), axis=1)) > 3600.0


def test_jacobians():
    rng = np.random.default_rng(4)
    motion, mounting = random_motion(), exp_so3(np.array(MOUNTING_DEG) * DEG)
    near = exp_so3(rng.normal(0.0, 0.4, (5, 3)))
    o = StarAttitude(
        np.arange(5.0),
        motion.nRb @ mounting.T @ near,
        random_rotations(5).as_matrix(),
        np.full((5, 3), 5.0),
    )
    check_jacobians(
        o, motion, {"star_mounting_deg": mounting}, Star.parameters(star_by_hand()), tolerance=1e-7
    )


def star_by_hand(**settings):
    time = np.array([0.0, 1.0])
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    columns = dict(zip(("qw", "qx", "qy", "qz"), quaternion.T, strict=True))
    columns |= {name: np.full(2, np.nan) for name in Star.optional[1]}
    return Star.from_columns(StarSettings(**settings), {"time_s": time, **columns}, "star.csv")


def test_residual_by_hand():
    # Body along n, tracker turned by +90 deg about z (its x is the body's y); measured 10
    # arcsec further about body z: predicted - measured is -10 about z, of both.
    motion = replace(random_motion(1), nRb=np.eye(3)[None])
    sRb = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for axis, expected in (((0, 0, 1), (0, 0, -10)), ((1, 0, 0), (0, 10, 0))):
        measured = exp_so3(10.0 * ARCSEC * np.array(axis)) @ sRb.T
        o = StarAttitude(np.zeros(1), measured[None], np.eye(3)[None], np.full((1, 3), 5.0))
        found = o.residual(motion, {"star_mounting_deg": sRb})
        np.testing.assert_allclose(found, [expected], atol=1e-6)


def test_whitened_residuals_hold_the_whole_covariance():
    trial = simulate(config("star", **SHORT, star={"stars": PRINTED.tolist()}), 0)
    star, frame = star_of(trial), trial.frame()
    (o,) = star.observations(frame, "RFU")
    motion = replace(
        random_motion(star.time.size), nRb=random_rotations(star.time.size).as_matrix()
    )
    values = {"star_mounting_deg": np.eye(3)}
    white = o.residual(motion, values) / o.sigma(motion, values)
    away = log_so3(star.attitudes(frame).nRs.transpose(0, 2, 1) @ motion.nRb)
    whole = np.einsum("mi,mij,mj->m", away, np.linalg.inv(star.covariance), away)
    np.testing.assert_allclose(np.sum(white**2, axis=1), whole, rtol=1e-6)


def test_sigma_may_differ_about_the_axes():
    star = star_by_hand(std_arcsec=(3.0, 4.0, 50.0))
    (o,) = star.observations(LocalFrame(0.4, 2.3, 0.0, EPOCH), "RFU")
    np.testing.assert_allclose(o.std, [[3.0, 4.0, 50.0]] * 2)


# Solving


@pytest.fixture(scope="module")
def floating():
    return simulate(config("star", **SHORT), 3)


def drift_errors(solution, trial):
    errors = calibration_errors(solution, trial.calibration_truth)
    rows = [errors.names.index(f"gyro_bias_{a}_deg_h") for a in "xyz"]
    return errors.error[rows], errors.covariance[np.ix_(rows, rows)]


def test_a_floating_vessel_reaches_the_bound_by_both_methods(floating):
    graph, (filtered, _) = solve(floating), calibrate(floating, "star")
    assert graph.converged
    for solution in (graph, filtered):
        error, P = drift_errors(solution, floating)
        np.testing.assert_allclose(np.sqrt(np.diag(P)), bound(50.0), rtol=0.01)
        assert error @ np.linalg.solve(P, error) < 16.3
        attitude = trajectory_errors(solution, floating.reference).attitude
        assert 0.2 < attitude.nees.mean() < 12.0
    # Two ways through the sky and two filters, no common equation.
    apart = drift_errors(graph, floating)[0] - drift_errors(filtered, floating)[0]
    assert np.abs(apart).max() < 0.1 * bound(50.0)


def test_a_wrong_clock_turns_the_attitude_and_not_the_drift():
    trial = simulate(config("star", **SHORT, noise=False, star={"ut1_utc_s": 0.5}))
    star = star_of(trial)
    wrong = replace(star, settings=replace_settings(star.settings, ut1_utc_s=0.0))
    for run in (solve, lambda t: calibrate(t, "star")[0]):
        solution = run(replace(trial, others=(wrong,)))
        assert np.abs(drift_errors(solution, trial)[0]).max() < 1e-4
        away = trajectory_errors(solution, trial.reference).attitude.error
        # 7.5 arcsec about the Earth's axis, sin(lat) of it about the vertical.
        assert abs(abs(away[:, 2].mean()) / ARCSEC - 7.52 * np.sin(25.0 * DEG)) < 0.3


def test_without_noise_the_drift_is_exact():
    trial = simulate(config("star", **SHORT, noise=False, star={"mounting_deg": MOUNTING_DEG}))
    for solution in (solve(trial), calibrate(trial, "star")[0]):
        assert np.abs(drift_errors(solution, trial)[0]).max() < 1e-4


@pytest.mark.parametrize("heading", [0, 100, 250])
def test_a_vessel_at_rest_starts_at_any_heading(heading):
    scene = config(
        "star",
        manoeuvres=[{"straight_s": 12}],
        sway={},
        start={"heading_deg": heading},
        gnss={"velocity_std_m_s": None},
    )
    trial = simulate(scene, 1)
    solution = solve(trial)
    assert solution.converged
    away = trajectory_errors(solution, trial.reference).attitude
    assert np.abs(away.error).max() < 30.0 * ARCSEC
    assert not of_code(solution.findings, Code.HEADING_UNKNOWN)


def test_an_unknown_mounting_is_found_from_the_sea():
    scene = config("star", **SHORT, star={"mounting_deg": MOUNTING_DEG}, trial=UNKNOWN)
    trial = simulate(scene, 1)
    solution = solve(trial)
    assert solution.converged
    found = solution.estimate("star_mounting_deg")
    assert found.observable.all()
    assert found.std.max() < 0.02
    assert np.abs((found.value - MOUNTING_DEG) / found.std).max() < 4.0
    np.testing.assert_allclose(solution.estimate("gyro_bias_deg_h").std, bound(50.0), rtol=0.05)


def test_a_mounting_that_nothing_tells_is_not_claimed():
    calm = config(
        "star", **SHORT, sway={}, star={"mounting_deg": [1, -2, 1.5]},
        trial={"star": {"mounting_deg": [0, 0, 0], "mounting_std_deg": [3, 3, 3]}},
    )  # fmt: skip
    trial = simulate(calm, 1)
    solution = solve(trial)
    found = solution.estimate("star_mounting_deg")
    # Gravity tells two components; heading and mounting about the vertical are one.
    assert not found.observable.all()
    assert any(
        "star_mounting" in w and "turns about two axes" in w
        for w in of_code(solution.findings, Code.NOT_OBSERVABLE)
    )
    assert np.abs((found.value - [1, -2, 1.5]) / found.std).max() < 4.0


def test_a_gap_of_the_imu_and_clouds():
    scene = config("star", **SHORT, imu={"gaps_s": [[20, 21]]}, star={"outages_s": [[30, 38]]})
    trial = simulate(scene, 2)
    graph, (filtered, _) = solve(trial), calibrate(trial, "star")
    for solution in (graph, filtered):
        error, P = drift_errors(solution, trial)
        assert error @ np.linalg.solve(P, error) < 16.3
    apart = drift_errors(graph, trial)[0] - drift_errors(filtered, trial)[0]
    assert np.abs(apart).max() < 0.2 * bound(50.0)


def test_rows_without_an_attitude_are_left_out(floating):
    star = star_of(floating)
    quaternion = star.quaternion.copy()
    quaternion[::2] = np.nan
    thinned = replace(floating, others=(replace(star, quaternion=quaternion),))
    kept = replace(
        star, time=star.time[1::2], quaternion=quaternion[1::2], covariance=star.covariance[1::2]
    )
    for run in (solve, lambda trial: calibrate(trial, "star")[0]):
        a = run(thinned).estimate("gyro_bias_deg_h")
        b = run(replace(floating, others=(kept,))).estimate("gyro_bias_deg_h")
        np.testing.assert_allclose(a.value, b.value, atol=1e-6)
        np.testing.assert_allclose(a.std, b.std, rtol=1e-6)


def test_stars_without_gnss():
    claims = {"initial": {"position_std_m": [20, 20, 20]}}
    trial = simulate(config("star", **SHORT, gnss=None, trial=claims), 1)
    solution = solve(trial)
    error, P = drift_errors(solution, trial)
    assert solution.converged
    assert error @ np.linalg.solve(P, error) < 16.3
    with pytest.raises(DataError, match="GNSS"):
        calibrate(trial, "star")


def test_a_walking_bias_is_followed():
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 0.5, "gyro_noise_deg_sqrt_h": 0.0005}
    trial = simulate(config("star", manoeuvres=[{"straight_s": 120}], imu=walk), 1)
    for solution in (solve(trial), calibrate(trial, "star")[0]):
        error, P = drift_errors(solution, trial)
        assert error @ np.linalg.solve(P, error) < 16.3


@pytest.mark.parametrize(
    ("noise", "rate"),
    [
        pytest.param(noise, rate, marks=() if rate == fast else pytest.mark.slow)
        for noise, fast in ((0.001, 3), (0.005, 10), (0.05, 2), (0.2, 3))
        for rate in (2, 3, 10)
    ],
)
def test_noise_of_the_gyros_between_states_counts(noise, rate):
    scene = config(
        "star", **SHORT, imu={"gyro_noise_deg_sqrt_h": noise}, star={"rate_hz": rate}
    )  # fmt: skip
    trial = simulate(scene, 1)
    graph, filtered = solve(trial), calibrate(trial, "star")[0]
    a, b = (s.estimate("gyro_bias_deg_h").std for s in (graph, filtered))
    np.testing.assert_allclose(a, b, rtol=0.02)
    # What T seconds of gyros leave of a drift, however good the stars; the prior is 5 deg/h.
    assert a.min() > 1.0 / np.sqrt(50.0 / 3600.0 / noise**2 + 1.0 / 5.0**2)
    time, rows, others = np.intersect1d(
        graph.trajectory.time, filtered.trajectory.time, return_indices=True
    )
    assert time.size > 400
    a, b = graph.trajectory.rph_std[rows], filtered.trajectory.rph_std[others]
    np.testing.assert_allclose(np.median(a, axis=0), np.median(b, axis=0), rtol=0.05)


def test_quiet_gyros_need_no_more_states(floating):
    frame = floating.frame()
    assert dense_epochs(floating, frame, 1.0) is None
    noisy = replace_settings(floating.imu.settings, gyro_noise_deg_sqrt_h=0.2)
    noisy = replace(floating, imu=replace(floating.imu, settings=noisy))
    time = star_of(floating).time
    np.testing.assert_array_equal(dense_epochs(noisy, frame, 1.0), time)
    fast = replace(star_of(floating), time=time / 50.0)
    assert np.diff(dense_epochs(replace(noisy, others=(fast,)), frame, 1.0)).min() > 0.049


@pytest.mark.slow
def test_stars_tell_more_of_the_misalignment():
    trial = simulate(config("seed-a-star", imu={"rate_hz": 50}), 0)
    without = solve(replace(trial, others=()))
    having = solve(trial)
    ratio = without.estimate("misalignment_deg").std / having.estimate("misalignment_deg").std
    assert ratio[2] > 1.4
    assert ratio.min() > 0.99


# The filter


def test_errors_grow_as_the_filter_says():
    trial = simulate(config("star", **SHORT, noise=False))
    samples = prepare(increments(trial.imu)[0], trial.imu.settings)
    frame = trial.frame()
    seen = star_attitudes(star_of(trial), trial.epoch, frame.lat, frame.lon)
    pick = replace(
        seen, time=seen.time[9:20:10], nRb=seen.nRb[9:20:10], covariance=seen.covariance[9:20:10]
    )
    F = run_filter(samples, pick, frame.lat, np.zeros(3), np.eye(3)).transition[1]
    step = compose(samples, pick.time[:1], pick.time[1:])
    spin, start = exp_so3(-5.0 * frame.earth_rate), pick.nRb[0]
    found = np.empty((3, 6))
    for i in range(6):
        x = np.zeros(6)
        x[i] = 1e-6
        sins = spin @ exp_so3(2.0 * x[:3]) @ start @ step.turn[0]
        # What drifts the SINS is a rate that the vessel does not have.
        true = spin @ start @ exp_so3(-step.bias_jacobian[0] @ x[3:]) @ step.turn[0]
        found[:, i] = 0.5 * log_so3(sins @ true.T) / 1e-6
    np.testing.assert_allclose(found, F[:3], atol=1e-3)
    # Eq. 16 as printed turns dq with the vessel besides, here by 1.3 degrees.
    swayed = spin @ start @ step.turn[0] @ start.T
    assert np.abs(found[:, :3] - swayed).max() > 0.02


def test_the_filter_says_what_it_does_not_estimate():
    trial = simulate(config("star", **SHORT, trial={"star": {"mounting_std_deg": [1, 1, 1]}}), 1)
    solution, history = calibrate(trial, "star")
    assert any(
        f.code == Code.METHOD_LIMITS and f.parameter == "star_mounting_deg"
        for f in solution.findings
    )
    assert history.names == tuple(f"gyro_bias_{a}_deg_h" for a in "xyz")
    assert history.time[[0, -1]].tolist() == [0.5, 50.0]
    assert np.all(np.diff(history.std[5:], axis=0) < 0.0)


# Files and commands


def run(capsys, *args):
    with pytest.raises(SystemExit) as stopped:
        main([str(a) for a in args])
    return stopped.value.code, capsys.readouterr()


@pytest.fixture
def folder(tmp_path, floating):
    save_trial(floating, tmp_path / "trial")
    return tmp_path / "trial"


def test_commands_end_to_end(tmp_path, capsys):
    scene = tmp_path / "scene.yaml"
    text = (CONFIGS / "star.yaml").read_text()
    scene.write_text(text.replace("straight_s: 300", "straight_s: 20"))
    trial, graph, filtered = (tmp_path / n for n in ("trial", "graph", "filtered"))
    assert run(capsys, "simulate", scene, "--out", trial)[0] == 0
    code, shown = run(capsys, "inspect", trial)
    assert code == 0
    assert "Star tracker: its turns agree with those of the gyros" in shown.out
    assert run(capsys, "solve", trial, "--out", graph, "--quiet")[0] == 0
    assert (graph / "figures" / "star_residuals.png").stat().st_size > 0
    quick = ("--quiet", "--no-figures")
    assert run(capsys, "kalman", trial, "--method", "star", "--out", filtered, *quick)[0] == 0
    assert "gyro_bias_x_deg_h" in read_table(filtered / "history.csv", ["gyro_bias_x_deg_h"])
    assert load_solution(filtered).solver == "kalman-star"
    told = tmp_path / "told"
    assert run(capsys, "observability", trial, "--out", told, *quick)[0] == 0
    (std,) = read_table(told / "history.csv", ["gyro_bias_z_deg_h_std"]).values()
    assert std[-1] == pytest.approx(bound(20.0), rel=0.01)
    both = ("crosscheck", graph, filtered, "--reference", trial, "--no-figures")
    code, shown = run(capsys, *both, "--out", tmp_path / "check")
    assert code == 0
    assert "3 agree" in shown.out


@pytest.mark.parametrize("command", [("solve",), ("kalman", "--method", "star")])
def test_no_epoch(folder, tmp_path, capsys, command):
    lines = (folder / "trial.yaml").read_text().splitlines()
    (folder / "trial.yaml").write_text("\n".join(x for x in lines if not x.startswith("epoch")))
    code, shown = run(capsys, *command, folder, "--out", tmp_path / "out", "--quiet")
    assert code == 2
    assert "trial.yaml has no `epoch`" in shown.err
    code, shown = run(capsys, *command, folder, "--out", tmp_path / "out", "--quiet", "--anyway")
    assert code == 2
    assert "key epoch" in shown.err
    assert not (tmp_path / "out").exists()
    assert any("epoch" in f.text for f in survey(load_trial(folder)).problems)


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("std_arcsec: 5.0", "std_arcsec: 0", "std_arcsec"),
        ("std_arcsec: 5.0", "std_arcsec: [5, 5]", "std_arcsec"),
        ("ut1_utc_s: 0.0", "ut1_utc_s: 2", "ut1_utc_s"),
        ("mounting_deg", "mount_deg", "mount_deg"),
        ("'2018-12-01T05:30:00+00:00'", "yesterday", "epoch"),
        ("'2018-12-01T05:30:00+00:00'", "1918-12-01T05:30:00Z", "key epoch"),
    ],
)
def test_settings_are_checked(folder, tmp_path, capsys, key, value, named):
    edit(folder / "trial.yaml", key, value)
    code, shown = run(capsys, "solve", folder, "--out", tmp_path / "out", "--quiet")
    assert code == 2
    assert named in shown.err


HEADER = "time_s,star,body_x,body_y,body_z,inertial_x,inertial_y,inertial_z\n"


@pytest.mark.parametrize(
    ("table", "where", "what"),
    [
        ("time_s,qw,qx,qy,qz\n1,1,0,0,0\n2,0.9,0,0,0\n", "line 3", "norm 0.9"),
        ("time_s,qw,qx,qy,qz\n1,1,0,0,0\n2,1,0,,0\n", "line 3", "all of them, or none"),
        ("time_s,qw,qx,qy,qz\n1,1,0,0,0\n1,1,0,0,0\n", "line 3", "strictly increasing"),
        ("time_s,qw,qx,qy\n1,1,0,0\n", "line 1", "not qz"),
        ("time_s,angle\n1,1\n", "star.csv", "neither quaternions nor star vectors"),
        (HEADER + "1,a,1,0,0,1,0,0\n1,b,0,1,0,0,1,0\n0,a,1,0,0,1,0,0\n", "line 4", "decreases"),
        (HEADER + "1,a,1,0,0,1,0,0\n1,b,0,0,0,0,1,0\n", "line 3", "is zero"),
        (HEADER + "1,a,1,0,0,1,0,0\n1,b,0,,0,0,1,0\n", "line 3", "body_y"),
        (HEADER + "1,a,1,0,0,1,0,0\n1,b,2,0,0,2,0,0\n", "lines 2 to 3", "parallel"),
        (HEADER + "1,a,1,0,0,1,0,0\n", "line 2", "parallel"),
    ],
)
def test_records_are_checked(folder, tmp_path, capsys, table, where, what):
    (folder / "star.csv").write_text(table)
    code, shown = run(capsys, "solve", folder, "--out", tmp_path / "out", "--quiet")
    assert code == 2
    assert where in shown.err
    assert what in shown.err
    assert not (tmp_path / "out").exists()


def test_three_sigmas_are_not_those_of_vectors():
    with pytest.raises(ConfigError, match="std_arcsec"):
        Star.from_vectors(
            StarSettings(std_arcsec=(5.0, 5.0, 40.0)), np.zeros(3), PRINTED, PRINTED, "star.csv"
        )


def test_a_simulated_tracker_needs_an_epoch():
    with pytest.raises(ConfigError, match="key epoch"):
        simulate(config("star", **SHORT, epoch=None), 0)


def test_a_trial_without_stars_has_no_such_method(capsys):
    trial = simulate(config("star", **SHORT, star=None), 0)
    with pytest.raises(DataError, match="no star tracker"):
        calibrate(trial, "star")


@pytest.mark.parametrize(
    ("quaternion", "cause"),
    [
        (lambda q: q * [1, -1, -1, -1], "inertial to body"),
        (lambda q: q[:, [1, 2, 3, 0]], "is the scalar last"),
    ],
)
def test_mixed_up_quaternions_are_noticed(floating, quaternion, cause):
    star = star_of(floating)
    assert not survey(floating).problems
    wrong = replace(floating, others=(replace(star, quaternion=quaternion(star.quaternion)),))
    assert any(cause in f.text for f in survey(wrong).problems)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("star", {}),
        pytest.param(
            *("star", {"star": {"rate_hz": 10, "std_arcsec": 60}}), marks=pytest.mark.slow
        ),
        ("star", {"star": {"rate_hz": 10, "std_arcsec": 60, "mounting_deg": MOUNTING_DEG}}),
        # Attitudes between the samples of the gyros.
        ("star", {"imu": {"rate_hz": 53}, "star": {"rate_hz": 3}}),
        pytest.param("seed-a-star", {}, marks=pytest.mark.slow),
        ("seed-a-star", {"star": {"rate_hz": 10, "std_arcsec": 60}}),
        ("seed-a-star", {"imu": {"sampling": "instantaneous"}, "star": {"rate_hz": 1}}),
        ("seed-a-star", {"imu": {"gyro_noise_deg_sqrt_h": 0.2}}),
    ],
)
def test_good_attitudes_are_not_suspected(name, changes):
    trial = simulate(config(name, **(SHORT if name == "star" else {}), **changes), 0)
    found = survey(trial)
    assert not found.problems
    (convention,) = (f for f in found.findings if f.code == Code.STAR_CONVENTION)
    assert convention.severity == "ok"
    star = star_of(trial)
    inverse = replace(star, quaternion=star.quaternion * [1, -1, -1, -1])
    problems = survey(replace(trial, others=(inverse,))).problems
    assert any("inertial to body" in f.text for f in problems)


def test_mixed_up_stars_are_noticed():
    trial = simulate(config("star", **SHORT, star={"stars": PRINTED.tolist()}), 0)
    assert not survey(trial).problems
    star = star_of(trial)
    v = star.vectors
    swapped = v.inertial.copy()
    swapped[2::3] = [1.0, 0.0, 0.0]
    wrong = Star.from_vectors(star.settings, v.time, v.body, swapped, "star.csv")
    problems = survey(replace(trial, others=(wrong,))).problems
    assert any("catalogue" in f.text for f in problems)


def test_a_wrong_epoch_is_noticed(floating):
    late = replace(floating, epoch="2018-12-01T06:30:00Z")
    assert any("`epoch`" in f.text for f in survey(late).problems)
    assert of_code(calibrate(late, "star")[0].findings, Code.STAR_VERTICAL)
    assert not of_code(calibrate(floating, "star")[0].findings, Code.STAR_VERTICAL)


def test_an_unknown_mounting_is_not_for_the_filter(tmp_path, capsys):
    trial = simulate(config("star", **SHORT, trial=UNKNOWN), 1)
    save_trial(trial, tmp_path / "trial")
    command = ("kalman", "--method", "star", tmp_path / "trial", "--out", tmp_path / "out")
    code, shown = run(capsys, *command, "--quiet")
    assert code == 2
    assert "star.mounting_std_deg" in shown.err
    assert not (tmp_path / "out").exists()


def test_what_the_filter_does_not_know_of_the_mounting_is_in_its_sigma():
    prior = {"star": {"mounting_deg": [0, 0, 0], "mounting_std_deg": [1, 1, 1]}}
    errors = []
    for off in np.eye(3):
        star = {"mounting_deg": off.tolist()}
        trial = simulate(config("star", **SHORT, noise=False, star=star, trial=prior))
        solution = calibrate(trial, "star")[0]
        errors.append(drift_errors(solution, trial)[0])
        attitude = trajectory_errors(solution, trial.reference).attitude
        np.testing.assert_allclose(np.sqrt(attitude.nees), 1.0, atol=0.1)
    # Off by one sigma about each axis: the squares of the errors add up to the variance.
    scatter = np.sqrt(np.sum(np.square(errors), axis=0))
    assert scatter.min() > 0.2
    np.testing.assert_allclose(solution.estimate("gyro_bias_deg_h").std, scatter, rtol=0.3)


@pytest.mark.parametrize(
    "star",
    [
        {"std_arcsec": [3, 6, 40], "mounting_deg": MOUNTING_DEG, "ut1_utc_s": 0.4},
        {"stars": PRINTED.tolist(), "mounting_deg": MOUNTING_DEG},
    ],
    ids=["unequal", "vectors"],
)
def test_filter_and_graph_agree_on_attitude_and_sigma(star):
    trial = simulate(config("star", **SHORT, star=star), 5)
    graph, filtered = solve(trial), calibrate(trial, "star")[0]
    (a, P), (b, Q) = (drift_errors(s, trial) for s in (graph, filtered))
    np.testing.assert_allclose(np.sqrt(np.diag(P)), np.sqrt(np.diag(Q)), rtol=0.02)
    assert np.abs((a - b) / np.sqrt(np.diag(P))).max() < 0.2
    _, i, j = np.intersect1d(graph.trajectory.time, filtered.trajectory.time, return_indices=True)
    sigma = graph.trajectory.rph_std[i]
    np.testing.assert_allclose(sigma, filtered.trajectory.rph_std[j], rtol=0.05)
    away = (graph.trajectory.rph[i] - filtered.trajectory.rph[j]) / sigma
    assert np.abs(away).max() < 0.3


# A star as far off as aberration takes it, and one that is another.
@pytest.mark.parametrize(("off_arcsec", "severity"), [(20.0, "warning"), (3600.0, "error")])
def test_a_star_that_does_not_fit_its_catalogue_is_named(off_arcsec, severity):
    bright = [[1, 0, 0], [0.6, 0.8, 0], [0.6, 0, 0.8], [0.8, -0.36, 0.48], [0.8, 0.36, -0.48]]
    trial = simulate(config("star", **SHORT, star={"stars": bright}), 0)
    star = star_of(trial)
    assert star.misfit == pytest.approx(1.0, abs=0.1)
    assert star_catalogue_findings([star]) == ()
    v = star.vectors
    moved = v.inertial.copy()
    moved[2::5] = Rotation.from_rotvec([0, off_arcsec * ARCSEC, 0]).apply(moved[2::5])
    wrong = Star.from_vectors(star.settings, v.time, v.body, moved, "star.csv")
    trial = replace(trial, others=(wrong,))
    expected = "do not use the attitudes" if severity == "error" else "too small"
    for solution in (solve(trial), calibrate(trial, "star")[0]):
        (said,) = of_code(solution.findings, Code.STAR_CATALOGUE)
        assert "star.csv line 4" in said
        assert expected in said
    (problem,) = survey(trial).problems
    assert problem.severity == severity
    assert "star.csv line 4" in problem.text


def test_a_few_stars_may_scatter_more():
    rng = np.random.default_rng(0)
    catalogue = PRINTED[1:] / np.linalg.norm(PRINTED[1:], axis=1)[:, None]
    body = catalogue + rng.normal(0.0, 2.0 * 5.0 * ARCSEC, catalogue.shape)
    # Twice as much, but of one degree of freedom.
    star = Star.from_vectors(StarSettings(), np.zeros(2), body, catalogue, "star.csv")
    assert star_catalogue_findings([star]) == ()


# Monte Carlo


def drift_nees(runs):
    return np.mean([error @ np.linalg.solve(P, error) for error, P in runs])


@pytest.mark.slow
@pytest.mark.parametrize("duration", [50, 100, 300])
def test_drifts_scatter_as_stated_and_reach_the_bound(duration):
    scene = config("star", manoeuvres=[{"straight_s": duration}])
    graph, filtered = [], []
    for seed in range(SEEDS):
        trial = simulate(scene, seed)
        graph.append(drift_errors(solve(trial), trial))
        filtered.append(drift_errors(calibrate(trial, "star")[0], trial))
    low, high = nees_band(3, SEEDS, 0.997)
    few, many = np.sqrt(nees_band(1, 3 * SEEDS, 0.997))
    for runs in (graph, filtered):
        assert low < drift_nees(runs) < high
        scatter = np.sqrt(np.mean([error**2 for error, _ in runs])) / bound(duration)
        assert few < scatter < many
        std = np.array([np.sqrt(np.diag(P)) for _, P in runs])
        assert np.all(np.abs(std / bound(duration) - 1.0) < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"star": {"stars": PRINTED.tolist()}},
        {"star": {"mounting_deg": MOUNTING_DEG}, "trial": UNKNOWN},
        {"star": {"std_arcsec": [4, 6, 40]}, "imu": {"gyro_noise_deg_sqrt_h": 0.001}},
    ],
    ids=["vectors", "unknown mounting", "noisy gyros"],
)
def test_what_is_estimated_beside_the_drift_scatters_as_stated(changes):
    scene = config("star", manoeuvres=[{"straight_s": 60}], **changes)
    drift, mounting = [], []
    for seed in range(SEEDS):
        trial = simulate(scene, seed)
        solution = solve(trial)
        drift.append(drift_errors(solution, trial))
        errors = calibration_errors(solution, trial.calibration_truth)
        rows = [i for i, name in enumerate(errors.names) if name.startswith("star_mounting")]
        if rows:
            mounting.append((errors.error[rows], errors.covariance[np.ix_(rows, rows)]))
    low, high = nees_band(3, SEEDS, 0.997)
    for runs in filter(None, (drift, mounting)):
        assert low < drift_nees(runs) < high


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "rate"), [(0.05, 2), (0.2, 10)])
def test_with_noisy_gyros_drift_and_attitude_scatter_as_stated(noise, rate):
    scene = config(
        "star",
        manoeuvres=[{"straight_s": 60}],
        imu={"gyro_noise_deg_sqrt_h": noise},
        star={"rate_hz": rate},
    )
    drift, attitude = [], []
    for seed in range(SEEDS):
        trial = simulate(scene, seed)
        solution = solve(trial)
        drift.append(drift_errors(solution, trial))
        # Independent: one attitude of each run.
        attitude.append(trajectory_errors(solution, trial.reference).attitude.nees[300])
    low, high = nees_band(3, SEEDS, 0.997)
    assert low < drift_nees(drift) < high
    assert low < np.mean(attitude) < high
