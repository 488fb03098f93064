"""Position and velocity at any time from GNSS or an INS alone, to start from without an IMU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.ins import Ins

# Least span, s, over which positions make a velocity, and the standard deviation, m/s, that it
# should have. Chosen: the span averages waves, and a ping has such noise. With noise of 0.25 m/s,
# from positions of 1 m over 5 s, clocks 1 s off fitted pings through water better than right ones.
_SPAN = 5.0
_VELOCITY_STD = 0.05
# Gap, s, beyond which nothing is known of the motion. Chosen: a ship turns in it.
_GAP = 15.0


@dataclass(frozen=True)
class Track:
    """Positions (M, 3), m, and velocities (M, 3), m/s, in n at times (M,), s."""

    time: Array
    p_n: Array
    v_n: Array

    def at(self, time: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return position and velocity at times (K,), and where they are known."""
        after = np.clip(np.searchsorted(self.time, time), 1, self.time.size - 1)
        known = self.time[after] - self.time[after - 1] < _GAP
        known &= (time >= self.time[0]) & (time <= self.time[-1])
        return (
            interpolate(time, self.time, self.p_n),
            interpolate(time, self.time, self.v_n),
            np.asarray(known),
        )


def track_of(sensor: Gnss | Ins, frame: LocalFrame, longest: float) -> Track:
    """Return the track of an antenna or an INS: what it measured, smoothed over seconds.

    Raises
    ------
    DataError
        If there are fewer than three positions.
    """
    known = ~np.isnan(sensor.geodetic[:, 0])
    if known.sum() < 3:
        raise DataError(
            f"{known.sum()} positions", where=sensor.source, expected="a track of three or more"
        )
    time, geodetic = sensor.time[known], sensor.geodetic[known]
    p_n = frame.position(*geodetic.T)
    velocity = sensor.velocity[known]
    if np.mean(np.isnan(velocity[:, 0])) < 0.1:
        level = frame.level_from_tangent(geodetic[:, 0], geodetic[:, 1])
        measured = ~np.isnan(velocity[:, 0])
        v_n = np.einsum("mji,mj->mi", level[measured], velocity[measured])
        return Track(time, p_n, interpolate(time, time[measured], v_n))
    return Track(time, p_n, velocities(time, p_n, _span(sensor, time, longest)))


def body_track(
    sensor: Gnss | Ins, frame: LocalFrame, attitude: AttitudeRecord, *, longest: float
) -> Track:
    """Return the track of the body: that of an antenna less its lever arm, which turns with it."""
    track = track_of(sensor, frame, longest)
    nRb = rotation_from_rph(attitude.rph_at(track.time), attitude.body_axes)
    arm_n = nRb @ np.array(sensor.settings.lever_arm_m)
    v_n = track.v_n - velocities(track.time, arm_n, _span(sensor, track.time, longest))
    return Track(track.time, track.p_n - arm_n, v_n)


def velocities(time: Array, p_n: Array, span: float) -> Array:
    """Return velocities (M, 3) at times (M,): slopes of positions (M, 3) over a span, s."""
    half = max(1, round(0.5 * span / float(np.median(np.diff(time)))))
    half = min(half, (time.size - 1) // 2)
    t, p = (sliding_window_view(x, 2 * half + 1, axis=0) for x in (time, p_n))
    t = t - t.mean(axis=1, keepdims=True)
    v = np.einsum("mw,miw->mi", t, p) / np.sum(t**2, axis=1)[:, None]
    return interpolate(time, time[half:-half], v)


def _span(sensor: Gnss | Ins, time: Array, longest: float) -> float:
    """Return the span, s, whose line has a slope of the wanted standard deviation."""
    if isinstance(sensor, Ins):
        # Its errors change slowly.
        return _SPAN
    variance = float(np.median(sensor.position_std[:, :2])) ** 2
    interval = float(np.median(np.diff(time)))
    return float(np.clip(np.cbrt(12.0 * variance * interval / _VELOCITY_STD**2), _SPAN, longest))
