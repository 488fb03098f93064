"""The faults whose effect is measured, and the trials that they are made in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import config

from factorgraph_dvl.simulation import faults as f
from factorgraph_dvl.simulation import instrument_faults as g

KNOTS = 0.514444
I3 = np.eye(3)
SWAP_XY = I3[[1, 0, 2]]


def mirror(axis: int) -> np.ndarray:
    """Return the matrix that inverts an axis."""
    return np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))


@dataclass(frozen=True)
class Row:
    """A fault at several levels, and what names it.

    `named` are patterns, one of which must be found in `code sensor parameter: text` of the first
    reason, case ignored.
    """

    name: str
    unit: str
    levels: tuple[Any, ...]
    make: Callable[[Any], list[f.Fault]]
    named: tuple[str, ...]


def imu_errors(**matrices: np.ndarray) -> list[f.Fault]:
    """Return errors of the IMU; those that are not given are zero."""
    zero = np.zeros((3, 3))
    of = {name: matrices.get(name, zero).tolist() for name in ("gyro", "g_sensitivity", "accel")}
    return [f.imu_errors(of["gyro"], of["g_sensitivity"], of["accel"])]


def turned(section: str, matrix: np.ndarray, *fields: str) -> list[f.Fault]:
    """Return axes that are multiplied by a matrix."""
    return [f.axes_changed(section, np.asarray(matrix).tolist(), *fields)]


# Words for what is found in a record, or in its residuals, of a sensor.
GROSS = "outliers|many_rejected|invalid_values|frozen_values|does_not_fit|large_residuals|noise_"


def gross(sensor: str) -> str:
    """Return the pattern of gross errors of a sensor."""
    return rf"^({GROSS})\w* {sensor}"


def clock(section: str, kind: str) -> tuple[str, ...]:
    """Return the patterns that name a clock."""
    sensor = {"imu": r"\w+"}.get(section, section)
    parameter = r"(\w+_)?" if section == "imu" else ("" if section == "dvl" else f"{section}_")
    freed = rf"^(estimated_instead|unexplained_misfit|far_from_prior)[^:]*{parameter}time_offset"
    if kind == "rate":
        freed = rf"^(estimated_instead|unexplained_misfit)[^:]*{section}_clock_rate"
        return (rf"^clock_drift {sensor}", freed)
    if kind == "step":
        # With measurements before and after alone, a clock that drifts by as much is the same.
        drifts = rf"^estimated_instead.*{section}_clock_rate"
        return (rf"^clock_step {sensor}", r"^changed_along_trial[^:]*time_offset", drifts)
    return (rf"^(clock_offset|leap_seconds|local_time|no_overlap) {sensor}", freed)


ROWS = (
    Row(
        "DVL: outliers", "share", (0.02, 0.1, 0.3), lambda x: [f.dvl_outliers(x)], (gross("DVL"),)
    ),
    Row(
        "GNSS: outliers",
        "share",
        (0.02, 0.1, 0.3),
        lambda x: [f.gnss_outliers(x)],
        (gross("GNSS"),),
    ),
    Row(
        "GNSS: jumps of 30 s",
        "m",
        (2.0, 10.0, 50.0),
        lambda x: [f.gnss_jumps(x)],
        (gross("GNSS"),),
    ),
    Row(
        "DVL: false lock for 60 s",
        "m/s",
        (0.05, 0.3, 1.0),
        lambda x: [f.dvl_false_lock(x)],
        (gross("DVL"), r"water_current", r"^changed_along_trial[^:]*(dvl|scale|misalignment)"),
    ),
    Row(
        "DVL: layer of water for 60 s",
        "m/s",
        (0.1, 0.5),
        lambda x: [f.dvl_water_track((0.8 * x, 0.6 * x, 0.0))],
        (r"water_current", gross("DVL"), r"^changed_along_trial[^:]*(dvl|scale|misalignment)"),
    ),
    Row("DVL: frozen", "s", (5.0, 30.0, 120.0), lambda x: [f.frozen("dvl", x)], (gross("DVL"),)),
    Row(
        "GNSS: fixes frozen",
        "s",
        (5.0, 30.0),
        lambda x: [f.frozen("gnss", x, "geodetic")],
        (gross("GNSS"),),
    ),
    Row(
        "IMU: gyros frozen",
        "s",
        (0.1, 1.0, 10.0),
        lambda x: [f.frozen("imu", x, "gyro")],
        (r"^(frozen_values|imu_channel) IMU",),
    ),
    Row("DVL: zero fills", "share", (0.02, 0.5), lambda x: [f.filled("dvl", x)], (gross("DVL"),)),
    Row(
        "DVL: -32.768 fills",
        "share",
        (0.1,),
        lambda x: [f.filled("dvl", x, -32.768)],
        (gross("DVL"),),
    ),
    Row(
        "DVL: axis stuck",
        "axis",
        (0, 2),
        lambda x: [f.stuck("dvl", x)],
        (r"^(dvl_frozen|frozen_values|dvl_channel) DVL",),
    ),
    Row(
        "IMU: gyro stuck",
        "axis",
        (0, 2),
        lambda x: [f.stuck("imu", x, "gyro")],
        (r"^(imu_channel|gyro_frozen|frozen_values) IMU",),
    ),
    Row(
        "IMU: gyros saturated",
        "deg/s",
        (20.0, 35.0, 45.0),
        lambda x: [f.saturated(gyro_rad_s=np.radians(x))],
        (r"^(saturated|frozen_values) IMU",),
    ),
    Row(
        "IMU: accelerometers saturated",
        "m/s²",
        (9.75, 9.85),
        lambda x: [f.saturated(accel_m_s2=x)],
        (r"^(saturated|frozen_values|imu_channel) IMU",),
    ),
    Row(
        "GNSS: late",
        "s",
        (0.02, 0.3, 3.0, 18.0),
        lambda x: [f.late("gnss", x)],
        clock("gnss", "offset"),
    ),
    Row("DVL: late", "s", (0.02, 0.3, 3.0), lambda x: [f.late("dvl", x)], clock("dvl", "offset")),
    Row("IMU: late", "s", (0.3, 2.0), lambda x: [f.late("imu", x)], clock("imu", "offset")),
    Row(
        "GNSS: clock fast",
        "ppm",
        (100.0, 1000.0),
        lambda x: [f.clock_rate("gnss", x)],
        clock("gnss", "rate"),
    ),
    Row(
        "DVL: clock fast",
        "ppm",
        (30.0, 1000.0),
        lambda x: [f.clock_rate("dvl", x)],
        clock("dvl", "rate"),
    ),
    Row(
        "GNSS: clock jumps",
        "s",
        (0.1, 1.0),
        lambda x: [f.clock_step("gnss", x)],
        clock("gnss", "step"),
    ),
    Row(
        "DVL: clock jumps",
        "s",
        (0.02, 0.1, 1.0),
        lambda x: [f.clock_step("dvl", x)],
        clock("dvl", "step"),
    ),
    Row("DVL: jitter", "s", (0.01, 0.1), lambda x: [f.jitter("dvl", x)], (gross("DVL"),)),
    Row("GNSS: jitter", "s", (0.05, 0.2), lambda x: [f.jitter("gnss", x)], (gross("GNSS"),)),
    Row("IMU: jitter", "s", (0.001, 0.005), lambda x: [f.jitter("imu", x)], (r"IMU",)),
    Row(
        "DVL: unit",
        "m/s",
        (0.01, KNOTS),
        lambda x: turned("dvl", I3 / x),
        (r"^dvl_unit DVL", r"in cm/s"),
    ),
    Row(
        "IMU: gyros in deg/s",
        "",
        (1,),
        lambda x: turned("imu", np.degrees(I3), "gyro"),
        (r"^gyro_unit IMU.*deg/s|outside the physical",),
    ),
    Row(
        "IMU: force in g",
        "",
        (1,),
        lambda x: turned("imu", I3 / 9.80665, "accel"),
        (r"^force_unit IMU",),
    ),
    Row(
        "GNSS: velocity in knots",
        "",
        (1,),
        lambda x: turned("gnss", I3 / KNOTS),
        (r"^gnss_velocity GNSS.*knots",),
    ),
    Row(
        "DVL: signs of PD0", "", (1,), lambda x: turned("dvl", -I3), (r"^dvl_axes DVL.*all three",)
    ),
    Row(
        "DVL: axis mirrored",
        "axis",
        (0, 1, 2),
        lambda x: turned("dvl", mirror(x)),
        (r"^dvl_axes DVL",),
    ),
    Row(
        "IMU: axis mirrored",
        "axis",
        (0, 1, 2),
        lambda x: turned("imu", mirror(x)),
        (r"^(imu_axes|body_axes) IMU",),
    ),
    Row(
        "IMU: gyro mirrored",
        "axis",
        (0, 2),
        lambda x: turned("imu", mirror(x), "gyro"),
        (r"^gyro_axes IMU.*axis {axis} is mirrored",),
    ),
    Row(
        "IMU: accelerometer mirrored",
        "axis",
        (0, 1),
        lambda x: turned("imu", mirror(x), "accel"),
        (r"^accel_axes IMU.*axis {axis} is mirrored", r"^gyro_unit IMU.*axis {axis} of the accel"),
    ),
    Row(
        "GNSS: vertical velocity downwards",
        "",
        (1,),
        lambda x: turned("gnss", mirror(2)),
        (r"^(gnss_axes|gnss_velocity) GNSS",),
    ),
    Row("DVL: x and y swapped", "", (1,), lambda x: turned("dvl", SWAP_XY), (r"^dvl_axes DVL",)),
    Row(
        "IMU: x and y swapped",
        "",
        (1,),
        lambda x: turned("imu", SWAP_XY),
        (r"^imu_axes IMU.*swapped",),
    ),
    Row(
        "IMU: x and y of the gyros swapped",
        "",
        (1,),
        lambda x: turned("imu", SWAP_XY, "gyro"),
        (r"^gyro_axes IMU.*swapped",),
    ),
    Row(
        "GNSS: east and north velocity swapped",
        "",
        (1,),
        lambda x: turned("gnss", SWAP_XY),
        (r"^(gnss_velocity|gnss_axes) GNSS.*swapped",),
    ),
    Row(
        "GNSS: latitude and longitude swapped",
        "",
        (1,),
        lambda x: [f.fixes_swapped()],
        (r"swapped|lat_deg|latitude",),
    ),
    Row(
        "body_axes misstated",
        "",
        ("FLU", "FRD"),
        lambda x: [f.body_axes_misstated(x)],
        (r"^(course|body_axes)",),
    ),
    Row(
        "GNSS: datum",
        "m",
        ((0.0, 0.0, 20.0), (100.0, 50.0, 0.0)),
        lambda x: [f.datum(x)],
        (r"datum|GNSS|Depth",),
    ),
    Row(
        "DVL: scale walks",
        "1/√h",
        (0.003, 0.03),
        lambda x: [f.dvl_scale_walk(x)],
        (
            gross("DVL"),
            r"^(changed_along_trial|halves_differ)[^:]*scale",
            r"^estimated_instead DVL velocity scale_error",
        ),
    ),
    Row(
        "DVL: scale drifts",
        "",
        (0.002, 0.01),
        lambda x: [f.dvl_scale_drift(x)],
        (gross("DVL"), r"^changed_along_trial[^:]*scale", r"dvl_scale_by_time"),
    ),
    Row(
        "IMU: gyro bias walks",
        "deg/h/√h",
        (0.5, 10.0),
        lambda x: [f.imu_bias_walk(x)],
        (r"gyro|IMU",),
    ),
    Row(
        "IMU: accelerometer bias walks",
        "µg/√h",
        (100.0, 2000.0),
        lambda x: [f.imu_bias_walk(0.0, x)],
        (r"accel|IMU",),
    ),
    Row(
        "GNSS: position wanders",
        "m",
        (0.5, 3.0),
        lambda x: [f.correlated_gnss((x, x, 1.5 * x))],
        (gross("GNSS"), r"GNSS position"),
    ),
    Row(
        "GNSS: velocity wanders",
        "m/s",
        (0.1, 0.5),
        lambda x: [f.correlated_gnss(velocity_std_m_s=(x, x, x))],
        (gross("GNSS"), r"GNSS velocity"),
    ),
    Row(
        "DVL: velocity wanders",
        "m/s",
        (0.005, 0.05),
        lambda x: [f.correlated_dvl(x)],
        (gross("DVL"),),
    ),
    Row(
        "GNSS: antenna misstated",
        "m",
        (0.1, 0.5, 2.0),
        lambda x: [f.wrong_antenna((x, 0.0, 0.0))],
        (r"^antenna GNSS", r"gnss_lever_arm"),
    ),
    Row(
        "DVL: bias",
        "m/s",
        (0.004, 0.02, 0.1),
        lambda x: [f.dvl_bias((0.7 * x, -0.6 * x, 0.4 * x))],
        (r"dvl_bias",),
    ),
    Row(
        "DVL: slips in its mount",
        "deg",
        (0.05, 0.3, 2.0),
        lambda x: [f.dvl_slipped((0.0, 0.0, x))],
        (r"^changed_along_trial[^:]*(misalignment)",),
    ),
    Row(
        "IMU: sampling misstated",
        "",
        (1,),
        lambda x: [f.sampling_misstated()],
        (r"sampling|late|early|time_offset|clock_offset",),
    ),
    Row(
        "IMU: spikes",
        "share",
        (0.0001, 0.01),
        lambda x: [f.imu_spikes(x)],
        (r"^imu_(noise|spikes) IMU",),
    ),
    Row(
        "IMU: gyro scale",
        "ppm",
        (300.0, 10000.0),
        lambda x: imu_errors(gyro=1e-6 * x * I3),
        (r"gyro_scale|gyro|IMU",),
    ),
    Row(
        "IMU: accelerometer axes",
        "deg",
        (0.02, 0.2),
        lambda x: imu_errors(accel=np.tril(np.full((3, 3), np.radians(x)), -1)),
        (r"accel|IMU",),
    ),
    Row(
        "DVL: scale differs by axis",
        "share",
        (0.001, 0.005),
        lambda x: turned("dvl", np.diag([1.0 + x, 1.0 - x, 1.0])),
        (r"dvl_scale_difference",),
    ),
    Row(
        "DVL: x and y not orthogonal",
        "deg",
        (0.1, 0.5),
        lambda x: turned("dvl", I3 + np.radians(x) * np.outer(I3[1], I3[0])),
        (r"dvl_axes",),
    ),
    Row(
        "DVL: mount flexes with roll",
        "deg/deg",
        (0.01, 0.033),
        lambda x: [g.dvl_flexes((0.0, 0.0, x))],
        (r"dvl_flex",),
    ),
    Row(
        "DVL: takes roll and pitch out",
        "share",
        (1.0,),
        lambda x: [g.dvl_levelled(x)],
        (r"dvl_flex_by_tilt",),
    ),
    Row(
        "DVL: sound speed varies with place",
        "share",
        (0.0005, 0.002),
        lambda x: [g.dvl_slow_water(x, 800.0)],
        (r"scale_error|dvl_scale_by_place",),
    ),
    Row(
        "DVL: scale grows with speed",
        "s/m",
        (0.0005, 0.002),
        lambda x: [g.dvl_scale_by_speed(x)],
        (r"dvl_scale_by_speed",),
    ),
    Row(
        "DVL: measures against water",
        "m/s",
        (0.03, 0.1),
        lambda x: [f.dvl_water_track((x, 0.0, 0.0), np.inf)],
        (r"current",),
    ),
    Row(
        "DVL: digits cut off",
        "m/s",
        (0.002, 0.01),
        lambda x: [g.truncated("dvl", x)],
        (gross("DVL"), r"dvl_truncation"),
    ),
    Row(
        "IMU: a gyro bias changes at once",
        "deg/h",
        (0.5, 5.0),
        lambda x: [f.imu_bias_step((x, 0.0, 0.0), (0.0, 0.0, 0.0), 0.4)],
        (r"^(changed_along_trial|estimated_instead|far_from_prior)[^:]*(gyro|accel)_bias",),
    ),
    Row(
        "IMU: an accelerometer bias changes at once",
        "µg",
        (100.0, 1000.0),
        lambda x: [f.imu_bias_step((0.0, 0.0, 0.0), (x, 0.0, 0.0), 0.4)],
        (r"^(changed_along_trial|estimated_instead|far_from_prior)[^:]*(gyro|accel)_bias",),
    ),
    Row(
        "DVL: constant noise",
        "m/s",
        (0.004, 0.01),
        lambda x: [g.dvl_noise(x)],
        (r"^(large_residuals|noise)\w* DVL",),
    ),
    Row(
        "DVL: values written again",
        "times",
        (2, 5),
        lambda x: [g.written_again("dvl", x)],
        (r"^invalid_values DVL",),
    ),
    Row("DVL: averages", "s", (1.0, 3.0), lambda x: [g.dvl_averages(x)], (r"averaging",)),
    Row(
        "DVL: delay rises and falls back in 10 s",
        "s",
        (0.05, 0.2),
        lambda x: [g.saw_of_delays("dvl", x)],
        (r"dvl_sawtooth_delay",),
    ),
    Row(
        "GNSS: delay rises and falls back in 10 s",
        "s",
        (0.2, 0.5),
        lambda x: [g.saw_of_delays("gnss", x)],
        (r"gnss_sawtooth_delay",),
    ),
    Row(
        "Compass: deviates",
        "deg",
        (1.0, 3.0),
        lambda x: [g.compass_deviates((x, 0.5 * x, 0.3 * x, 0.2 * x))],
        (r"compass_deviation",),
    ),
    Row(
        "DVL: layer of water for a third",
        "m/s",
        (0.1, 0.3),
        lambda x: [f.dvl_water_track((0.8 * x, 0.6 * x, 0.0), share=1 / 3)],
        (r"water_current", gross("DVL")),
    ),
    Row("IMU: gyros late", "s", (0.002, 0.01), lambda x: [g.gyros_late(x)], (r"gyro_delay",)),
    Row("IMU: gyros filtered", "s", (0.005, 0.03), lambda x: [g.gyros_lag(x)], (r"gyro_delay",)),
)


def seed_a() -> dict[str, Any]:
    """Return the scenario of seed A, with clocks, antenna and bias as a user leaves them."""
    out: dict[str, Any] = config("seed-a-phase-90")
    out["trial"] = {"imu": out["trial"]["imu"], "dvl": {"velocity_std_m_s": 0.001}}
    return out


def cruise() -> dict[str, Any]:
    """Return a quarter of an hour of the cruise."""
    out: dict[str, Any] = config("cruise")
    drift, accelerate, legs, *_ = out["manoeuvres"]
    out["manoeuvres"] = [drift, accelerate, *legs["manoeuvres"]]
    out["trial"] = {"imu": out["trial"]["imu"]}
    return out


def dive() -> dict[str, Any]:
    """Return a dive of ten minutes below."""
    out: dict[str, Any] = config("dive")
    legs = next(m for m in out["manoeuvres"] if "repeat" in m)
    legs["repeat"] = 1
    out["gnss"]["outages_s"] = [[305, 1080]]
    del out["dvl"]["no_lock_s"]
    out["trial"] = {}
    return out


SCENARIOS = {"seed A": seed_a, "cruise": cruise, "dive": dive}
# What they are, on the page.
MOTIONS = {
    "seed A": "`configs/seed-a-phase-90.yaml`, 450 s",
    "cruise": "the first quarter of an hour of `configs/cruise.yaml`",
    "dive": "`configs/dive.yaml` with ten minutes below",
}
