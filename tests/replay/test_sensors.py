"""Whatever sensor a trial has, the replay takes it through the protocol and ends as the batch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from findings import of_code
from scipy.spatial.transform import Rotation
from stated_noise import stated
from truth import CORRELATED, config
from windows import with_no_window

from factorgraph_dvl.analysis.error_statistics import motion_errors
from factorgraph_dvl.graph.processes import walk_sigma, walk_time
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.star_catalogue import star_catalogue_findings
from factorgraph_dvl.replay import Replay, replay
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve, solved_problems

TURNS = [
    {"accelerate_m_s2": 1, "to_m_s": 4},
    {"straight_s": 15},
    {"turn_deg_s": -6, "duration_s": 15, "ramp_s": 4},
    {"turn_deg_s": 8, "duration_s": 15, "ramp_s": 4},
]
SINKS = [
    {"accelerate_m_s2": 0.4, "to_m_s": 2},
    {"straight_s": 10},
    {"turn_deg_s": -6, "duration_s": 30, "ramp_s": 5},
    {"climb_m_s": -0.5, "to_height_m": 0},
    {"straight_s": 10},
]
NOISY = {
    "imu": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "gyro_bias_deg_h": "draw",
        "gyro_bias_std_deg_h": 5,
    },
    "trial": {"imu": {"gyro_bias_std_deg_h": 5}},
}
MOUNTED = {
    "star": {"mounting_deg": [3, 2, 5]},
    "trial": {"star": {"mounting_deg": [0, 0, 0], "mounting_std_deg": [10, 10, 10]}},
}


def as_the_batch(trial, rate=1.0):
    """Replay a trial, and hold its end against the batch solver and its way against the truth."""
    # What a replay finds of the noise is of its first minute only, and it considers no window.
    trial = with_no_window(replace(trial, noise="stated"))
    solution, _ = replay(trial, rate_hz=rate)
    batch = solve(trial)
    assert solution.order == batch.order
    a, b = (np.concatenate([e.value for e in s.estimates]) for s in (solution, batch))
    std = np.sqrt(np.diag(batch.covariance))
    free = std > 0.0
    assert np.abs((a - b)[free] / std[free]).max() < 0.3
    ours = np.sqrt(np.diag(solution.covariance))
    np.testing.assert_allclose(ours[free], std[free], rtol=0.05)
    assert solution.converged
    motion = motion_errors(solution.trajectory, trial.reference)
    for v in (motion.position, motion.velocity, motion.attitude):
        assert np.abs(v.normalised).max() < 6.0
    return solution


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(MOUNTED, id="mounting"),
        pytest.param(NOISY, id="noisy gyros", marks=pytest.mark.slow),
    ],
)
def test_a_star_tracker(changes):
    trial = simulate(config("seed-a-star", manoeuvres=TURNS, reference_rate_hz=100, **changes), 1)
    solution = as_the_batch(trial)
    assert {"Star attitude"} <= {r.label for r in solution.residuals}


def test_a_vessel_that_floats_under_the_stars():
    scene = config("star", manoeuvres=[{"straight_s": 70}], reference_rate_hz=50)
    as_the_batch(simulate(scene, 1))


@pytest.mark.slow
def test_a_depth_sensor_beyond_gnss():
    changes = {"outages_s": [[45, 400]]}
    trial = simulate(config("dive", manoeuvres=SINKS, reference_rate_hz=100, gnss=changes), 1)
    solution = as_the_batch(trial)
    assert solution.estimate("sea_surface_height_m").observable.all()


def test_single_beams():
    trial = simulate(config("cruise-beams", manoeuvres=TURNS, reference_rate_hz=100), 1)
    as_the_batch(trial)


def test_a_dvl_that_averages():
    """Its pings are compared as means over windows, which reach over states."""
    swell = [{"amplitude_deg": 4, "frequency_hz": 0.3, "phase_deg": 0}]
    scene = config(
        "seed-a-phase-90",
        manoeuvres=TURNS,
        sway={"roll": swell, "pitch": swell},
        dvl={"averaging_s": 0.5},
        trial={"dvl": {"averaging_s": 0.5}},
    )
    trial = simulate(scene, 1)
    as_the_batch(trial)
    innovations = []
    replay(trial, rate_hz=5.0, watch=lambda u: innovations.extend(u.innovations))
    ratio = np.concatenate(
        [(i.residual / i.sigma).ravel() for i in innovations if i.label == "DVL velocity"]
    )
    assert 0.9 < np.sqrt(np.nanmean(ratio**2)) < 1.1


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "window"), [(0.5, 1.0), (1.0, 0.0), (-0.3, 0.0)])
def test_gnss_velocities_that_are_late_beside_positions(delay, window):
    """A second of positions makes each of them: states before the newest one, and two at once."""
    swell = [{"amplitude_deg": 4, "frequency_hz": 0.3, "phase_deg": 0}]
    velocity = {"velocity_delay_s": delay, "velocity_averaging_s": window}
    scene = config(
        "seed-a-phase-90",
        manoeuvres=TURNS,
        sway={"roll": swell, "pitch": swell},
        gnss=velocity,
        trial={"gnss": velocity},
    )
    trial = simulate(scene, 1)
    as_the_batch(trial)
    innovations = []
    replay(trial, rate_hz=5.0, watch=lambda u: innovations.extend(u.innovations))
    found = {label: 0 for label in ("GNSS position", "GNSS velocity")}
    for i in innovations:
        if i.label in found:
            found[i.label] += int(np.isfinite(i.residual).all(axis=1).sum())
    # Those of the first seconds are late where states begin.
    assert found["GNSS position"] > 100
    assert found["GNSS velocity"] > 0.9 * found["GNSS position"]


def test_star_vectors_one_epoch_at_a_time():
    trial = simulate(config("seed-a-star", manoeuvres=TURNS), 1)
    (star,) = trial.others
    rng = np.random.default_rng(0)
    body = rng.normal(size=(star.time.size, 2, 3))
    iRs = Rotation.from_quat(np.roll(star.quaternion, -1, axis=1))
    inertial = np.stack([iRs.apply(body[:, i]) for i in range(2)], axis=1)
    time = np.repeat(star.time, 2)
    seen = Star.from_vectors(
        star.settings, time, body.reshape(-1, 3), inertial.reshape(-1, 3), "star"
    )
    assert star_catalogue_findings([rows_of(seen, [3, 4])]) == ()
    early = trial.imu.time < 34.0
    trial = replace(trial, imu=rows_of(trial.imu, early), others=(seen,))
    solution, _ = replay(trial, rate_hz=1.0)
    assert {"Star attitude"} <= {r.label for r in solution.residuals}


@pytest.mark.slow
def test_a_bias_that_walks_is_reported_as_it_is_at_the_end():
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 20.0}
    scene = config(
        "seed-a-phase-90",
        manoeuvres=TURNS,
        imu={**walk, "gyro_noise_deg_sqrt_h": 0.002},
        trial={"imu": walk},
    )
    trial = simulate(scene, 1)
    solution, _ = replay(trial, rate_hz=1.0)
    found = solved_problems(trial, state_interval_s=1.0)[0]
    last = np.degrees(found.minimum.evaluation.states.gyro_bias[-1]) * 3600.0
    e = solution.estimate("gyro_bias_deg_h")
    assert np.all(np.abs(e.value - last) < 0.3 * e.std)
    # What is known of the mean is not what is known of the end.
    assert np.all(e.std > 1.2 * solve(trial).estimate("gyro_bias_deg_h").std)
    assert of_code(solution.findings, Code.MEAN_OR_LAST)


def test_sensors_that_were_never_announced_are_refused_by_name():
    trial = simulate(config("seed-a-star", manoeuvres=TURNS), 1)
    session = Replay(replace(trial, others=()))
    with pytest.raises(Exception, match="star"):
        session.add(rows_of(trial.others[0], [0]))


@pytest.mark.slow
def test_a_beacon_bounds_a_dive_and_its_echoes_are_left_out():
    scene = config(
        "dive-one-beacon",
        manoeuvres=[*TURNS, {"straight_s": 20}, *TURNS[2:]],
        gnss={"outages_s": [[50, 1e4]]},
        beacons={"rate_hz": 0.5, "missed": 0.2, "multipath": 0.15, "outages_s": [[0, 45]]},
        reference_rate_hz=50,
    )
    trial = simulate(scene, 2)
    session = Replay(trial, rate_hz=1.0)
    for aid in trial.aids:
        session.add(aid)
    updates = session.add_imu(trial.imu.time, trial.imu.gyro, trial.imu.accel) + session.finish()
    said = [str(f) for u in updates for f in u.findings if f.sensor.startswith("Beacon")]
    # Neither a missed ping nor an echo is worth a word; the count at the end is.
    assert not said
    assert any(f.sensor == "Beacon B1 range" for f in session.counts())
    batch = solve(trial)
    end = updates[-1].state
    apart = trial.frame().position(*end.geodetic.T) - trial.frame().position(
        *batch.trajectory.geodetic[-1:].T
    )
    assert end.time[0] - batch.trajectory.time[-1] < 0.1
    assert np.abs(apart / end.position_std).max() < 0.5


@pytest.mark.parametrize("rows", ["none", pytest.param("empty", marks=pytest.mark.slow)])
def test_a_sensor_that_is_first_heard_after_the_start(rows):
    scene = config("seed-a-phase-90", manoeuvres=[*TURNS, *TURNS[1:]], reference_rate_hz=50)
    trial = simulate(scene, 5)
    dvl, heard = trial.dvl, trial.dvl.time > 40.0
    if rows == "none":
        dvl = rows_of(dvl, heard)
    else:
        dvl = replace(dvl, velocity=np.where(heard[:, None], dvl.velocity, np.nan))
    as_the_batch(replace(trial, dvl=dvl))


@pytest.mark.slow
def test_no_start_while_a_mirror_image_fits_the_ranges():
    scene = config(
        "dive-one-beacon",
        start={"lat_deg": 24.995, "lon_deg": 134.997},
        manoeuvres=[{"straight_s": 75}],
        imu={
            "gyro_bias_std_deg_h": 0.01,
            "gyro_noise_deg_sqrt_h": 0.001,
            "gyro_bias_walk_deg_h_sqrt_h": 0,
            "accel_bias_std_ug": 50,
            "accel_noise_ug_sqrt_hz": 10,
        },
        beacons={"rate_hz": 0.5, "missed": 0, "multipath": 0, "outages_s": []},
    )
    trial = replace(simulate(scene, 2), gnss=None)
    session = Replay(trial, rate_hz=1.0)
    for aid in trial.aids:
        session.add(aid)
    assert not session.add_imu(trial.imu.time, trial.imu.gyro, trial.imu.accel)
    assert not session.started
    # Both tracks are one at first, of a position that is hardly known.
    waits = of_code(session.findings, Code.NOT_STARTED)
    assert any("the position is known to" in text for text in waits)
    assert any("2 trajectories fit the ranges" in text for text in waits)


def test_a_beacon_out_of_reach_is_no_hindrance():
    scene = config("dive-one-beacon", manoeuvres=TURNS, beacons={"outages_s": []})
    trial = simulate(scene, 2)
    late = replace(trial.beacons, time=trial.beacons.time + 1e4)
    others = tuple(late if aid is trial.beacons else aid for aid in trial.others)
    assert solve(replace(trial, others=others), anyway=True).converged


def test_a_scale_that_walks_is_reported_as_it_is_at_the_end():
    """A batch solution has the scale at its nodes, of which the last is that of the end."""
    walks = {"dvl": {"scale_walk_sqrt_h": 0.02}, "trial": {"dvl": {"scale_walk_std_sqrt_h": 0.02}}}
    scene = config("seed-a-phase-90", manoeuvres=TURNS, reference_rate_hz=100, **walks)
    trial = simulate(scene, 1)
    solution, _ = replay(trial, rate_hz=2.0)
    assert any(f.code == Code.MEAN_OR_LAST and f.sensor == "DVL" for f in solution.findings)
    solved, *_ = solved_problems(replace(trial, noise="stated"))
    (process,) = solved.problem.processes
    values = solved.minimum.evaluation.parameters
    unit = walk_sigma(process.walk, walk_time(process.time))
    end = values["scale_error"] + unit * values[process.name][-1, -1]
    scale = solution.estimate("scale_error")
    assert abs(scale.value - end)[0] < 0.3 * scale.std[0]
    mean = solve(replace(trial, noise="stated")).estimate("scale_error")
    assert scale.std[0] > 1.2 * mean.std[0]


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_noise_that_is_stated_wrong_is_estimated(factor):
    """Both solvers find how large the noise is, from which the replay goes on."""
    trial = with_no_window(simulate(config("seed-a-phase-90", manoeuvres=TURNS), 1))
    solution, _ = replay(stated(trial, factor, factor), rate_hz=2.0)
    right = solve(trial)
    for noise in solution.noise:
        assert noise.factor == pytest.approx(1.0 / factor, rel=0.15)
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        a, b = solution.estimate(name), right.estimate(name)
        assert np.abs((a.value - b.value) / b.std).max() < 0.5
        np.testing.assert_allclose(a.std, b.std, rtol=0.15)
    assert solution.converged
    assert solution.verdict.grade == "doubtful"


def test_correlated_noise_as_the_trial_states_it():
    """Position and velocity of GNSS, and velocity of the DVL, each with a process of its own."""
    scene = config("seed-a-phase-90", manoeuvres=TURNS, reference_rate_hz=100, **CORRELATED)
    as_the_batch(simulate(scene, 1), rate=2.0)
