from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from builders import build_trial

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.plausibility.survey import Survey, survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.trial import Trial


def test_a_good_trial_has_no_problems() -> None:
    result = survey(build_trial())
    assert result.problems == ()
    assert {f.sensor for f in result.findings} == {"IMU", "GNSS", "DVL"}


def test_a_speed_ratio_is_not_taken_for_a_scale_error() -> None:
    (text,) = (
        f.text
        for f in survey(dvl_velocity(build_trial(), 1.093)).findings
        if "speed ratio" in f.text
    )
    assert "speed ratio 1.09 to the GNSS" in text
    for contributor in ("not a scale error", "lever arm", "sway"):
        assert contributor in text


def test_speeds_compare_where_there_are_fixes() -> None:
    """The vehicle goes faster where GNSS is lost."""
    trial = build_trial()
    gnss, dvl = trial.gnss, trial.dvl
    assert gnss is not None
    assert dvl is not None
    lost = (gnss.time > 10.0) & (gnss.time < 50.0)
    inside = (dvl.time > 11.0) & (dvl.time < 49.0)
    gone = replace(
        gnss,
        geodetic=np.where(lost[:, None], np.nan, gnss.geodetic),
        velocity=np.where(lost[:, None], np.nan, gnss.velocity),
    )
    fast = replace(dvl, velocity=dvl.velocity * np.where(inside, 1.5, 1.0)[:, None])
    assert not survey(replace(trial, gnss=gone, dvl=fast)).errors
    assert survey(replace(trial, dvl=fast)).errors


def test_a_fix_of_the_velocity_alone_is_a_measurement() -> None:
    trial = build_trial()
    nowhere = np.full_like(trial.gnss.geodetic, np.nan)
    found = survey(replace(trial, gnss=replace(trial.gnss, geodetic=nowhere)))
    assert Code.NO_MEASUREMENT not in [f.code for f in found.errors]


def test_rates_gaps_and_motion_are_those_of_the_record() -> None:
    trial = build_trial()
    velocity = trial.gnss.velocity.copy()
    velocity[np.isnan(trial.gnss.geodetic[:, 0])] = np.nan
    result = survey(replace(trial, gnss=replace(trial.gnss, velocity=velocity)))
    imu, gnss, dvl = result.sensors
    assert (imu.rate, imu.samples) == (pytest.approx(50.0), 3000)
    assert (gnss.rate, gnss.missing) == (pytest.approx(1.0), pytest.approx(1 / 60))
    assert (dvl.start, dvl.end, dvl.missing) == (0.75, 59.75, pytest.approx(1 / 60))
    assert result.duration == pytest.approx(59.98)
    assert result.distance == pytest.approx(118.0, abs=2.0)
    assert result.speed_max == pytest.approx(2.0)


def scaled_imu(trial: Trial, *, gyro: float = 1.0, accel: float = 1.0) -> Trial:
    imu = trial.imu
    return replace(trial, imu=replace(imu, gyro=imu.gyro * gyro, accel=imu.accel * accel))


def gnss_velocity(trial: Trial, change: Callable[[Array], Array]) -> Trial:
    assert trial.gnss is not None
    return replace(trial, gnss=replace(trial.gnss, velocity=change(trial.gnss.velocity)))


def dvl_velocity(trial: Trial, factor: float) -> Trial:
    assert trial.dvl is not None
    return replace(trial, dvl=replace(trial.dvl, velocity=trial.dvl.velocity * factor))


def cut(trial: Trial, begin: float, end: float) -> Trial:
    imu = trial.imu
    keep = (imu.time < begin) | (imu.time > end)
    imu = replace(imu, time=imu.time[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    return replace(trial, imu=imu)


def late_dvl(trial: Trial, by: float) -> Trial:
    assert trial.dvl is not None
    return replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + by))


def radians(trial: Trial) -> Trial:
    assert trial.gnss is not None
    factor = np.array([np.pi / 180.0, np.pi / 180.0, 1.0])
    return replace(trial, gnss=replace(trial.gnss, geodetic=trial.gnss.geodetic * factor))


def at_zero(trial: Trial) -> Trial:
    assert trial.gnss is not None
    geodetic = trial.gnss.geodetic.copy()
    geodetic[4] = 0.0
    return replace(trial, gnss=replace(trial.gnss, geodetic=geodetic))


def slow_clock(trial: Trial) -> Trial:
    return replace(trial, imu=replace(trial.imu, time=trial.imu.time * 1000.0))


def without_lock(trial: Trial, fraction: float) -> Trial:
    assert trial.dvl is not None
    velocity, std = trial.dvl.velocity.copy(), trial.dvl.std.copy()
    lost = np.arange(velocity.shape[0]) < fraction * velocity.shape[0]
    velocity[lost] = np.nan
    std[lost] = np.nan
    return replace(trial, dvl=replace(trial.dvl, velocity=velocity, std=std))


def noisy(trial: Trial) -> Trial:
    assert trial.dvl is not None
    return replace(trial, dvl=replace(trial.dvl, std=trial.dvl.std * 1000.0))


PROBLEMS: dict[str, tuple[Callable[[Trial], Trial], str, str]] = {
    "force in g": (lambda t: scaled_imu(t, accel=1 / 9.80665), "IMU", "looks like g;"),
    "force in ft/s2": (lambda t: scaled_imu(t, accel=1 / 0.3048), "IMU", "ft/s²"),
    "velocity increments": (lambda t: scaled_imu(t, accel=0.02), "IMU", "velocity increments"),
    "no gravity": (lambda t: scaled_imu(t, accel=0.03), "IMU", "was gravity removed"),
    "rate in deg/s": (lambda t: scaled_imu(t, gyro=180 / np.pi), "IMU", "deg/s"),
    "angle increments": (lambda t: scaled_imu(t, gyro=0.02), "IMU", "angle increments"),
    "opposite rate": (lambda t: scaled_imu(t, gyro=-1.0), "IMU", "opposite sign"),
    "no rate": (lambda t: scaled_imu(t, gyro=0.0), "IMU", "zero throughout"),
    "axes": (lambda t: replace(t, body_axes="FRD"), "IMU", "points along +z"),
    "gap": (lambda t: cut(t, 20.0, 25.0), "IMU", "1 gap"),
    "milliseconds": (slow_clock, "IMU", "milliseconds (50 Hz)"),
    "swapped": (
        lambda t: gnss_velocity(t, lambda v: v[:, [1, 0, 2]] * [1.0, 1.0, 1.0]),
        "GNSS",
        "east and north look swapped",
    ),
    "GNSS sign": (lambda t: gnss_velocity(t, lambda v: -v), "GNSS", "opposite sign"),
    "GNSS north": (lambda t: gnss_velocity(t, lambda v: v * [1, -1, 1]), "GNSS", "north velocity"),
    "GNSS knots": (lambda t: gnss_velocity(t, lambda v: v / 0.5144), "GNSS", "knots"),
    "GNSS km/h": (lambda t: gnss_velocity(t, lambda v: v * 3.6), "GNSS", "km/h"),
    "GNSS nonsense": (lambda t: gnss_velocity(t, lambda v: v * 1.5), "GNSS", "disagree"),
    "radians": (radians, "GNSS", "radians"),
    "at 0, 0": (at_zero, "GNSS", "0, 0"),
    "DVL knots": (lambda t: dvl_velocity(t, 1 / 0.5144), "DVL", "knots"),
    "DVL slow": (lambda t: dvl_velocity(t, 0.3), "DVL", "is it in m/s"),
    "DVL beams of 20 deg": (
        lambda t: dvl_velocity(t, np.sin(np.deg2rad(20)) / np.sin(np.deg2rad(30))),
        "DVL",
        "look 20 deg from the vertical, and 30 deg were assumed",
    ),
    "DVL beams of 30 deg": (
        lambda t: dvl_velocity(t, np.sin(np.deg2rad(30)) / np.sin(np.deg2rad(25))),
        "DVL",
        "look 30 deg from the vertical, and 25 deg were assumed",
    ),
    "DVL beams of 25 deg": (
        lambda t: dvl_velocity(t, np.sin(np.deg2rad(25)) / np.sin(np.deg2rad(30))),
        "DVL",
        "look 25 deg from the vertical, and 30 deg were assumed",
    ),
    "DVL sign": (lambda t: dvl_velocity(t, -1.0), "DVL", "PD0"),
    "DVL clock": (lambda t: late_dvl(t, 1e6), "DVL", "do not overlap"),
    "DVL late": (lambda t: late_dvl(t, 40.0), "DVL", "outside that of the IMU"),
    "DVL lock": (lambda t: without_lock(t, 0.7), "DVL", "contain no measurement"),
    "no lock": (lambda t: without_lock(t, 2.0), "DVL", "no ping with a lock"),
    "noisy": (noisy, "DVL", "standard deviation"),
}


@pytest.mark.parametrize("case", PROBLEMS)
def test_a_mistake_is_found_and_explained(case: str) -> None:
    spoil, sensor, text = PROBLEMS[case]
    result = survey(spoil(build_trial()))
    assert any(text in f.text for f in result.problems if f.sensor == sensor), result.problems


def test_fixes_that_jump_are_no_unit_of_the_velocity() -> None:
    """Half of the intervals between fixes have one that jumps at either end."""
    trial = build_trial()
    gnss = trial.gnss
    assert gnss is not None
    rng = np.random.default_rng(1)
    jumps = 1e-6 * rng.uniform(1.0, 5.0, gnss.time.size) * (rng.uniform(size=gnss.time.size) < 0.3)
    spoilt = replace(gnss, geodetic=gnss.geodetic + np.outer(jumps, [1.0, -1.0, 0.0]))
    found = survey(replace(trial, gnss=spoilt)).findings
    assert not [f for f in found if f.code == Code.GNSS_VELOCITY and f.severity == "error"]
    knots = gnss_velocity(replace(trial, gnss=spoilt), lambda v: v / 0.5144)
    assert [f.code for f in survey(knots).problems if f.sensor == "GNSS"] == [Code.GNSS_VELOCITY]


def test_a_down_velocity_is_found() -> None:
    trial = build_trial()
    gnss = trial.gnss
    assert gnss is not None
    climb = np.array([0.0, 0.0, 1.0]) * (0.5 * gnss.time)[:, None]
    velocity = gnss.velocity - [0.0, 0.0, 0.5]
    spoilt = replace(gnss, geodetic=gnss.geodetic + climb, velocity=velocity)
    assert "vel_u_m_s" in survey(replace(trial, gnss=spoilt)).problems[0].text


def test_the_sign_is_not_judged_where_the_mounting_is_unknown() -> None:
    trial = dvl_velocity(build_trial(), -1.0)
    assert trial.dvl is not None
    settings = msgspec.structs.replace(
        trial.dvl.settings, misalignment_std_deg=(180.0, 180.0, 180.0)
    )
    trial = replace(trial, dvl=replace(trial.dvl, settings=settings))
    assert survey(trial).problems == ()


@pytest.mark.parametrize(
    ("angle", "text", "severity"),
    [
        (20.0, "20 deg to starboard of the bow", "ok"),
        (-47.0, "47 deg to port of the bow", "note"),
    ],
)
def test_where_the_vehicle_moves_by_the_prior_is_told(
    angle: float, text: str, severity: str
) -> None:
    """A DVL that is turned to port sees the vehicle move to starboard."""
    trial = build_trial()
    assert trial.dvl is not None
    # The body's z points up, so that a positive angle is one to port.
    velocity = trial.dvl.velocity @ exp_so3(np.array([0.0, 0.0, np.deg2rad(angle)]))
    found = survey(replace(trial, dvl=replace(trial.dvl, velocity=velocity))).findings
    (sign,) = (f for f in found if f.code == Code.DVL_SIGN)
    assert text in sign.text
    assert sign.severity == severity


def first(trial: Trial, n: int) -> Trial:
    imu, gnss, dvl = trial.imu, trial.gnss, trial.dvl
    assert gnss is not None
    assert dvl is not None
    return replace(
        trial,
        imu=replace(imu, time=imu.time[:n], gyro=imu.gyro[:n], accel=imu.accel[:n]),
        gnss=replace(
            gnss,
            time=gnss.time[:n],
            geodetic=gnss.geodetic[:n],
            velocity=gnss.velocity[:n],
            position_std=gnss.position_std[:n],
            velocity_std=gnss.velocity_std[:n],
        ),
        dvl=replace(dvl, time=dvl.time[:n], velocity=dvl.velocity[:n], std=dvl.std[:n]),
    )


@pytest.mark.parametrize(
    "shorten",
    [
        lambda t: replace(t, gnss=None, dvl=None),
        lambda t: replace(t, gnss=None),
        lambda t: replace(t, dvl=None),
        lambda t: gnss_velocity(t, lambda v: v * np.nan),
        lambda t: first(t, 1),
        lambda t: first(t, 2),
        lambda t: first(t, 5),
    ],
)
def test_sparse_trials_are_surveyed(shorten: Callable[[Trial], Trial]) -> None:
    result = survey(shorten(build_trial()))
    assert isinstance(result, Survey)
    assert result.sensors[0].label == "IMU"
