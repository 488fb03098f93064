"""Trials at the edges: held components, records that hardly overlap, gaps within outages."""

from dataclasses import replace

import numpy as np
import pytest
from exactness import INITIAL, assert_exact
from problems import SHORT, prior_cost, problem_of
from truth import CONING, scenario

from factorgraph_dvl.analysis.dead_reckoning.integration import dead_reckon, mounting_of
from factorgraph_dvl.analysis.information.manoeuvres import find_segments
from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.ins_attitude import sins
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import replay
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve


def cut_imu(trial, before):
    imu = trial.imu
    keep = imu.time < before
    return replace(
        trial, imu=replace(imu, time=imu.time[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    )


def test_held_components_of_a_rotation_keep_the_others_free():
    claims = {"dvl": {"misalignment_deg": [10, 20, 30], "misalignment_std_deg": [0, 0, 20]}}
    problem, _ = problem_of(scenario(manoeuvres=SHORT, trial=claims))
    mean = np.array([10.0, 20.0, 30.0])
    free = exp_so3((mean + np.array([0, 0, 1e-3])) * DEG)
    assert prior_cost(problem, "misalignment_deg", free) < 1e-6
    held = exp_so3((mean + np.array([1e-3, 0, 0])) * DEG)
    assert prior_cost(problem, "misalignment_deg", held) > 1e3


def test_held_components_of_the_misalignment_are_held():
    claims = {"misalignment_deg": [2, 2, 29], "misalignment_std_deg": [0, 0, 20]}
    solution = solve(simulate(scenario(trial={"dvl": claims})))
    found = solution.estimate("misalignment_deg")
    assert solution.converged
    np.testing.assert_allclose(found.value, [2, 2, 30], atol=1e-3)
    assert 1e-3 < found.std[2] < 0.1


@pytest.mark.parametrize("offset", [-0.45, 0.45])
def test_pings_beyond_the_imu_with_an_unknown_time_offset(offset):
    scene = scenario(
        sway=CONING,
        dvl={"time_offset_s": offset},
        trial={"dvl": {"time_offset_std_s": 0.3}},
    )
    trial = cut_imu(simulate(scene), 60.0)
    solution = solve(trial)
    assert_exact(trial, solution)


def test_time_offset_converges_at_the_end_of_the_record():
    scene = scenario(
        noise=True,
        sway=CONING,
        dvl={"time_offset_s": -0.45},
        trial={"dvl": {"time_offset_std_s": 0.3}},
    )
    assert solve(simulate(scene, 3)).converged


def test_initial_attitude_is_that_at_the_first_sample():
    tight = {"attitude_std_deg": [0.05] * 3, "position_std_m": [0.001] * 3}
    trial = simulate(scenario(sway=CONING, trial={"initial": tight}))
    assert solve(trial).cost < 1.0
    # 50 at present: node 0 lies one interval earlier, and the body rolls at 50 deg/s.


def test_dvl_entirely_outside_the_imu():
    trial = simulate(scenario())
    late = replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + 1000.0))
    solution = solve(late, anyway=True)
    assert not solution.estimate("scale_error").observable.any()


def test_gnss_entirely_outside_the_imu():
    trial = simulate(scenario())
    late = replace(trial, gnss=replace(trial.gnss, time=trial.gnss.time + 1000.0))
    with pytest.raises(DataError, match="no position while the IMU runs"):
        solve(late, anyway=True)


def test_a_single_locked_ping():
    trial = simulate(scenario())
    velocity = trial.dvl.velocity.copy()
    velocity[1:] = np.nan
    solution = solve(replace(trial, dvl=replace(trial.dvl, velocity=velocity)))
    assert not solution.estimate("lever_arm_m").observable.any()


def test_gnss_velocity_without_positions():
    trial = simulate(scenario(trial=INITIAL))
    nowhere = np.full_like(trial.gnss.geodetic, np.nan)
    solution = solve(replace(trial, gnss=replace(trial.gnss, geodetic=nowhere)))
    assert_exact(trial, solution, trajectory=0.2)


def test_an_imu_gap_within_a_gnss_outage():
    scene = scenario(imu={"gaps_s": [[30.0, 33.0]]}, gnss={"outages_s": [[20.0, 78.0]]})
    trial = simulate(scene)
    # What is assumed of the motion across the gap is not what it was, within its sigma.
    assert_exact(trial, solve(trial), trajectory=0.4)
    # Not converged after 92 iterations at present, cost 167, calibration 16 sigma off.


def with_jump(trial, sections):
    """Stamp the IMU's first 10 s by a clock that starts at 0, the rest by one 1.3e9 s ahead.

    Sensors in `sections` go with the IMU; others have the second clock throughout.
    """

    def moved(record):
        first = record.time <= 10.0
        keep = record.section == "imu" or record.section in sections
        return replace(record, time=np.where(first & keep, record.time, record.time + 1.3e9))

    return replace(
        trial, imu=moved(trial.imu), gnss=moved(trial.gnss), dvl=moved(trial.dvl), reference=None
    )


@pytest.fixture(scope="module")
def noisy():
    return simulate(scenario(noise=True), 1)


@pytest.fixture(scope="module")
def undisturbed(noisy):
    return solve(noisy)


@pytest.mark.parametrize(
    ("method", "sections"),
    [
        *(
            (method, sections)
            for method in ("solve", "kalman")
            for sections in ((), ("gnss", "dvl"))
        ),
        *(
            pytest.param("replay", sections, marks=pytest.mark.slow)
            for sections in ((), ("gnss", "dvl"))
        ),
    ],
)
def test_the_clock_of_a_logger_may_jump(noisy, undisturbed, sections, method):
    trial = with_jump(noisy, sections)
    run = {"solve": solve, "kalman": kalman, "replay": lambda t: replay(t, rate_hz=1.0)[0]}[method]
    solution = run(trial)
    assert solution.converged
    jumps = (Code.CLOCK_JUMP, Code.CLOCK_RESTARTED)
    # A replay that has not started yet cannot tell a jump from a long silence.
    (said,) = (
        f.text
        for f in solution.findings
        if f.code in jumps or (f.code == Code.UNUSED and "jumped" in f.text)
    )
    assert "10.0" in said or "1300000010" in said
    assert solution.trajectory.time.size < 1000
    found, expected = (s.estimate("misalignment_deg") for s in (solution, undisturbed))
    std = np.maximum(found.std, expected.std)
    assert np.all(np.abs(found.value - [2, 2, 30]) < 6.0 * std)
    assert np.all(found.std < 2.0 * expected.std)
    assert len(find_segments(solution.trajectory)) < 50


def test_dead_reckoning_bridges_no_jump_of_a_clock(noisy):
    trial = with_jump(noisy, ("gnss", "dvl"))
    motion, bias, _ = sins(trial)
    attitude = AttitudeHistory(trial.imu, motion, trial.body_axes, bias)
    with pytest.raises(DataError, match=r"no ping from 9.* to 1300000010"):
        dead_reckon(trial, mounting_of(trial), attitude.at)
