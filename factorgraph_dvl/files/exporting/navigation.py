"""SBET and NMEA 0183, for hydrographic software."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorgraph_dvl.files.exporting.trajectories import ExportedMotion
from factorgraph_dvl.files.formats.clocks import GPS_EPOCH, utc_to_gps
from factorgraph_dvl.files.formats.sbet import SBET, SMRMSG
from factorgraph_dvl.geometry.rotations import frd_from_body, rotation_from_rph
from factorgraph_dvl.geometry.units import DAY, DEG, KNOT
from factorgraph_dvl.geometry.vectors import Array

# Of a position that is estimated and not measured, in GGA.
_ESTIMATED = 6


def write_sbet(motion: ExportedMotion, path: Path) -> None:
    """Write the trajectory as SBET, wander angle zero, times in GPS seconds of the week.

    Rates and accelerations are derivatives of attitude and velocity in forward, starboard, down,
    as the trajectory resolves them; gravity is not in them. Standard deviations go into a file
    of the same name and the suffix `.smrmsg`.
    """
    t = motion.trajectory
    second = _seconds_of_week(motion.known_utc("SBET"))
    frd = frd_from_body(motion.body_axes)
    nRb = rotation_from_rph(t.rph, motion.body_axes)
    bRn = frd @ np.swapaxes(nRb, 1, 2)
    acceleration = (bRn @ np.gradient(t.velocity, t.time, axis=0)[:, :, None])[:, :, 0]
    out = np.zeros(t.time.size, SBET)
    out["second"] = second
    out["lat"], out["lon"], out["height"] = t.geodetic.T
    out["vel_x"], out["vel_y"], out["vel_z"] = (
        t.velocity[:, 1],
        t.velocity[:, 0],
        -t.velocity[:, 2],
    )
    out["roll"], out["pitch"] = t.rph[:, 0], t.rph[:, 1]
    out["heading"] = t.rph[:, 2] % (2.0 * np.pi)
    out["accel_x"], out["accel_y"], out["accel_z"] = acceleration.T
    out["rate_x"], out["rate_y"], out["rate_z"] = _rates(t.time, t.rph).T
    path.write_bytes(out.tobytes())
    errors = np.zeros(t.time.size, SMRMSG)
    errors["second"] = second
    east, north, up = t.position_std.T
    errors["std_n"], errors["std_e"], errors["std_d"] = north, east, up
    east, north, up = t.velocity_std.T
    errors["vel_std_n"], errors["vel_std_e"], errors["vel_std_d"] = north, east, up
    minutes = t.rph_std / (DEG / 60.0)
    errors["roll_std"], errors["pitch_std"], errors["heading_std"] = minutes.T
    path.with_suffix(".smrmsg").write_bytes(errors.tobytes())


def _rates(time: Array, rph: Array) -> Array:
    """Return angular rates (M, 3) in forward, starboard, down from roll, pitch, heading."""
    roll, pitch, _ = rph.T
    d_roll, d_pitch, d_heading = np.gradient(np.unwrap(rph, axis=0), time, axis=0).T
    return np.stack(
        [
            d_roll - d_heading * np.sin(pitch),
            d_pitch * np.cos(roll) + d_heading * np.sin(roll) * np.cos(pitch),
            -d_pitch * np.sin(roll) + d_heading * np.cos(roll) * np.cos(pitch),
        ],
        axis=1,
    )


def _seconds_of_week(utc: Array) -> Array:
    """Return GPS seconds of the week of the first epoch; they count on past its end."""
    gps = utc_to_gps(utc) - GPS_EPOCH
    return np.asarray(gps - np.floor(gps[0] / (7.0 * DAY)) * 7.0 * DAY)


def write_nmea(motion: ExportedMotion, path: Path) -> None:
    """Write ZDA, GGA, GST, VTG and HDT of every epoch, talker IN.

    Heights of GGA are above the ellipsoid, with a separation of zero.
    """
    t = motion.trajectory
    utc = np.round(motion.known_utc("NMEA"), 2)
    milliseconds = np.round(utc * 1e3).astype("datetime64[ms]")
    lines = []
    course = np.arctan2(t.velocity[:, 0], t.velocity[:, 1]) / DEG % 360.0
    speed = np.linalg.norm(t.velocity[:, :2], axis=1)
    heading = t.rph[:, 2] / DEG % 360.0
    for k, text in enumerate(np.datetime_as_string(milliseconds).tolist()):
        date, clock = text.split("T")
        year, month, day = date.split("-")
        at = clock.replace(":", "")[:9]
        east, north, up = t.position_std[k]
        major, minor, bearing = _ellipse(t.position_cov[k, :2, :2])
        lines += [
            f"INZDA,{at},{day},{month},{year},00,00",
            f"INGGA,{at},{_angle(t.geodetic[k, 0], 2, 'NS')},{_angle(t.geodetic[k, 1], 3, 'EW')},"
            f"{_ESTIMATED},00,,{t.geodetic[k, 2]:.3f},M,0.000,M,,",
            f"INGST,{at},,{major:.3f},{minor:.3f},{bearing:.1f},{north:.3f},{east:.3f},{up:.3f}",
            f"INVTG,{course[k]:.2f},T,,M,{speed[k] / KNOT:.3f},N,{speed[k] * 3.6:.3f},K,D",
            f"INHDT,{heading[k]:.3f},T",
        ]
    path.write_text("".join(map(_sentence, lines)), encoding="ascii", newline="")


def _angle(angle: float, digits: int, signs: str) -> str:
    """Return an angle, rad, as degrees and minutes, with its hemisphere."""
    total = round(abs(angle) / DEG * 60.0, 7)
    degrees = int(total // 60.0)
    return f"{degrees:0{digits}d}{total - 60.0 * degrees:010.7f},{signs[int(angle < 0.0)]}"


def _ellipse(covariance: Array) -> tuple[float, float, float]:
    """Return semi-axes, m, of the error ellipse, and the bearing of the larger, deg."""
    variance, axes = np.linalg.eigh(covariance)
    east, north = axes[:, 1]
    minor, major = np.sqrt(np.maximum(variance, 0.0))
    return float(major), float(minor), float(np.arctan2(east, north) / DEG % 180.0)


def _sentence(body: str) -> str:
    checksum = 0
    for character in body.encode("ascii"):
        checksum ^= character
    return f"${body}*{checksum:02X}\r\n"
