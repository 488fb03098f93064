from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from simulated import SWELL, constant, motion_of, run, tangent_states

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import LocalFrame, enu_from_ecef, normal_gravity, radii
from factorgraph_dvl.geometry.rotations import frd_from_body, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import skew


@pytest.mark.parametrize(
    ("body_axes", "lat", "lon"),
    [("RFU", 36.0, 121.0), ("FRD", -33.0, -70.0), ("FLU", 60.0, 179.9999)],
)
def test_rates_and_forces_drive_a_tangent_frame_integration_along_the_truth(body_axes, lat, lon):
    motion = motion_of(
        body_axes=body_axes,
        start={"lat_deg": lat, "lon_deg": lon},
        sway=SWELL,
        current_m_s=[0.3, -0.2, 0.05],
    )
    frame = LocalFrame(lat * DEG, lon * DEG, 10.0)
    earth = skew(frame.earth_rate)

    def derivative(t, y):
        state = motion.at(np.array([np.clip(t, inside[0], inside[1])]))
        nRb = y[:9].reshape(3, 3)
        turn = nRb @ skew(state.omega_ib_b[0]) - earth @ nRb
        # gravity() is that at a fixed point: it includes the centrifugal acceleration.
        acceleration = nRb @ state.f_b[0] + frame.gravity(y[9:12]) - 2.0 * earth @ y[12:]
        return np.concatenate([turn.ravel(), y[12:], acceleration])

    y = tangent_states(motion, frame, np.zeros(1))[0]
    for begin, end in zip(motion.kinks[:-1], motion.kinks[1:], strict=True):
        # Rates jump at the ends of a piece: each is integrated with its own.
        inside = (begin, np.nextafter(end, begin))
        y = solve_ivp(derivative, (begin, end), y, "DOP853", rtol=1e-10, atol=1e-11).y[:, -1]
    error = y - tangent_states(motion, frame, motion.kinks[-1:])[0]
    assert np.max(np.abs(error[:9])) < 1e-10
    assert np.max(np.abs(error[9:12])) < 1e-7
    assert np.max(np.abs(error[12:])) < 1e-8


def test_position_attitude_and_velocity_are_derivatives_of_each_other():
    motion = motion_of(sway=SWELL, current_m_s=[0.3, -0.2, 0.1])
    t = np.arange(2.0, motion.duration - 1.0, 0.37)
    t = t[np.min(np.abs(t[:, None] - motion.kinks), axis=1) > 0.02]
    step = 0.01
    before, now, after = (motion.at(t + d) for d in (-step, 0.0, step))
    meridian, prime = radii(now.geodetic[:, 0])
    height = now.geodetic[:, 2]
    scale = [
        (prime + height) * np.cos(now.geodetic[:, 0]),
        meridian + height,
        np.ones_like(height),
    ]
    moved = (after.geodetic - before.geodetic)[:, [1, 0, 2]] * np.transpose(scale)
    np.testing.assert_allclose(moved / (2 * step), now.v_n, rtol=0, atol=2e-5)
    np.testing.assert_allclose((after.v_n - before.v_n) / (2 * step), now.a_n, rtol=0, atol=5e-5)

    def eRb(state):
        lat, lon = state.geodetic[:, 0], state.geodetic[:, 1]
        return np.swapaxes(enu_from_ecef(lat, lon), 1, 2) @ rotation_from_rph(state.rph, "RFU")

    rate = (eRb(after) - eRb(before)) / (2 * step)
    cross = np.swapaxes(eRb(now), 1, 2) @ rate
    omega = np.stack([cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0]], axis=1)
    np.testing.assert_allclose(omega, now.omega_eb_b, rtol=0, atol=2e-6)


def test_a_long_leg_follows_the_meridian_to_a_micrometre():
    legs = {"start": {"heading_deg": 0, "height_m": 0, "speed_m_s": 12}}
    motion = motion_of(manoeuvres=[{"straight_s": 5000}], **legs)
    lat0, lat1 = motion.at(np.array([0.0, 5000.0])).geodetic[:, 0]
    arc, _ = quad(lambda lat: float(radii(lat)[0]), lat0, lat1, epsabs=1e-9)
    assert arc == pytest.approx(60e3, abs=1e-6)


@pytest.mark.parametrize("lat", [-54.0, 0.0, 36.0])
def test_a_long_leg_east_follows_the_parallel(lat):
    start = {"lat_deg": lat, "lon_deg": 179.9, "heading_deg": 90, "height_m": 0, "speed_m_s": 12}
    end = motion_of(manoeuvres=[{"straight_s": 5000}], start=start).at(np.array([5000.0]))
    radius = float(radii(lat * DEG)[1]) * np.cos(lat * DEG)
    turned = (end.geodetic[0, 1] - 179.9 * DEG) % (2 * np.pi)
    assert turned * radius == pytest.approx(60e3, abs=1e-6)
    # Heading 90 degrees to within 1e-16: the drift north is nothing that a metre shows.
    assert end.geodetic[0, 0] == pytest.approx(lat * DEG, abs=1e-15)
    assert end.geodetic[0, 1] < -np.pi + 1.0


def test_roll_is_starboard_down_and_pitch_bow_up():
    at_rest = [{"straight_s": 1}]
    gravity = float(normal_gravity(36 * DEG, 10.0))
    rolled = run(manoeuvres=at_rest, sway={"roll": constant(30)}).imu.accel[0]
    np.testing.assert_allclose(rolled, gravity * np.array([-0.5, 0, np.sqrt(0.75)]), atol=1e-12)
    pitched = run(manoeuvres=at_rest, sway={"pitch": constant(30)}).imu.accel[0]
    np.testing.assert_allclose(pitched, gravity * np.array([0, 0.5, np.sqrt(0.75)]), atol=1e-12)


@pytest.mark.parametrize("ramp", [0, 4, 10])
def test_a_positive_turn_goes_to_starboard_by_rate_times_duration(ramp):
    turn = [{"turn_deg_s": 4, "duration_s": 10, "ramp_s": ramp}, {"straight_s": 20}]
    trial = run(start={"heading_deg": 350, "speed_m_s": 2}, manoeuvres=turn)
    reference = trial.reference
    assert reference.time[-1] == 30 + ramp
    assert reference.rph[-1, 2] / DEG == pytest.approx(30.0)
    np.testing.assert_allclose(
        reference.velocity[-1], [2 * np.sin(30 * DEG), 2 * np.cos(30 * DEG), 0], atol=1e-12
    )
    # Clockwise seen from above is negative about the up axis.
    assert trial.imu.gyro[:, 2].sum() * 0.01 / DEG == pytest.approx(-40.0, abs=0.2)


def test_body_axes_describe_the_same_motion():
    common = {"sway": SWELL, "current_m_s": [0.2, 0.1, 0]}
    frd = run(body_axes="FRD", dvl={"lever_arm_m": [1.2, 1, -1.4]}, **common)
    for axes, lever_arm in (("RFU", [1, 1.2, 1.4]), ("FLU", [1.2, -1, 1.4])):
        other = run(body_axes=axes, dvl={"lever_arm_m": lever_arm}, **common)
        to_frd = frd_from_body(axes).T
        np.testing.assert_allclose(other.imu.gyro @ to_frd, frd.imu.gyro, atol=1e-15)
        np.testing.assert_allclose(other.imu.accel @ to_frd, frd.imu.accel, atol=1e-13)
        np.testing.assert_allclose(other.dvl.velocity @ to_frd, frd.dvl.velocity, atol=1e-13)
        np.testing.assert_array_equal(other.reference.geodetic, frd.reference.geodetic)


def test_impossible_motion_is_refused():
    with pytest.raises(ConfigError, match="does not lead from 0 to 4"):
        run(manoeuvres=[{"accelerate_m_s2": -1, "to_m_s": 4}])
    with pytest.raises(ConfigError, match="pole"):
        run(
            start={"lat_deg": 89, "heading_deg": 0, "speed_m_s": 50},
            manoeuvres=[{"straight_s": 5000}],
        )
    with pytest.raises(ConfigError, match="shorter than one IMU period"):
        run(manoeuvres=[{"straight_s": 0.001}])
