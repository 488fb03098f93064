"""Motion that instruments report: an INS, or GNSS with a compass, in place of SINS/GNSS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.earth import radii
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, longest_gap
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.trial import Trial

# Span, s, of the difference of positions that stands for a velocity that is not reported. Chosen:
# that of the SINS/GNSS filter.
_BASELINE = 5.0


@dataclass(frozen=True)
class RecordedNavigation:
    """Motion of the body as instruments report it, with the errors that they state.

    Parameters
    ----------
    time : ndarray, shape (K,), s
        Times of the positions.
    geodetic, velocity : ndarray, shape (K, 3)
        Position and velocity of the body: latitude, longitude (rad), height (m); east, north, up,
        m/s.
    std : ndarray, shape (K, 9)
        Standard deviations of position, velocity, and attitude: m, m/s, rad.
    attitude : AttitudeRecord
        How the body points.
    late : float
        Time offset of the stamps of the attitude, s.
    findings : tuple of Finding
        What the user must know.
    """

    time: Array
    geodetic: Array
    velocity: Array
    std: Array
    attitude: AttitudeRecord
    late: float
    findings: tuple[Finding, ...]

    def at(self, time: Array) -> NavigationMotion:
        """Return the motion at times (M,), by cubics between the records."""
        stamp = time + self.late
        level = np.broadcast_to(np.eye(3), (time.size, 3, 3))
        inside = np.clip(stamp, self.attitude.time[0], self.attitude.time[-1])
        body = self.attitude.at(inside, np.zeros((time.size, 3)), level)
        within = np.clip(time, self.time[0], self.time[-1])
        both = CubicSpline(self.time, np.hstack([self.geodetic, self.velocity]))(within)
        geodetic, velocity = both[:, :3], both[:, 3:]
        after = np.clip(np.searchsorted(self.time, within), 1, self.time.size - 1)
        near = self.time[after] - self.time[after - 1] <= longest_gap(self.time)
        covered = (time == within) & near
        P = np.square(self.std[after])[:, :, None] * np.eye(9)
        return NavigationMotion(
            time=time,
            geodetic=geodetic,
            velocity=velocity,
            nRb=body.nRb,
            covariance=P,
            omega_b=body.omega_eb_b,
            omega_sigma=body.omega_sigma,
            covered=covered & self.attitude.covers(stamp),
        )

    def ticks(self, rate_hz: float) -> Array:
        """Return the multiples of 1 / rate within the record."""
        return np.arange(np.ceil(self.time[0] * rate_hz),
                         np.floor(self.time[-1] * rate_hz) + 1.0) / rate_hz  # fmt: skip


def recorded_navigation(trial: Trial) -> RecordedNavigation:
    """Return the motion that an INS reports, or GNSS with a sensor of attitude.

    Parameters
    ----------
    trial : Trial
        Trial without IMU; GNSS by the clock of the trial.

    Raises
    ------
    ConfigError, DataError
        If nothing measures position and attitude.
    """
    sensor, ins = trial.attitude, trial.find(Ins)
    source: Gnss | Ins | None = ins or trial.gnss
    if sensor is None or source is None:
        raise ConfigError(
            "nothing measures position and attitude",
            where="trial.yaml",
            expected="an imu section, or `ins`, or `attitude` beside `gnss`",
        )
    known = ~np.isnan(source.geodetic[:, 0])
    if known.sum() < 5:
        raise DataError(f"{known.sum()} positions", where=source.source, expected="five or more")
    attitude = AttitudeRecord(sensor, trial.body_axes, estimated=trial.estimates_noise(sensor))
    late = sensor.settings.time_offset_s
    time = source.time[known]
    if isinstance(source, Ins):
        time = time - source.settings.time_offset_s
    nRb = rotation_from_rph(attitude.rph_at(time + late), trial.body_axes)
    arm = nRb @ np.array(source.settings.lever_arm_m)
    geodetic = source.geodetic[known].copy()
    geodetic[:, 1] = np.unwrap(geodetic[:, 1])
    meridian, east = radii(geodetic[:, 0])
    metres = np.stack([meridian + geodetic[:, 2],
                       (east + geodetic[:, 2]) * np.cos(geodetic[:, 0]),
                       np.ones(time.size)], axis=1)  # fmt: skip
    geodetic -= arm[:, [1, 0, 2]] / metres
    position_std, velocity_std = _stated(source, known)
    velocity = source.velocity[known]
    if np.isnan(velocity).any():
        half = max(1, round(0.5 * _BASELINE / float(np.median(np.diff(time)))))
        before = np.maximum(np.arange(time.size) - half, 0)
        after = np.minimum(np.arange(time.size) + half, time.size - 1)
        span = (time[after] - time[before])[:, None]
        velocity = ((geodetic[after] - geodetic[before]) * metres / span)[:, [1, 0, 2]]
        velocity_std = np.sqrt(2.0) * position_std / span
    else:
        velocity = velocity - CubicSpline(time, arm)(time, 1)
    error = sensor.error
    angles = np.broadcast_to(np.hypot(error.sigma, error.white), (time.size, 3))
    std = np.hstack([position_std, velocity_std, angles])
    return RecordedNavigation(time, geodetic, velocity, std, attitude, late, trial.notes)


def _stated(source: Gnss | Ins, known: np.ndarray) -> tuple[Array, Array]:
    """Return the standard deviations of positions and velocities, (K, 3) each, m and m/s."""
    if isinstance(source, Ins):
        total = source.total_std[known]
        return total[:, :3], total[:, 3:6]
    return source.position_std[known], source.velocity_std[known]
