"""Attitude and turn rate at any time, from the record of a sensor of attitude alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.local_cubics import smoothed_arcs, wave_width
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph, theta_by_rph
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.imu.attitude_history import Orientation
from factorgraph_dvl.imu.interpolation import slope_gain, white_gain
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.records import at_row, white_noise

# Standard deviation of a spline's slope at its knots for white noise of 1 in knots 1 s apart.
_SLOPE = 1.22
# Sample intervals, and s, that make a gap, in which attitude is not known. Chosen: a cubic through
# longer ones is a guess.
_GAP_INTERVALS = 3.5
_LEAST_GAP = 2.5


@dataclass(frozen=True)
class BodyAttitude:
    """Attitude at M times.

    Parameters
    ----------
    rph : ndarray, shape (M, 3), rad
        Roll, pitch and heading as they were measured.
    nRb : ndarray, shape (M, 3, 3)
        Attitude without its errors.
    omega_eb_b, alpha_b : ndarray, shape (M, 3)
        Rate, rad/s, and its derivative.
    omega_sigma : ndarray, shape (M, 3), rad/s
        Standard deviation of the rate.
    theta_by_rph : ndarray, shape (M, 3, 3)
        Derivative of theta in nRb Exp(theta) by roll, pitch, heading.
    """

    rph: Array
    nRb: Array
    omega_eb_b: Array
    alpha_b: Array
    omega_sigma: Array
    theta_by_rph: Array


class AttitudeRecord:
    """Attitude of a body over time, by a cubic spline through its record.

    Parameters
    ----------
    sensor : Attitude or Ins
        The record. Roll and pitch that were not measured are zero.
    body_axes : BodyAxes
        Axes of the body.
    estimated : bool
        Whether the white noise is that of the record; else it is as stated.

    Attributes
    ----------
    white : ndarray, shape (3,), rad
        Standard deviation of roll, pitch, heading that is new in each sample: what a cubic
        through the neighbours misses, noise and motion that the samples do not resolve.

    Raises
    ------
    DataError
        If there are fewer than five attitudes.
    """

    def __init__(self, sensor: Attitude | Ins, body_axes: BodyAxes, *, estimated: bool) -> None:
        rph = sensor.rph
        if isinstance(sensor, Attitude) and not sensor.measures_tilt:
            # Tilt that no row has is zero.
            rph = np.column_stack([np.zeros((sensor.time.size, 2)), rph[:, 2]])
        known: NDArray[np.bool_] = np.asarray((~np.isnan(rph)).all(axis=1))
        if known.sum() < 5:
            raise DataError(
                f"{known.sum()} attitudes", where=sensor.source, expected="five or more"
            )
        self.sensor, self.body_axes = sensor, body_axes
        self.time = sensor.time[known]
        rph = rph[known].copy()
        rph[:, [0, 2]] = np.unwrap(rph[:, [0, 2]], axis=0)
        steep = np.flatnonzero(np.abs(rph[:, 1]) > 1.4)
        if steep.size:
            raise DataError(
                "pitch is above 80 deg: heading and roll are not defined there",
                where=at_row(sensor.source, np.flatnonzero(known)[steep[0]]),
                expected="pitch within 80 deg",
            )
        self.interval = float(np.median(np.diff(self.time)))
        noise = white_noise(rph)
        width = wave_width(self.interval)
        smooth = smoothed_arcs(self.time, rph, width, 1.5 * self.interval)
        self._spline = CubicSpline(self.time, smooth)
        self._rate, self._change = self._spline.derivative(), self._spline.derivative(2)
        stated = sensor.error.white
        self.white = noise if estimated else stated
        # What the smoothing leaves of white noise, in angle and rate.
        gain, slope = (white_gain(width), slope_gain(width)) if width else (1.0, _SLOPE)
        self._rate_sigma = slope * self.white / self.interval
        self.white = gain * self.white
        if isinstance(sensor, Attitude) and not sensor.measures_tilt:
            self.white = np.where([True, True, False], stated, self.white)
        self._gap = longest_gap(self.time)

    def covers(self, time: Array) -> np.ndarray:
        """Whether attitude is known at stamps (M,) of the sensor."""
        after = np.clip(np.searchsorted(self.time, time), 1, self.time.size - 1)
        near = self.time[after] - self.time[after - 1] <= self._gap
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        return np.asarray(near & inside)

    def rph_at(self, time: Array) -> Array:
        """Return roll, pitch, heading (M, 3), rad, as measured, constant beyond the ends."""
        return np.asarray(self._spline(np.clip(time, self.time[0], self.time[-1])))

    def at(self, time: Array, error: Array, nRl: Array) -> BodyAttitude:
        """Return attitude and rates at stamps (M,).

        Parameters
        ----------
        time : ndarray, shape (M,), s
            Stamps of the sensor.
        error : ndarray, shape (M, 3), rad
            Measured minus true roll, pitch, heading.
        nRl : ndarray, shape (M, 3, 3)
            Local-level axes to n.
        """
        rph = np.asarray(self._spline(time))
        true = rph - error
        by_rph = theta_by_rph(true, self.body_axes)
        return BodyAttitude(
            rph=rph,
            nRb=nRl @ rotation_from_rph(true, self.body_axes),
            omega_eb_b=rotate(by_rph, np.asarray(self._rate(time))),
            alpha_b=rotate(by_rph, np.asarray(self._change(time))),
            omega_sigma=np.sqrt(by_rph**2 @ self._rate_sigma**2),
            theta_by_rph=by_rph,
        )


def orientations(sensor: Attitude | Ins, body_axes: BodyAxes) -> Callable[[Array], Orientation]:
    """Return a function of true times (M,), s, to attitude and turn rate by a record alone.

    The clock of the record is as it is stated.
    """
    record = AttitudeRecord(sensor, body_axes, estimated=True)
    late = sensor.settings.time_offset_s

    def at(time: Array) -> Orientation:
        stamp = time + late
        level = np.broadcast_to(np.eye(3), (time.size, 3, 3))
        body = record.at(stamp, np.zeros((time.size, 3)), level)
        return Orientation(body.nRb, body.omega_eb_b, record.covers(stamp))

    return at


def level_axes(frame: LocalFrame, p_n: Array) -> Array:
    """Return the rotations (M, 3, 3) of the local-level axes at positions (M, 3) to n."""
    lat, lon, _ = frame.geodetic(p_n)
    return frame.level_from_tangent(lat, lon).transpose(0, 2, 1)


def longest_gap(time: Array) -> float:
    """Return the gap, s, between records at (M,) beyond which nothing is known between them."""
    return max(_GAP_INTERVALS * float(np.median(np.diff(time))), _LEAST_GAP)
