"""Errors of mounts, water and electronics, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_trial

from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.simulation import instrument_faults as g
from factorgraph_dvl.simulation.faults import dvl_water_track, with_faults
from factorgraph_dvl.trial import Reference


@pytest.fixture(scope="module")
def trial():
    """Return a minute of 2 m/s ahead in d, with a reference that rolls by 3 deg at its end."""
    out = build_trial(seconds=60.0)
    time = np.linspace(out.imu.time[0], out.imu.time[-1], 601)
    share = (time - time[0]) / np.ptp(time)
    geodetic = np.tile(np.radians([36.0, 121.0, 0.0]), (time.size, 1))
    rph = np.radians(3.0) * np.stack([share, 0.0 * share, 0.0 * share], axis=1)
    reference = Reference(time, geodetic, np.zeros((time.size, 3)), rph)
    dvl = out.dvl
    velocity = np.tile([2.0, 0.0, 0.0], (dvl.time.size, 1))
    truth = {**out.calibration_truth, "misalignment_deg": np.zeros(3)}
    return replace(
        out,
        dvl=replace(dvl, velocity=velocity),
        reference=reference,
        calibration_truth=truth,
    )


def test_a_mount_turns_with_roll(trial):
    # 3 deg of roll turn by 0.1 deg about z.
    made = with_faults(trial, [g.dvl_flexes((0.0, 0.0, 0.1 / 3.0))])
    roll = np.interp(made.dvl.time, trial.reference.time, trial.reference.rph[:, 0])
    angle = np.arctan2(made.dvl.velocity[:, 1], made.dvl.velocity[:, 0])
    np.testing.assert_allclose(angle, roll / 30.0, atol=1e-12)


def test_a_dvl_takes_roll_and_pitch_out(trial):
    """What is level stays so: of a record in body axes, the direction of down is (0, 0, 1)."""
    roll, pitch = (
        np.interp(trial.dvl.time, trial.reference.time, trial.reference.rph[:, i])
        for i in range(2)
    )
    down = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    in_body = down.T @ frd_from_body(trial.body_axes)
    tilted = replace(trial, dvl=replace(trial.dvl, velocity=in_body))
    made = with_faults(tilted, [g.dvl_levelled()]).dvl.velocity
    expected = np.array([0.0, 0.0, 1.0]) @ frd_from_body(trial.body_axes)
    np.testing.assert_allclose(made, np.tile(expected, (len(made), 1)), atol=1e-12)
    assert np.abs(in_body - made).max() > 0.01


def test_gyros_are_late_or_lag(trial):
    time = trial.imu.time
    swinging = np.stack([np.sin(2.0 * np.pi * 0.5 * time)] * 3, axis=1)
    swung = replace(trial, imu=replace(trial.imu, gyro=swinging))
    inside = time > time[0] + 1.0
    late = with_faults(swung, [g.gyros_late(0.004)]).imu.gyro
    expected = np.sin(2.0 * np.pi * 0.5 * (time - 0.004))
    np.testing.assert_allclose(late[inside, 1], expected[inside], atol=1e-6)
    lagging = with_faults(swung, [g.gyros_lag(0.02)]).imu.gyro
    # 1 / (1 + i w T) with w T = 0.063, once the start is forgotten.
    gain, lag = 1.0 / np.hypot(1.0, 0.02 * np.pi), np.arctan(0.02 * np.pi)
    expected = gain * np.sin(2.0 * np.pi * 0.5 * time - lag)
    # Samples of 0.02 s are held: up to half of one, 0.01 s at 3.1 rad/s.
    assert np.abs(lagging[inside, 0] - expected[inside]).max() < 0.032
    assert np.abs(lagging - swinging)[inside].max() > 0.032


def test_digits_windows_and_scales(trial):
    ramp = np.linspace(0.0, 1.0, trial.dvl.time.size)[:, None] * [1.0, -1.0, 0.0]
    moving = replace(trial, dvl=replace(trial.dvl, velocity=ramp + 0.0173))
    cut = with_faults(moving, [g.truncated("dvl", 0.01)]).dvl.velocity
    lost = np.abs(moving.dvl.velocity) - np.abs(cut)
    assert lost.min() > -1e-12
    assert lost.max() < 0.01
    # The mean of a ramp about a time is the ramp.
    mean = with_faults(moving, [g.dvl_averages(2.0)]).dvl.velocity
    np.testing.assert_allclose(mean[20:-20], moving.dvl.velocity[20:-20], atol=1e-12)
    grown = with_faults(moving, [g.dvl_scale_by_speed(0.01)]).dvl.velocity
    speed = np.linalg.norm(moving.dvl.velocity, axis=1)
    expected = 1.0 + 0.01 * (speed - speed.mean())
    np.testing.assert_allclose(grown, moving.dvl.velocity * expected[:, None])


def test_stamps_rise_and_fall_back(trial):
    made = with_faults(trial, [g.saw_of_delays("dvl", 0.05)])
    late = made.dvl.time - trial.dvl.time
    assert np.all(np.diff(made.dvl.time) > 0.0)
    assert np.abs(late).max() <= 0.025 + 1e-6
    # 5 ms for each second but where it falls back, once in ten.
    slope = np.diff(late) / np.diff(trial.dvl.time)
    assert np.median(slope) == pytest.approx(0.005, rel=1e-6)
    assert np.count_nonzero(slope < 0.0) in (5, 6)


def test_a_compass_deviates_by_its_heading(trial):
    reference = replace(trial.reference, rph=trial.reference.rph + 0.5 * np.pi * np.eye(3)[2])
    turned = replace(trial, reference=reference)
    (compass,) = with_faults(turned, [g.compass_deviates((3.0, 1.0, 1.0, 2.0), 0.0)]).others
    # At 90 deg: 3 - 2.
    np.testing.assert_allclose(compass.rph[:, 2], np.radians(91.0), atol=1e-12)
    assert np.isnan(compass.rph[:, :2]).all()


def test_a_current_is_there_all_the_time(trial):
    still = replace(
        trial,
        reference=replace(trial.reference, rph=np.zeros_like(trial.reference.rph)),
        body_axes="FRD",
    )
    # Bow to the north, a current of 0.1 m/s east: starboard, y of a forward, right, down body.
    made = with_faults(still, [dvl_water_track((0.1, 0.0, 0.0), np.inf)])
    change = made.dvl.velocity - still.dvl.velocity
    expected = np.tile([0.0, -0.1, 0.0], (len(change), 1))
    np.testing.assert_allclose(change, expected, atol=1e-12)


def test_noise_of_the_dvl_is_the_same_at_any_speed(trial):
    noisy = with_faults(trial, [g.dvl_noise(0.01)])
    added = noisy.dvl.velocity - trial.dvl.velocity
    np.testing.assert_allclose(np.nanstd(added, axis=0), 0.01, rtol=0.2)


def test_values_are_written_again(trial):
    again = with_faults(trial, [g.written_again("dvl", 3)])
    np.testing.assert_array_equal(again.dvl.velocity[:7:3], trial.dvl.velocity[:7:3])
    np.testing.assert_array_equal(again.dvl.velocity[3:6], trial.dvl.velocity[[3, 3, 3]])
