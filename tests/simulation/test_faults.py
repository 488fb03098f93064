"""Faults of instruments: what each changes, and what it leaves as it was."""

from __future__ import annotations

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.simulation import faults, simulate

QUIET = {"noise": False, "manoeuvres": [{"straight_s": 300}]}


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(**QUIET))


def one(trial, fault, seed=0):
    return faults.with_faults(trial, [fault], seed)


def moved_m(a, b):
    """Distance of fixes, (M,), m, by the size of the Earth."""
    d = (a - b) * np.array([6.371e6, 6.371e6 * np.cos(b[0, 0]), 1.0])
    return np.linalg.norm(d, axis=1)


def test_one_more_fault_leaves_the_others_as_they_were(trial):
    alone = one(trial, faults.correlated_dvl(0.01))
    both = faults.with_faults(trial, [faults.correlated_dvl(0.01), faults.gnss_jumps()])
    np.testing.assert_array_equal(alone.dvl.velocity, both.dvl.velocity)
    assert not np.array_equal(alone.gnss.geodetic, both.gnss.geodetic)


def test_a_gauss_markov_process_has_unit_variance_and_its_correlation_time():
    time = np.arange(200_000) * 0.5
    x = faults.gauss_markov(time, 5.0, 1, np.random.default_rng(0))[:, 0]
    assert x.std() == pytest.approx(1.0, abs=0.02)
    assert np.mean(x[10:] * x[:-10]) == pytest.approx(np.exp(-1.0), abs=0.02)


def test_a_gauss_markov_process_knows_irregular_times():
    pair = np.array([0.0, 3.0])
    rng = np.random.default_rng(1)
    x = np.stack([faults.gauss_markov(pair, 3.0, 1, rng)[:, 0] for _ in range(20_000)])
    assert np.corrcoef(x.T)[0, 1] == pytest.approx(np.exp(-1.0), abs=0.02)
    assert x.std(axis=0) == pytest.approx([1.0, 1.0], abs=0.02)


def test_late_stamps_move_the_true_offset(trial):
    before = trial.calibration_truth["time_offset_s"]
    dvl = one(trial, faults.late("dvl", 0.1))
    assert dvl.calibration_truth["time_offset_s"] == pytest.approx(before + 0.1)
    assert dvl.dvl.time - trial.dvl.time == pytest.approx(0.1)
    imu = one(trial, faults.late("imu", 0.1))
    assert imu.calibration_truth["time_offset_s"] == pytest.approx(before - 0.1)
    assert imu.imu.time - trial.imu.time == pytest.approx(0.1)


def test_a_clock_runs_fast_about_the_middle(trial):
    fast = one(trial, faults.clock_rate("gnss", 1000.0)).gnss.time - trial.gnss.time
    assert np.ptp(fast) == pytest.approx(1e-3 * np.ptp(trial.gnss.time))
    assert abs(fast.mean()) < 1e-3


def test_jitter_keeps_the_order(trial):
    time = one(trial, faults.jitter("dvl", 0.5)).dvl.time
    assert np.all(np.diff(time) > 0.0)
    assert np.std(time - trial.dvl.time) > 0.1


def test_jumps_move_fixes_by_their_size_for_their_time(trial):
    out = one(trial, faults.gnss_jumps(10.0, 30.0, 3))
    moved = moved_m(out.gnss.geodetic, trial.gnss.geodetic)
    far = moved > 1.0
    assert moved[far] == pytest.approx(10.0, rel=0.01)
    rate = 1.0 / np.median(np.diff(trial.gnss.time))
    assert far.sum() == pytest.approx(90.0 * rate, abs=3)


@pytest.mark.parametrize("fault", [faults.gnss_outliers, faults.dvl_outliers])
def test_outliers_are_as_many_and_as_large_as_asked(trial, fault):
    out = one(trial, fault(0.2, (10.0, 20.0)))
    if fault is faults.dvl_outliers:
        miss = np.linalg.norm(out.dvl.velocity - trial.dvl.velocity, axis=1)
        speed = np.linalg.norm(trial.dvl.velocity, axis=1)
        stated = trial.dvl.settings
        std = np.hypot(stated.velocity_std_m_s, stated.velocity_std_fraction * speed)
    else:
        miss = moved_m(out.gnss.geodetic, trial.gnss.geodetic)
        std = np.array(trial.gnss.settings.position_std_m)
    bad = miss > 1e-6
    assert bad.mean() == pytest.approx(0.2, abs=0.05)
    assert np.all(miss[bad] > 9.0 * np.min(std))
    assert np.all(miss[bad] < 21.0 * np.max(std))


def test_the_truth_of_the_bias_moves_and_that_of_the_antenna_does_not(trial):
    bias = one(trial, faults.dvl_bias([0.001, 0.0, -0.002]))
    assert bias.dvl.velocity - trial.dvl.velocity == pytest.approx(
        np.broadcast_to([0.001, 0.0, -0.002], trial.dvl.velocity.shape)
    )
    antenna = one(trial, faults.wrong_antenna([0.3, 0.0, 0.0]))
    assert np.array(antenna.gnss.settings.lever_arm_m) == pytest.approx(
        np.add(trial.gnss.settings.lever_arm_m, [0.3, 0.0, 0.0])
    )
    assert antenna.calibration_truth.keys() == trial.calibration_truth.keys()


def test_a_scale_that_drifts_is_right_on_average(trial):
    ratio = (one(trial, faults.dvl_scale_drift(0.001)).dvl.velocity / trial.dvl.velocity)[:, 1]
    assert ratio[0] == pytest.approx(0.9995, abs=1e-6)
    assert ratio[-1] == pytest.approx(1.0005, abs=1e-6)


def test_a_false_lock_adds_one_velocity_for_a_while(trial):
    added = one(trial, faults.dvl_false_lock(0.3, 60.0)).dvl.velocity - trial.dvl.velocity
    size = np.linalg.norm(added, axis=1)
    rate = 1.0 / np.median(np.diff(trial.dvl.time))
    assert (size > 0.0).sum() == pytest.approx(60.0 * rate, abs=2)
    assert size[size > 0.0] == pytest.approx(0.3)


def test_frozen_values_repeat_and_fills_replace(trial):
    noisy = simulate(scenario(manoeuvres=[{"straight_s": 100}]), seed=1)
    same = np.all(
        np.diff(one(noisy, faults.frozen("dvl", 20.0)).dvl.velocity, axis=0) == 0.0, axis=1
    )
    rate = 1.0 / np.median(np.diff(noisy.dvl.time))
    assert same.sum() == pytest.approx(20.0 * rate, abs=2)
    zeros = np.all(one(noisy, faults.filled("dvl", 0.1)).dvl.velocity == 0.0, axis=1)
    assert zeros.mean() == pytest.approx(0.1, abs=0.06)


def test_axes_are_mirrored_as_asked(trial):
    mirrored = one(trial, faults.axes_changed("imu", np.diag([1, -1, 1])))
    assert np.array_equal(mirrored.imu.gyro[:, 1], -trial.imu.gyro[:, 1])
    assert np.array_equal(mirrored.imu.accel[:, 0], trial.imu.accel[:, 0])
    dvl = one(trial, faults.axes_changed("dvl", -np.eye(3)))
    assert np.array_equal(dvl.dvl.velocity, -trial.dvl.velocity)


def test_errors_of_the_imu_by_hand(trial):
    scale = np.diag([1e-3, 0.0, 0.0])
    cross = np.zeros((3, 3))
    cross[2, 1] = 1e-4
    out = one(trial, faults.imu_errors(scale, cross, np.zeros((3, 3))))
    gyro, accel = trial.imu.gyro, trial.imu.accel
    assert out.imu.gyro[:, 0] == pytest.approx(1.001 * gyro[:, 0])
    assert out.imu.gyro[:, 2] == pytest.approx(gyro[:, 2] + 1e-4 * accel[:, 1])
    assert np.array_equal(out.imu.accel, accel)
    assert np.max(np.abs(one(trial, faults.saturated(accel_m_s2=9.0)).imu.accel)) == 9.0


def test_gnss_wanders_by_the_stated_amounts():
    trial = simulate(scenario(noise=False, manoeuvres=[{"straight_s": 1000}]))
    out = one(trial, faults.correlated_gnss((2.0, 0.0, 0.0), (0.0, 0.3, 0.0), 10.0, 2.0))
    moved = moved_m(out.gnss.geodetic, trial.gnss.geodetic)
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(2.0, rel=0.3)
    change = out.gnss.velocity - trial.gnss.velocity
    assert np.all(change[:, [0, 2]] == 0.0)
    assert np.std(change[:, 1]) == pytest.approx(0.3, rel=0.2)


def test_a_clock_that_jumps_moves_both_halves(trial):
    out = one(trial, faults.clock_step("dvl", 0.4))
    late = out.dvl.time - trial.dvl.time
    assert sorted(set(np.round(late, 9))) == [-0.2, 0.2]
    assert out.calibration_truth["time_offset_s"] == pytest.approx(
        trial.calibration_truth["time_offset_s"]
    )


def test_another_datum_moves_all_fixes_alike(trial):
    out = one(trial, faults.datum((30.0, 40.0, 5.0)))
    assert moved_m(out.gnss.geodetic, trial.gnss.geodetic) == pytest.approx(50.2, abs=0.3)


def test_swapped_fixes_are_each_others():
    trial = simulate(scenario(noise=False, start={"lon_deg": 21.0}))
    out = one(trial, faults.fixes_swapped())
    np.testing.assert_array_equal(out.gnss.geodetic[:, 0], trial.gnss.geodetic[:, 1])


def test_a_slipped_dvl_turns_from_a_time_on(trial):
    out = one(trial, faults.dvl_slipped((0.0, 0.0, 90.0)))
    np.testing.assert_array_equal(out.dvl.velocity[0], trial.dvl.velocity[0])
    x, y, _ = trial.dvl.velocity[-1]
    assert out.dvl.velocity[-1, :2] == pytest.approx([-y, x])


def test_a_water_track_lacks_the_current(trial):
    """Along the course the current takes all of the speed away."""
    still = simulate(scenario(**QUIET, sway={}, current_m_s=[0, 0, 0]))
    velocity = still.reference.velocity[100]
    out = one(still, faults.dvl_water_track(velocity, 30.0))
    inside = np.any(out.dvl.velocity != still.dvl.velocity, axis=1)
    assert inside.sum() == pytest.approx(
        30.0 * still.dvl.time.size / np.ptp(still.dvl.time), abs=2
    )
    speed = np.linalg.norm(out.dvl.velocity[inside], axis=1)
    assert np.all(speed < 0.02 * np.linalg.norm(velocity))


def test_a_stuck_axis_leaves_the_others(trial):
    out = one(trial, faults.stuck("dvl", 1))
    assert np.ptp(out.dvl.velocity[:, 1]) == 0.0
    np.testing.assert_array_equal(out.dvl.velocity[:, 0], trial.dvl.velocity[:, 0])


def test_biases_walk_as_stated(trial):
    out = one(trial, faults.imu_bias_walk(1.0, 100.0))
    walked = (out.imu.gyro - trial.imu.gyro) / DEG_PER_HOUR
    steps = np.diff(walked, axis=0) / np.sqrt(np.diff(out.imu.time)[:, None] / 3600.0)
    assert walked[0] == pytest.approx(0.0, abs=1e-9)
    assert steps.std() == pytest.approx(1.0, abs=0.02)


def test_spikes_hit_a_share_of_the_samples(trial):
    out = one(trial, faults.imu_spikes(0.01, gyro_rad_s=2.0))
    size = np.linalg.norm(out.imu.gyro - trial.imu.gyro, axis=1)
    assert np.mean(size > 0) == pytest.approx(0.01, abs=0.003)
    assert size.max() == pytest.approx(2.0)


def test_settings_are_misstated(trial):
    assert one(trial, faults.sampling_misstated()).imu.settings.sampling == "instantaneous"
    assert one(trial, faults.body_axes_misstated("FLU")).body_axes == "FLU"


def test_biases_change_at_once_and_their_truth_is_the_mean(trial):
    changed = one(trial, faults.imu_bias_step((3.6, 0.0, 0.0), (0.0, 0.0, 1000.0), 0.25))
    gyro = changed.imu.gyro - trial.imu.gyro
    accel = changed.imu.accel - trial.imu.accel
    quarter = len(gyro) // 4
    np.testing.assert_allclose(gyro[[0, quarter - 2]], 0.0, atol=1e-15)
    np.testing.assert_allclose(gyro[[quarter + 2, -1], 0], np.radians(0.001), rtol=1e-6)
    np.testing.assert_allclose(accel[-1], [0.0, 0.0, 0.00980665], atol=1e-9)
    moved = (
        changed.calibration_truth["gyro_bias_deg_h"] - trial.calibration_truth["gyro_bias_deg_h"]
    )
    np.testing.assert_allclose(moved, [2.7, 0.0, 0.0], rtol=0.01)
