"""Recorded data: no simulator's assumptions, no truth but what other sensors say."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from findings import of_code
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from factorgraph_dvl.baselines.navigation import motion_at, navigate
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import frd_from_body, log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import rotate
from factorgraph_dvl.initialization.dvl_mounting import initial_mountings
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.sensors.protocol import Motion
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

SNAPIR = Path(__file__).resolve().parents[3] / "shared" / "data" / "snapir_auv"


@pytest.fixture(scope="module")
def kitti():
    """Car, 471 s: IMU at 100 Hz with a gap of 1.9 s, GNSS positions at 1 Hz with one of 2.9 s."""
    samples = np.loadtxt(gtsam.findExampleDataFile("KittiEquivBiasedImu.txt"), skiprows=1)
    fixes = np.loadtxt(
        gtsam.findExampleDataFile("KittiGps_converted.txt"), skiprows=1, delimiter=","
    )
    # The set gives local coordinates; any place on Earth of that latitude will do.
    frame = LocalFrame(49.0 * DEG, 8.4 * DEG, 110.0)
    geodetic = np.stack(frame.geodetic(fixes[:, 1:4]), axis=1)
    imu = Imu(
        ImuSettings(
            gyro_noise_deg_sqrt_h=0.6,
            gyro_bias_std_deg_h=100.0,
            gyro_bias_walk_deg_h_sqrt_h=10.0,
            accel_noise_ug_sqrt_hz=1000.0,
            accel_bias_std_ug=20000.0,
            accel_bias_walk_ug_sqrt_h=300.0,
        ),
        samples[:, 0],
        samples[:, 5:8].copy(),
        samples[:, 2:5].copy(),
    )
    empty = np.full((len(fixes), 3), np.nan)
    gnss = Gnss(
        # One clock, and an antenna in its place: with both to be found the rounds do not settle.
        GnssSettings(
            position_std_m=(0.07, 0.07, 0.07), lever_arm_std_m=(0.0,) * 3, time_offset_std_s=0.0
        ),
        fixes[:, 0],
        geodetic,
        empty.copy(),
        empty.copy(),
        empty.copy(),
    )
    trial = Trial("kitti", imu, gnss, body_axes="FLU")
    return trial, solve(trial)


@pytest.mark.slow
def test_a_car_is_smoothed_from_positions_alone(kitti):
    _, solution = kitti
    assert solution.converged
    (position,) = solution.residuals
    assert np.all(np.sqrt(np.mean(position.residual**2, axis=0)) < 0.25)


@pytest.mark.slow
def test_what_the_stated_noise_does_not_explain_is_said(kitti):
    """The noise is that of GTSAM's own example: biases of the IMU walk more than it says."""
    _, solution = kitti
    texts = of_code(solution.findings, Code.ESTIMATED_INSTEAD)
    for name in ("gyro_bias_walk_deg_h_sqrt_h", "accel_bias_walk_ug_sqrt_h"):
        assert any(name in text for text in texts), name
    # With these, fixes scatter no more than is stated.
    (noise,) = solution.noise
    assert np.all(noise.factor < 1.0)
    assert of_code(solution.findings, Code.UNUSED)


@pytest.mark.slow
def test_a_kalman_smoother_of_the_car_agrees(kitti):
    """The same data through equations that share nothing with the graph."""
    trial, _ = kitti
    # The filter takes the noise as stated.
    theirs = solve(replace(trial, noise="stated")).trajectory
    ours = motion_at(navigate(trial, np.zeros(0)), theirs.time)
    at = ours.covered
    nRb = rotation_from_rph(theirs.rph[at], trial.body_axes)
    apart = log_so3(ours.nRb[at] @ nRb.transpose(0, 2, 1))
    claimed = np.sqrt(np.diagonal(ours.covariance[at], axis1=1, axis2=2))
    # Of the heading most; they differ in how a gap of 1.9 s is bridged.
    assert np.all(np.sqrt(np.mean((apart / claimed[:, 6:]) ** 2, axis=0)) < 2.0)
    speed_apart = (ours.velocity - theirs.velocity)[at] / claimed[:, 3:6]
    assert np.sqrt(np.mean(speed_apart**2)) < 1.0


@pytest.mark.slow
def test_the_car_does_not_slide_sideways(kitti):
    """Nothing tells the solver that wheels roll forward: heading and biases must show it."""
    trial, solution = kitti
    t = solution.trajectory
    lRb = rotation_from_rph(t.rph, trial.body_axes)
    v_frd = rotate(lRb.transpose(0, 2, 1), t.velocity) @ frd_from_body(trial.body_axes).T
    driving = v_frd[:, 0] > 5.0
    assert driving.mean() > 0.5
    side_slip = np.degrees(np.arctan2(v_frd[driving, 1], v_frd[driving, 0]))
    assert abs(np.median(side_slip)) < 1.5
    assert np.quantile(np.abs(side_slip - np.median(side_slip)), 0.68) < 3.0


@pytest.mark.skipif(not SNAPIR.is_dir(), reason=f"no recorded DVL data in {SNAPIR.name}")
@pytest.mark.parametrize("number", [1, 2, 3, 4, 8, 10])
def test_mounting_of_an_auv(number):
    """An independent fit found, per trajectory: scale error mostly within 0.4 %, yaw
    -0.02 to -0.41 deg, lever arm x -1.78 to -1.89 m, time offset 1.41 to 1.51 s."""
    dvl_table = np.loadtxt(SNAPIR / f"DVL_trajectory{number}.csv", skiprows=1, delimiter=",")
    truth = np.loadtxt(SNAPIR / f"GT_trajectory{number}.csv", skiprows=1, delimiter=",")
    time = truth[:, 0]
    rph = CubicSpline(time, np.unwrap(truth[:, 7:10], axis=0))
    v_ned = CubicSpline(time, truth[:, 4:7])
    attitude = RotationSpline(time, Rotation.from_matrix(rotation_from_rph(rph(time), "FRD")))

    def motion_at(at):
        covered = (at >= time[0]) & (at <= time[-1])
        inside = np.clip(at, time[0], time[-1])
        north, east, down = v_ned(inside).T
        zero = np.zeros((at.size, 3))
        motion = Motion(
            nRb=attitude(inside).as_matrix(),
            p_n=zero,
            v_n=np.stack([east, north, -down], axis=1),
            omega_eb_b=attitude(inside, 1),
            a_n=zero,
            alpha_b=zero,
            omega_sigma=zero,
        )
        return motion, covered

    velocity = dvl_table[:, 1:4].copy()
    dvl = Dvl(
        DvlSettings(
            velocity_std_m_s=0.01,
            time_offset_s=-1.0,
            time_offset_std_s=0.3,
            lever_arm_std_m=(3.0, 3.0, 3.0),
        ),
        dvl_table[:, 0],
        velocity,
        np.full_like(velocity, np.nan),
    )
    found = initial_mountings(dvl, motion_at)[0]
    assert found["time_offset_s"][0] == pytest.approx(-1.46, abs=0.06)
    assert found["lever_arm_m"][0] == pytest.approx(-1.84, abs=0.04)
    assert np.all(np.abs(found["lever_arm_m"][1:]) < 0.2)
    assert abs(found["scale_error"][0]) < 0.004
    angles = log_so3(found["misalignment_deg"]) / DEG
    assert np.all(np.abs(angles) < 0.42)
