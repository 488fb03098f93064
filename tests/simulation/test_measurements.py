"""The simulator against oracles that share no formula with it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from pyins import strapdown
from simulated import SWELL, constant, motion_of, run, scenario_dict

from factorgraph_dvl.geometry.earth import RATE, LocalFrame, normal_gravity
from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, HOUR, MICRO_G
from factorgraph_dvl.simulation import parse_scenario, simulate


@pytest.mark.filterwarnings("ignore:The copy keyword")
@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_pyins_integrates_the_mean_samples_back_to_the_truth(body_axes):
    legs = [
        {"straight_s": 20},
        {"turn_deg_s": -6, "duration_s": 30, "ramp_s": 5},
        {"straight_s": 10},
        {"turn_deg_s": 9, "duration_s": 40, "ramp_s": 5},
    ]
    # Its gravity is linear in height with a slope of its own: the same only at height 0.
    trial = run(
        body_axes=body_axes,
        start={"lat_deg": -33, "lon_deg": -70, "height_m": 0, "speed_m_s": 4},
        manoeuvres=[{"repeat": 2, "manoeuvres": legs}],
        sway=SWELL,
        current_m_s=[0.3, -0.2, 0],
        reference_rate_hz=100,
    )
    reference = trial.reference
    dt = 0.01
    to_frd = frd_from_body(body_axes).T
    imu = pd.DataFrame(
        np.hstack([trial.imu.gyro @ to_frd * dt, trial.imu.accel @ to_frd * dt]),
        index=trial.imu.time,
        columns=["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"],
    )
    v_e, v_n, v_u = reference.velocity[1]
    lat, lon, height = reference.geodetic[1]
    start = pd.Series(
        [lat / DEG, lon / DEG, height, v_n, v_e, -v_u, *(reference.rph[1] / DEG)],
        index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
    )
    increments = strapdown.compute_increments_from_imu(imu, "increment")
    # Its increments lack the second-order rotation, g · theta² / 6: 2e-7 m/s² in this swell.
    theta, dv = (increments[[f"{name}_{x}" for x in "xyz"]].to_numpy() for name in ("theta", "dv"))
    increments[["dv_x", "dv_y", "dv_z"]] += np.cross(theta, np.cross(theta, dv)) / 6.0
    found = strapdown.Integrator(start).integrate(increments)
    lat, lon, height = reference.geodetic[1:].T
    position = np.transpose([found.lat * DEG - lat, found.lon * DEG - lon, found.alt - height])
    position *= [6.4e6, 6.4e6, 1]
    velocity = found[["VE", "VN", "VD"]].to_numpy() * [1, 1, -1] - reference.velocity[1:]
    attitude = found[["roll", "pitch", "heading"]].to_numpy() - reference.rph[1:] / DEG
    assert np.max(np.abs(position)) < 1e-3
    assert np.max(np.abs(velocity)) < 1e-5
    assert np.max(np.abs((attitude + 180) % 360 - 180)) < 5e-8


def test_mean_samples_average_exactly_across_kinks():
    changes = {
        "manoeuvres": [
            {"straight_s": 1.0037},
            {"turn_deg_s": 20, "duration_s": 1.0088},
            {"accelerate_m_s2": 3, "to_m_s": 1},
            {"straight_s": 0.5},
        ],
        "sway": {
            "roll": [{"amplitude_deg": 4, "frequency_hz": 2}],
            "pitch": [{"amplitude_deg": 4, "frequency_hz": 2, "phase_deg": 90}],
        },
    }
    trial, motion = run(**changes), motion_of(**changes)
    for kink in motion.kinks[1:-1]:
        i = int(np.searchsorted(trial.imu.time, kink))
        end = trial.imu.time[i]
        gyro, accel = np.zeros(3), np.zeros(3)
        for a, b in ((end - 0.01, kink), (kink, end)):
            t = a + (b - a) * (np.arange(4000) + 0.5) / 4000
            state = motion.at(t)
            gyro += state.omega_ib_b.mean(axis=0) * (b - a) / 0.01
            accel += state.f_b.mean(axis=0) * (b - a) / 0.01
        np.testing.assert_allclose(trial.imu.gyro[i], gyro, rtol=0, atol=1e-10)
        np.testing.assert_allclose(trial.imu.accel[i], accel, rtol=0, atol=1e-9)


def test_mean_samples_hold_for_coarse_sampling():
    sway = {"roll": [{"amplitude_deg": 4, "frequency_hz": 2}], "pitch": constant(3)}
    coarse = run(sway=sway, imu={"rate_hz": 2})
    fine = run(sway=sway, imu={"rate_hz": 200})
    np.testing.assert_allclose(
        coarse.imu.gyro, fine.imu.gyro.reshape(-1, 100, 3).mean(axis=1), rtol=0, atol=1e-12
    )


def test_instantaneous_samples_are_values_at_their_time():
    trial, motion = run(imu={"sampling": "instantaneous"}, sway=SWELL), motion_of(sway=SWELL)
    state = motion.at(trial.imu.time)
    np.testing.assert_array_equal(trial.imu.gyro, state.omega_ib_b)
    np.testing.assert_array_equal(trial.imu.accel, state.f_b)
    assert trial.imu.settings.sampling == "instantaneous"


@pytest.mark.parametrize(
    ("body_axes", "force", "rate_axis"),
    [("RFU", [0, 0, 1], 1), ("FRD", [0, 0, -1], 0), ("FLU", [0, 0, 1], 0)],
)
def test_at_rest_the_imu_feels_gravity_and_the_earth(body_axes, force, rate_axis):
    start = {"lat_deg": -30, "heading_deg": 0}
    trial = run(body_axes=body_axes, start=start, manoeuvres=[{"straight_s": 1}])
    gravity = float(normal_gravity(-30 * DEG, 10.0))
    np.testing.assert_allclose(trial.imu.accel, np.tile(gravity * np.array(force), (100, 1)))
    expected = np.zeros(3)
    expected[rate_axis] = RATE * np.cos(30 * DEG)
    expected -= RATE * np.sin(30 * DEG) * np.array(force)
    np.testing.assert_allclose(trial.imu.gyro[50], expected, rtol=0, atol=1e-17)


@pytest.mark.parametrize(
    ("body_axes", "velocity"),
    [
        # 2 m/s ahead is 2 along y; turned by +30 degrees about z: (-2 sin 30, 2 cos 30, 0).
        ("RFU", [-1.0, 1.7320508075688772, 0.0]),
        # 2 along x: (2 cos 30, 2 sin 30, 0).
        ("FRD", [1.7320508075688772, 1.0, 0.0]),
        ("FLU", [1.7320508075688772, 1.0, 0.0]),
    ],
)
def test_a_dvl_moving_east_reports_these_numbers(body_axes, velocity):
    trial = run(
        body_axes=body_axes,
        start={"heading_deg": 90, "speed_m_s": 2},
        manoeuvres=[{"straight_s": 10}],
        dvl={"misalignment_deg": [0, 0, 30], "scale_error": 0.01, "bias_m_s": [0.1, 0.2, 0.3]},
    )
    expected = 1.01 * np.array(velocity) + [0.1, 0.2, 0.3]
    np.testing.assert_allclose(trial.dvl.velocity, np.tile(expected, (50, 1)), atol=1e-12)


def test_the_scale_error_acts_along_the_dvl_axes():
    trial = run(
        start={"heading_deg": 90, "speed_m_s": 2},
        manoeuvres=[{"straight_s": 1}],
        dvl={"misalignment_deg": [0, 0, 90], "scale_error": [0.1, 0.2, 0.3]},
    )
    # 2 along y becomes -2 along x of the DVL, and takes the scale of x.
    np.testing.assert_allclose(trial.dvl.velocity[0], [-2.2, 0, 0], atol=1e-12)


def test_lever_arms_swing_with_the_turn():
    trial = run(
        start={"heading_deg": 0},
        manoeuvres=[{"turn_deg_s": 9, "duration_s": 20}],
        dvl={"lever_arm_m": [1, 0, 0]},
        gnss={"lever_arm_m": [0, 2, 0]},
    )
    # Turning to starboard, a point one metre to starboard moves astern: 9 deg/s · 1 m.
    np.testing.assert_allclose(
        trial.dvl.velocity, np.tile([0, -0.15707963267948966, 0], (100, 1)), atol=1e-15
    )
    # After 90 degrees an antenna two metres ahead is two metres east and moves south.
    i = int(np.argmin(np.abs(trial.gnss.time - 10.0)))
    frame = LocalFrame(*trial.reference.geodetic[100])
    np.testing.assert_allclose(frame.position(*trial.gnss.geodetic[i]), [2, 0, 0], atol=1e-8)
    np.testing.assert_allclose(trial.gnss.velocity[i], [0, -0.3141592653589793, 0], atol=1e-12)


def test_a_late_clock_reports_past_velocities():
    ahead = {
        "start": {"heading_deg": 0},
        "manoeuvres": [{"accelerate_m_s2": 0.5, "to_m_s": 5}],
    }
    trial = run(dvl={"time_offset_s": 0.2}, **ahead)
    np.testing.assert_allclose(trial.dvl.velocity[:, 1], 0.5 * (trial.dvl.time - 0.2), atol=1e-12)
    assert trial.calibration_truth["time_offset_s"] == 0.2


def test_water_track_lacks_the_current():
    current = {
        "start": {"heading_deg": 90, "speed_m_s": 2},
        "manoeuvres": [{"straight_s": 2}],
        "current_m_s": [0.5, 0.25, 0],
    }
    bottom, water = run(**current), run(dvl={"reference": "water"}, **current)
    np.testing.assert_allclose(bottom.dvl.velocity[0], [-0.25, 2.5, 0], atol=1e-12)
    np.testing.assert_allclose(water.dvl.velocity[0], [0, 2, 0], atol=1e-12)
    np.testing.assert_array_equal(water.calibration_truth["current_m_s"], [0.5, 0.25])
    assert "current_m_s" not in bottom.calibration_truth
    assert water.dvl.settings.reference == "water"


def test_sample_times_are_phase_plus_whole_periods():
    trial = run(gnss={"phase_s": 0.03}, dvl={"rate_hz": 4}, imu={"phase_s": 0.004})
    np.testing.assert_array_equal(trial.dvl.time[:3], [0.25, 0.5, 0.75])
    np.testing.assert_array_equal(trial.gnss.time[:2], [0.03, 0.23])
    np.testing.assert_array_equal(trial.imu.time[:2], [0.014, 0.024])
    np.testing.assert_array_equal(trial.reference.time[:4], [0.0, 0.1, 0.2, 0.3])
    assert trial.imu.time[-1] <= motion_of().duration


def test_gaps_and_outages_leave_the_rest_alone():
    whole = run(noise=True, imu={"gyro_noise_deg_sqrt_h": 1})
    holed = run(
        noise=True,
        imu={"gyro_noise_deg_sqrt_h": 1, "gaps_s": [[2, 3.005]]},
        gnss={"outages_s": [[4, 8], [10, 11]]},
        dvl={"no_lock_s": [[1, 2]]},
    )
    kept = (whole.imu.time < 2) | (whole.imu.time > 3.005)
    np.testing.assert_array_equal(holed.imu.time, whole.imu.time[kept])
    np.testing.assert_array_equal(holed.imu.gyro, whole.imu.gyro[kept])
    t = whole.gnss.time
    kept = ~(((t >= 4) & (t <= 8)) | ((t >= 10) & (t <= 11)))
    np.testing.assert_array_equal(holed.gnss.geodetic, whole.gnss.geodetic[kept])
    lost = np.isnan(holed.dvl.velocity).all(axis=1)
    np.testing.assert_allclose(holed.dvl.time[lost], [1, 1.2, 1.4, 1.6, 1.8, 2])
    np.testing.assert_array_equal(holed.dvl.velocity[~lost], whole.dvl.velocity[~lost])


def test_jittered_samples_average_their_own_interval():
    changes = {
        "sway": {"roll": [{"amplitude_deg": 4, "frequency_hz": 2}]},
        "manoeuvres": [{"straight_s": 10}],
    }
    trial = run(imu={"jitter_s": 0.004}, gnss={"jitter_s": 0.05}, **changes)
    steps = np.diff(trial.imu.time)
    assert np.all(steps > 0)
    # Both ends of an interval shift by a uniform +-4 ms.
    assert np.std(steps) == pytest.approx(0.004 * np.sqrt(2 / 3), rel=0.1)
    assert np.all(np.diff(trial.gnss.time) > 0)
    # Whatever the intervals are, the samples add up to the angle; the Earth turns with it.
    earth_ahead = RATE * np.cos(36 * DEG) * np.cos(30 * DEG)
    roll = motion_of(**changes).at(trial.imu.time).rph[:, 0]
    turned = np.cumsum((trial.imu.gyro[1:, 1] - earth_ahead) * steps)
    np.testing.assert_allclose(roll[0] + turned, roll[1:], rtol=0, atol=1e-12)


def test_the_seed_determines_everything():
    noisy = {
        "noise": True,
        "dvl": {"velocity_std_m_s": 0.001},
        "imu": {
            "gyro_noise_deg_sqrt_h": 0.1,
            "accel_noise_ug_sqrt_hz": 20,
            "gyro_bias_deg_h": "draw",
            "gyro_bias_std_deg_h": 1,
            "jitter_s": 0.001,
        },
    }
    a, b, other = run(3, **noisy), run(3, **noisy), run(4, **noisy)
    for get in (lambda x: x.imu.gyro, lambda x: x.gnss.geodetic, lambda x: x.dvl.velocity):
        np.testing.assert_array_equal(get(a), get(b))
        assert not np.any(get(a)[5:] == get(other)[5:])
    assert np.all(
        a.calibration_truth["gyro_bias_deg_h"] != other.calibration_truth["gyro_bias_deg_h"]
    )


def test_sensors_draw_from_streams_of_their_own():
    noisy = {"noise": True, "imu": {"gyro_noise_deg_sqrt_h": 0.1}}
    both, alone = run(3, **noisy), run(3, gnss=None, **noisy)
    np.testing.assert_array_equal(both.imu.gyro, alone.imu.gyro)
    np.testing.assert_array_equal(both.dvl.velocity, alone.dvl.velocity)
    assert alone.gnss is None
    assert "gnss_lever_arm_m" not in alone.calibration_truth


def test_noise_has_the_stated_size():
    long = {
        "start": {"speed_m_s": 4},
        "manoeuvres": [{"straight_s": 1000}],
        "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.3, "accel_noise_ug_sqrt_hz": 60},
        "gnss": {"rate_hz": 10, "position_std_m": [0.5, 1, 2]},
        "dvl": {"rate_hz": 10, "velocity_std_m_s": 0.006, "velocity_std_fraction": 0.002},
    }
    exact, noisy = run(**long), run(**(long | {"noise": True}))
    gyro = np.std(noisy.imu.gyro - exact.imu.gyro, axis=0)
    np.testing.assert_allclose(gyro, 0.3 * DEG_PER_SQRT_HOUR * np.sqrt(50), rtol=0.02)
    accel = np.std(noisy.imu.accel - exact.imu.accel, axis=0)
    np.testing.assert_allclose(accel, 60 * MICRO_G * np.sqrt(50), rtol=0.02)
    frame = LocalFrame(*exact.gnss.geodetic[0])
    position = frame.position(*noisy.gnss.geodetic.T) - frame.position(*exact.gnss.geodetic.T)
    np.testing.assert_allclose(np.std(position, axis=0), [0.5, 1, 2], rtol=0.03)
    velocity = np.std(noisy.gnss.velocity - exact.gnss.velocity, axis=0)
    np.testing.assert_allclose(velocity, 0.1, rtol=0.03)
    # 6 mm/s and 0.2 % of 4 m/s: 10 mm/s.
    np.testing.assert_allclose(
        np.std(noisy.dvl.velocity - exact.dvl.velocity, axis=0), 0.01, rtol=0.03
    )
    np.testing.assert_allclose(noisy.dvl.sigma(), 0.01, rtol=0.01)


def test_a_walking_bias_is_reported_as_its_mean():
    still = {"manoeuvres": [{"straight_s": 1000}]}
    walk = {
        "gyro_bias_deg_h": [1, 2, 3],
        "gyro_bias_walk_deg_h_sqrt_h": 10,
        "accel_bias_ug": [10, 20, 30],
        "accel_bias_walk_ug_sqrt_h": 20,
    }
    exact = run(**still)
    trial = run(noise=True, imu=walk, **still)
    gyro = (trial.imu.gyro - exact.imu.gyro) / DEG_PER_HOUR
    accel = (trial.imu.accel - exact.imu.accel) / MICRO_G
    truth = trial.calibration_truth
    np.testing.assert_allclose(gyro.mean(axis=0), truth["gyro_bias_deg_h"], atol=1e-6)
    np.testing.assert_allclose(accel.mean(axis=0), truth["accel_bias_ug"], atol=1e-6)
    np.testing.assert_allclose(np.std(np.diff(gyro, axis=0)), 10 * np.sqrt(0.01 / HOUR), rtol=0.01)
    np.testing.assert_allclose(
        np.std(np.diff(accel, axis=0)), 20 * np.sqrt(0.01 / HOUR), rtol=0.01
    )
    np.testing.assert_allclose(gyro[0], [1, 2, 3], atol=0.1)
    assert trial.imu.settings.gyro_bias_walk_deg_h_sqrt_h == 10


def test_without_noise_constant_biases_stay():
    imu = {"gyro_bias_deg_h": [1, 2, 3], "gyro_noise_deg_sqrt_h": 1, "accel_bias_ug": [10, 20, 30]}
    exact, biased = run(), run(imu=imu)
    gyro = (biased.imu.gyro - exact.imu.gyro) / DEG_PER_HOUR
    np.testing.assert_allclose(gyro, np.tile([1.0, 2, 3], (len(gyro), 1)), atol=1e-8)
    np.testing.assert_array_equal(biased.calibration_truth["accel_bias_ug"], [10, 20, 30])


def test_drawn_biases_scatter_by_their_standard_deviation():
    draw = {"gyro_bias_deg_h": "draw", "gyro_bias_std_deg_h": 10}
    scenario = parse_scenario(
        scenario_dict(imu=draw, manoeuvres=[{"straight_s": 0.01}], dvl=None, gnss=None)
    )
    biases = [simulate(scenario, s).calibration_truth["gyro_bias_deg_h"] for s in range(200)]
    assert np.std(biases) == pytest.approx(10, rel=0.1)


def test_a_receiver_without_velocity_reports_none():
    trial = run(gnss={"velocity_std_m_s": None})
    assert np.isnan(trial.gnss.velocity).all()
