"""Sensors of attitude and INS: their equations, beside an IMU too."""

from __future__ import annotations

import numpy as np
import pytest
from jacobians import check_jacobians

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeSettings, heading_error
from factorgraph_dvl.sensors.ins import Ins, InsSettings
from factorgraph_dvl.sensors.protocol import Motion

FRAME = LocalFrame(40.0 * DEG, 10.0 * DEG, 0.0)
RPH = np.array([[5.0, -3.0, 10.0], [2.0, 8.0, 200.0], [-9.0, 1.0, 310.0]]) * DEG
TIME = np.array([0.0, 700.0, 1400.0])


@pytest.fixture
def motion():
    rng = np.random.default_rng(3)
    p_n = np.array([[100.0, 50.0, 3.0], [3000.0, -200.0, 2.0], [9000.0, 500.0, -5.0]])
    lat, lon, _ = FRAME.geodetic(p_n)
    lRn = FRAME.level_from_tangent(lat, lon)
    nRb = lRn.transpose(0, 2, 1) @ rotation_from_rph(RPH, "FRD")
    v, omega, a, alpha = (rng.standard_normal((3, 3)) for _ in range(4))
    return Motion(nRb, p_n, 5.0 * v, 0.1 * omega, a, 0.1 * alpha, np.zeros((3, 3)))


def compass(**settings):
    stated = AttitudeSettings(
        heading_offset_std_deg=1.0, schuler_std_deg=0.3, deviation_std_deg=1.0, **settings
    )
    return Attitude(stated, TIME, RPH + np.array([0.0, 0.0, 0.01]))


VALUES = {
    "heading_offset_deg": np.array([0.01]),
    "heading_schuler_deg": np.array([0.002, -0.003]),
    "compass_deviation_deg": np.array([0.01, -0.02, 0.005, 0.001]),
}


def test_attitude_is_that_of_the_body_and_the_error_of_the_heading(motion):
    (angles,) = compass().observations(FRAME, "FRD")
    lasting, _ = heading_error(TIME, RPH[:, 2], VALUES, 0.0)
    expected = lasting[:, None] * [0.0, 0.0, 1.0] - [0.0, 0.0, 0.01]
    np.testing.assert_allclose(angles.residual(motion, VALUES), expected, atol=1e-12)


@pytest.mark.parametrize(("headings", "asked"), [(range(0, 360, 30), True), ((85, 95), False)])
def test_a_deviation_is_asked_for_where_there_are_headings_enough(headings, asked):
    rph = np.array([[0.0, 0.0, h % 360] for h in headings]) * DEG
    record = Attitude(AttitudeSettings(), np.arange(float(len(rph))), rph)
    (deviation,) = (p for p in record.parameters() if p.name == "compass_deviation_deg")
    assert (deviation.spec.plausible is not None) == asked


def test_derivatives_are_those_of_the_residual(motion):
    sensor = compass()
    (angles,) = sensor.observations(FRAME, "FRD")
    # The rate of a clock moves the samples by minutes, so that its differences are curved.
    check_jacobians(angles, motion, VALUES, sensor.parameters()[:3], tolerance=5e-5)


def test_samples_with_one_error_count_once_beside_an_imu():
    time = np.arange(0.0, 3000.0, 10.0)
    record = Attitude(AttitudeSettings(), time, np.zeros((time.size, 3)))
    (angles,) = record.observations(FRAME, "RFU")
    assert np.all(np.diff(angles.time) >= 600.0)
    assert angles.correlated is None
    record = Attitude(AttitudeSettings(correlated_share=0.0), time, np.zeros((time.size, 3)))
    assert record.observations(FRAME, "RFU")[0].time.size == time.size


def test_position_and_velocity_of_an_ins(motion):
    geodetic = np.stack(FRAME.geodetic(motion.p_n), axis=1)
    settings = InsSettings(lever_arm_m=(1.0, -2.0, 0.5), schuler_std_m_s=0.1)
    values = {"ins_schuler_m_s": np.array([0.05, -0.1, 0.02, 0.08])}
    ins = Ins(settings, TIME, geodetic, motion.v_n, RPH, np.full((3, 9), np.nan))
    for observation in ins.motion_observations(FRAME):
        # Differences over 1e-6 of positions of 9 km are rounded to 1e-6.
        check_jacobians(observation, motion, values, ins.parameters()[:1], tolerance=2e-6)


def test_the_position_of_an_ins_errs_by_the_integral_of_its_velocity():
    time = np.arange(0.0, 6000.0, 1.0)
    settings = InsSettings(schuler_std_m_s=0.1)
    place = np.broadcast_to([0.7, 0.1, 0.0], (time.size, 3))
    still = np.zeros((time.size, 3))
    ins = Ins(settings, time, place, still, still, np.full((time.size, 9), np.nan))
    values = {"ins_schuler_m_s": np.array([0.05, -0.1, 0.02, 0.08])}
    position, velocity = (o.error(values) for o in ins.motion_observations(FRAME))
    np.testing.assert_allclose(
        np.gradient(position, time, axis=0)[1:-1], velocity[1:-1], atol=1e-6
    )
    whole = np.sqrt(np.mean(velocity[:5064] ** 2, axis=0))
    np.testing.assert_allclose(whole[0], np.hypot(0.05, 0.02) / np.sqrt(2.0), rtol=1e-3)


def test_values_that_cannot_be_are_refused():
    with pytest.raises(DataError, match="pitch_deg = 95"):
        Attitude(AttitudeSettings(), np.arange(2.0), np.array([[0, 95.0, 0], [0, 0, 0]]) * DEG)
    record = Attitude(AttitudeSettings(), np.arange(2.0), np.array([[np.nan, np.nan, 1.0]] * 2))
    assert not record.measures_tilt
    assert "roll_deg" not in record.columns()
    assert record.error.sigma[0] == 0.0
