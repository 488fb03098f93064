"""Clocks of the sensors: offsets and rates are found, and removed from the motion."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from truth import merged, scenario

from factorgraph_dvl import solve
from factorgraph_dvl.graph.clocks import true_time
from factorgraph_dvl.sensors.clock import Clock, LateClock
from factorgraph_dvl.sensors.dvl import DvlVelocity
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.simulation import simulate

# A minute with turns; two free clocks, and GNSS that is good enough to show its own.
FREE = {
    "gnss": {"time_offset_std_s": 0.5, "clock_rate_std_ppm": 1000},
    "dvl": {"time_offset_std_s": 0.5, "clock_rate_std_ppm": 1000},
}
GNSS = {"position_std_m": [0.02, 0.02, 0.04], "velocity_std_m_s": [0.02, 0.02, 0.02]}


def stamped(record, offset, rate, middle):
    """Return a record whose clock is late and fast."""
    return replace(record, time=record.time + offset + rate * (record.time - middle))


def test_a_lag_by_hand():
    values = {"gnss_time_offset_s": np.array([0.5]), "gnss_clock_rate_ppm": np.array([2e-4])}
    clock = Clock.of("gnss", prefix="gnss_")
    # 0.5 s in the middle, at 100 s, and 200 ppm of 50 s more at the end.
    np.testing.assert_allclose(clock.lag(np.array([100.0, 150.0]), values, 100.0), [0.5, 0.51])
    o = DvlVelocity(np.array([150.0]), np.zeros((1, 3)), np.full((1, 3), 0.01))
    dvl = {"time_offset_s": np.array([0.5]), "dvl_clock_rate_ppm": np.array([2e-4])}
    np.testing.assert_allclose(true_time(o, dvl, 100.0), [149.49])


def test_a_velocity_is_late_beside_its_position_by_hand():
    offset, rate, sawtooth, period, delay = Gnss.specs[1:6]
    known = ((offset, 0.5), (rate, 2e-4), (delay, -0.2))
    values = {spec.name: np.array([x]) for spec, x in known}
    # 0.2 s early beside the lag of 0.51 s that positions have.
    clock = LateClock(offset, rate, sawtooth, period, delay)
    np.testing.assert_allclose(clock.lag(np.array([150.0]), values, 100.0), [0.31])
    of_positions = Clock(offset, rate, sawtooth, period)
    np.testing.assert_allclose(of_positions.lag(np.array([150.0]), values, 100.0), [0.51])


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True])
def test_a_late_velocity_is_estimated(stated):
    """Differences of positions over a second are half a second late."""
    claims = {"velocity_delay_s": 0.4, "velocity_delay_std_s": 0.2} if stated else {}
    gnss = {**GNSS, "velocity_delay_s": 0.5}
    trial = simulate(scenario(noise=True, gnss=gnss, trial=merged(FREE, {"gnss": claims})), 3)
    solution = solve(trial, rate_hz=1.0)
    found = solution.estimate("gnss_velocity_delay_s")
    assert abs(found.value[0] - 0.5) < 4.0 * found.std[0] < 0.1
    for name in ("gnss_time_offset_s", "misalignment_deg", "scale_error", "lever_arm_m"):
        e = solution.estimate(name)
        assert np.all(np.abs(e.value - trial.calibration_truth[name]) < 4.0 * e.std), name
    assert solution.verdict.grade == "good"


@pytest.mark.slow
@pytest.mark.parametrize("std", [0.0, 0.5])
def test_velocities_that_are_means_show_the_antenna_where_it_is(std):
    """Differences of positions over two seconds: as instantaneous ones, 25 sigma off in height."""
    sea = {
        "roll": [{"amplitude_deg": 6, "frequency_hz": 0.15}],
        "pitch": [{"amplitude_deg": 3, "frequency_hz": 0.2, "phase_deg": 60}],
        "heave": [{"amplitude_m": 0.3, "frequency_hz": 0.17}],
    }
    means = {"velocity_averaging_s": 2.0, "velocity_delay_s": 1.0}
    antenna = {"velocity_std_m_s": [0.02] * 3, "lever_arm_m": [0.5, -2.0, 6.0], "rate_hz": 1}
    claims = {"gnss": {**means, "velocity_averaging_std_s": std, "lever_arm_std_m": [0.1] * 3}}
    trial = simulate(scenario(noise=True, sway=sea, gnss=means | antenna, trial=claims), 3)
    solution = solve(trial, rate_hz=1.0)
    for name in ("gnss_lever_arm_m", "misalignment_deg", "scale_error", "lever_arm_m"):
        e = solution.estimate(name)
        assert np.all(np.abs(e.value - trial.calibration_truth[name]) < 4.0 * e.std), name
    if std:
        found = solution.estimate("gnss_velocity_averaging_s")
        assert abs(found.value[0] - 2.0) < 4.0 * found.std[0] < 0.3
    assert solution.verdict.grade == "good"


@pytest.mark.slow
def test_offsets_and_rates_of_two_clocks_are_found():
    trial = simulate(scenario(noise=True, gnss=GNSS, trial=FREE), 3)
    middle = 0.5 * (trial.imu.time[0] + trial.imu.time[-1])
    late = replace(
        trial,
        gnss=stamped(trial.gnss, 0.08, 300e-6, middle),
        dvl=stamped(trial.dvl, -0.04, -200e-6, middle),
    )
    solution = solve(late)
    assert solution.converged
    expected = {
        "gnss_time_offset_s": 0.08,
        "gnss_clock_rate_ppm": 300.0,
        "time_offset_s": -0.04,
        "dvl_clock_rate_ppm": -200.0,
    }
    for name, value in expected.items():
        found = solution.estimate(name)
        assert found.observable[0] or name == "gnss_clock_rate_ppm", name
        assert abs(found.value[0] - value) < 4.0 * found.std[0], name
    # As good as with right clocks.
    for name in ("misalignment_deg", "scale_error", "lever_arm_m"):
        error = solution.estimate(name).value - trial.calibration_truth[name]
        assert np.all(np.abs(error) < 4.5 * solution.estimate(name).std), name


@pytest.mark.slow
def test_a_stated_offset_of_gnss_is_taken_away():
    scene = scenario(gnss=GNSS, trial={"gnss": {"time_offset_std_s": 0}})
    trial = simulate(scene)
    settings = msgspec.structs.replace(trial.gnss.settings, time_offset_s=17.0)
    shifted = replace(
        trial, gnss=replace(trial.gnss, settings=settings, time=trial.gnss.time + 17.0)
    )
    a, b = solve(trial), solve(shifted)
    np.testing.assert_allclose(
        b.estimate("lever_arm_m").value, a.estimate("lever_arm_m").value, atol=1e-6
    )
    assert b.converged


def test_a_free_clock_leaves_no_measurement_out():
    fixed, free = (
        solve(simulate(scenario(trial={"dvl": {"time_offset_std_s": s}}))) for s in (0.0, 0.5)
    )
    counts = [{r.label: r.time.size for r in solution.residuals} for solution in (fixed, free)]
    assert counts[0] == counts[1]


@pytest.mark.parametrize("offset", [0.3, -0.3])
def test_a_late_gnss_is_found_from_far_away(offset):
    trial = simulate(
        scenario(noise=True, gnss=GNSS, trial={"gnss": {"time_offset_std_s": 0.5}}), 1
    )
    late = replace(trial, gnss=replace(trial.gnss, time=trial.gnss.time + offset))
    found = solve(late).estimate("gnss_time_offset_s")
    assert found.std[0] < 0.05
    assert abs(found.value[0] - offset) < 4.0 * found.std[0]


def test_vibration_of_the_imu_leaves_the_clock_of_gnss_one_minimum():
    """A propeller turns the IMU to and fro; what GNSS measures far from it is a mean over that."""
    antenna = {
        "velocity_std_m_s": [0.003, 0.003, 0.003],
        "lever_arm_m": [0.0, 2.0, 0.0],
        "lever_arm_error_m": [0.1, -0.1, 0.0],
    }
    stated = {"gnss": {"time_offset_std_s": 5.0, "lever_arm_std_m": [1.0, 1.0, 1.0]}}
    trial = simulate(scenario(noise=True, gnss=GNSS | antenna, trial=stated), 1)
    turning = np.radians(0.3) * np.cos(2.0 * np.pi * 24.0 * trial.imu.time)
    shaken = replace(trial.imu, gyro=trial.imu.gyro + turning[:, None])
    late = replace(trial, imu=shaken, gnss=replace(trial.gnss, time=trial.gnss.time + 0.4))
    found = solve(late).estimate("gnss_time_offset_s")
    assert found.std[0] < 0.01
    assert abs(found.value[0] - 0.4) < 3.0 * found.std[0]
