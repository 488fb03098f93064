"""USBL: equations against the simulated way of the sound, a case by hand, records in files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jacobians import check_jacobians, random_motion
from truth import exact_motion, scenario

import factorgraph_dvl as fd
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.trial_folder import load_trial, record_files, save_trial
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.ship import Ship, ShipSettings
from factorgraph_dvl.sensors.usbl import Usbl, UsblSettings, near_their_neighbours
from factorgraph_dvl.settings.convert import convert
from factorgraph_dvl.simulation import plan_motion, simulate

ARM_S, ARM = [1.5, 4.0, -6.0], [0.3, -0.5, 0.2]
TURN = [1.5, -2.0, 3.0]
SHIP = {
    "start": {"lat_deg": 36.0004, "lon_deg": 121.0005, "height_m": 62, "heading_deg": 75},
    "manoeuvres": [
        {"accelerate_m_s2": 0.1, "to_m_s": 2},
        {"turn_deg_s": 2, "duration_s": 30, "ramp_s": 8},
    ],
    "sway": {
        "roll": [{"amplitude_deg": 3, "frequency_hz": 0.12}],
        "pitch": [{"amplitude_deg": 2, "frequency_hz": 0.1, "phase_deg": 50}],
        "heave": [{"amplitude_m": 0.4, "frequency_hz": 0.11}],
    },
    "rate_hz": 20,
    "transceiver_lever_arm_m": ARM_S,
    "misalignment_deg": TURN,
    "sound_speed_error": 0.004,
}


def usbl(**changes):
    return {"rate_hz": 1, "transponder_lever_arm_m": ARM, "ship": SHIP, **changes}


def record(polar=None, cartesian=None, arm=ARM, arm_s=ARM_S):
    """A few fixes under a ship that sails and turns."""
    m = len(polar if cartesian is None else cartesian)
    nothing = np.full((m, 3), np.nan)
    time = np.arange(0.0, 20.0, 0.5)
    slow = 0.3 * np.sin(0.7 * time)
    geodetic = np.radians([36.0, 121.0]) + np.outer(time, [1e-7, 2e-7])
    ship = Ship(
        ShipSettings(transceiver_lever_arm_m=tuple(arm_s)),
        time,
        np.column_stack([geodetic, 50.0 + slow]),
        np.column_stack([slow, -0.5 * slow, 2.0 + 0.05 * time]),
    )
    settings = UsblSettings(transponder_lever_arm_m=tuple(arm), ship=ship.settings)
    return Usbl(
        settings,
        np.arange(5.0, 5.0 + m),
        nothing,
        nothing,
        nothing if polar is None else np.array(polar),
        nothing if cartesian is None else np.array(cartesian),
        np.zeros(m),
        ship,
    )


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("measures", ["polar", "cartesian", "position"])
def test_zero_error_at_the_truth(body_axes, measures):
    scene = scenario(body_axes=body_axes, usbl=usbl(measures=measures, age_s=0.3))
    exact, trial = plan_motion(scene), simulate(scene, seed=5)
    frame = LocalFrame(*exact.at(np.array([0.0])).geodetic[0])
    record = trial.find(Usbl)
    (o,) = record.observations(frame, body_axes)
    values = true_values(trial)
    values |= {"usbl_misalignment_deg": exp_so3(np.array(TURN) * DEG)}
    error = o.residual(exact_motion(exact, frame, o.time), values)
    # Over the way of the sound, 0.15 s, the ship accelerates by 0.3 m/s².
    assert error.shape == (o.time.size, 3)
    assert np.abs(error).max() < 0.5 * 0.3 * 0.3**2


def true_values(trial):
    names = ("usbl_sound_speed_error", "usbl_transceiver_lever_arm_m")
    names = (*names, "usbl_transponder_lever_arm_m", "usbl_time_offset_s")
    return {name: trial.calibration_truth[name] for name in names}


def test_a_transposed_rotation_shows():
    scene = scenario(usbl=usbl(measures="cartesian"))
    exact, trial = plan_motion(scene), simulate(scene)
    frame = LocalFrame(*exact.at(np.array([0.0])).geodetic[0])
    (o,) = trial.find(Usbl).observations(frame, "RFU")
    motion = exact_motion(exact, frame, o.time)
    right = true_values(trial) | {"usbl_misalignment_deg": exp_so3(np.array(TURN) * DEG)}
    turned = right | {"usbl_misalignment_deg": right["usbl_misalignment_deg"].T}
    assert np.abs(o.residual(motion, turned)).max() > 1.0
    body = replace(motion, nRb=motion.nRb.transpose(0, 2, 1))
    assert np.abs(o.residual(body, right)).max() > 0.3
    ship = o.ship
    back = replace(o, ship=replace(ship, rph=-ship.rph))
    assert np.abs(back.residual(motion, right)).max() > 1.0


@pytest.mark.parametrize("body_axes", ["RFU", "FLU"])
def test_jacobians(body_axes):
    polar = np.array([[60.0, 0.4, 0.9], [80.0, 2.5, 0.3], [45.0, 5.0, 1.4], [70.0, 4.0, 0.6]])
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    for r in (record(polar), record(cartesian=[[30.0, -20.0, 40.0], [-9.0, 25.0, 33.0]])):
        (o,) = r.observations(frame, body_axes)
        values = {
            "usbl_misalignment_deg": exp_so3(np.array([0.02, -0.05, 0.4])),
            "usbl_sound_speed_error": np.array([0.01]),
            "usbl_transceiver_lever_arm_m": np.array(ARM_S),
            "usbl_transponder_lever_arm_m": np.array(ARM),
            "usbl_time_offset_s": np.array([0.13]),
            "usbl_clock_rate_ppm": np.zeros(1),
        }
        check_jacobians(o, random_motion(o.time.size), values, r.parameters(), tolerance=5e-6)


def test_by_hand():
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    lat, lon, _ = frame.geodetic(np.zeros(3))
    time = np.arange(4.0)
    east = np.tile([0.0, 0.0, 0.5 * np.pi], (4, 1))
    at_rest = np.tile([float(lat), float(lon), 10.0], (4, 1))
    settings = ShipSettings(transceiver_lever_arm_m=(2.0, 3.0, -4.0))
    ship = Ship(settings, time, at_rest, east)
    nothing = np.full((1, 3), np.nan)
    r = Usbl(
        UsblSettings(transponder_lever_arm_m=(0.0, 1.0, 0.0), ship=settings),
        *(np.array([2.0]), nothing, nothing),
        *(np.array([[13.0, np.arctan2(4.0, 3.0), np.arcsin(12.0 / 13.0)]]), nothing),
        *(np.zeros(1), ship),
    )
    (o,) = r.observations(frame, "RFU")
    assert o.time == pytest.approx(2.0 - 13.0 / 1500.0)
    # The bow points east: the transceiver, 2 to starboard, 3 ahead and 4 below the reference
    # point, is at (3, -2, 6), and sees the transponder 3 m ahead, 4 m to starboard, 12 m below,
    # at (6, -6, -6). The vehicle points north: its IMU is a metre to the south of it.
    motion = replace(random_motion(1), nRb=np.eye(3)[None], p_n=np.array([[6.0, -7.0, -6.0]]))
    values = {
        "usbl_misalignment_deg": np.eye(3),
        "usbl_sound_speed_error": np.zeros(1),
        "usbl_transceiver_lever_arm_m": np.array([2.0, 3.0, -4.0]),
        "usbl_transponder_lever_arm_m": np.array([0.0, 1.0, 0.0]),
        "usbl_time_offset_s": np.zeros(1),
    }
    np.testing.assert_allclose(o.residual(motion, values), 0.0, atol=1e-7)
    # Sound that is 1 % slower than supposed makes the range 0.13 m longer.
    longer = values | {"usbl_sound_speed_error": np.array([0.01])}
    np.testing.assert_allclose(o.residual(motion, longer), [[0.13, 0.0, 0.0]], atol=1e-7)
    # Components that turn about the upward axis, as alpha does: it appears farther to port.
    turned = values | {"usbl_misalignment_deg": exp_so3(np.array([0.0, 0.0, 1e-4]))}
    np.testing.assert_allclose(o.residual(motion, turned), [[0.0, -5e-4, 0.0]], atol=1e-7)
    # A bearing errs by its angle times the distance in the plane, a depression by that in all.
    np.testing.assert_allclose(o.std, [[0.2, 0.15 * DEG * 5.0, 0.15 * DEG * 13.0]])


@pytest.mark.parametrize("measures", ["polar", "cartesian", "position"])
def test_it_is_read_as_it_was_written(tmp_path, measures):
    trial = simulate(scenario(usbl=usbl(measures=measures, age_s=0.5)), seed=2)
    save_trial(trial, tmp_path / "trial")
    assert tmp_path / "trial" / "ship.csv" in record_files(tmp_path / "trial")
    loaded, given = load_trial(tmp_path / "trial").find(Usbl), trial.find(Usbl)
    for name in ("time", "geodetic", "polar", "cartesian", "age"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(given, name), atol=1e-9)
    np.testing.assert_allclose(loaded.ship.geodetic, given.ship.geodetic, atol=1e-12)
    assert loaded.settings.ship.transceiver_lever_arm_m == tuple(ARM_S)


def test_a_transceiver_needs_its_ship():
    with pytest.raises(ConfigError, match=r"usbl\.ship"):
        replace(record([[60.0, 0.4, 0.9]]), ship=None)


def test_noise_of_positions_grows_with_the_slant_range():
    scene = scenario(usbl=usbl(measures="position", std_fraction=0.01))
    r = simulate(scene).find(Usbl)
    frame = LocalFrame(np.radians(36.0), np.radians(121.0), 0.0)
    (o,) = r.observations(frame, "RFU")
    slant = 1500.0 * (r.time - o.time)
    assert np.ptp(slant) > 20.0
    np.testing.assert_allclose(o.std, np.hypot(0.5, 0.01 * slant)[:, None] * np.ones(3))
    stated = replace(r, position_std=np.full(r.geodetic.shape, 2.0))
    assert np.all(stated.observations(frame, "RFU")[0].std == 2.0)


def test_settings_are_checked():
    with pytest.raises(ConfigError, match="range_std_m"):
        convert({"range_std_m": 0}, UsblSettings, "usbl", "test")


@pytest.mark.parametrize("measures", ["polar", "cartesian", "position"])
def test_it_passes_the_check_of_sensors(measures):
    trial = simulate(scenario(usbl=usbl(measures=measures)))
    fd.check_sensor(trial.find(Usbl), trial.frame(), trial.body_axes)


def test_fixes_that_are_far_from_their_neighbours_begin_nothing():
    frame = LocalFrame(0.6, 2.1, 0.0)
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 600.0, 2.0)
    # A box at 1.5 m/s, with corners.
    side = 1.5 * (time % 150.0)
    corner = 225.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    ahead = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    leg = (time // 150.0).astype(int)
    p_n = np.column_stack([corner[leg] + side[:, None] * ahead[leg], np.full(time.size, -50.0)])
    p_n += rng.normal(0.0, 0.3, p_n.shape)
    wrong = rng.random(time.size) < 0.1
    p_n[wrong, :2] += rng.choice([-1.0, 1.0], (wrong.sum(), 2)) * rng.uniform(10.0, 40.0)
    none = np.full((time.size, 3), np.nan)
    geodetic = np.stack(frame.geodetic(p_n), axis=1)
    fixes = Gnss(GnssSettings(), time, geodetic, none, np.full((time.size, 3), 0.3), none)
    near = near_their_neighbours(fixes, frame)
    assert not near[wrong].any()
    # Some are lost at both ends, where a median is of one side.
    assert near[~wrong].mean() > 0.95
    # What has no position spoils no median.
    without = np.insert(geodetic, 150, np.nan, axis=0)
    times, std = np.insert(time, 150, time[149] + 1.0), np.full((time.size + 1, 3), 0.3)
    absent = np.full((time.size + 1, 3), np.nan)
    again = near_their_neighbours(Gnss(GnssSettings(), times, without, absent, std, absent), frame)
    assert again[150]
    np.testing.assert_array_equal(np.delete(again, 150), near)
