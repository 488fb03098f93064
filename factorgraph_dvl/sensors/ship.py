"""The ship above the vehicle: position and attitude of a second vessel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy.interpolate import CubicSpline

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.local_cubics import smoothed_arcs, wave_width
from factorgraph_dvl.geometry.rotations import BodyAxes, rotation_from_rph, theta_by_rph
from factorgraph_dvl.geometry.units import DEG, GEODETIC_SI
from factorgraph_dvl.geometry.vectors import Array, BoolArray, median, rotate
from factorgraph_dvl.sensors.attitude import COLUMNS as ATTITUDE_COLUMNS
from factorgraph_dvl.sensors.gnss import POSITION_COLUMNS
from factorgraph_dvl.sensors.parameters import ParameterSpec
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.records import (
    check_finite,
    check_possible,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.settings.sections import NonNegative, Sigma3, Vector3

# Usual intervals of the record from which on an interval is a gap. Chosen: a cubic through a lost
# sample or two still follows the roll of a ship.
_GAP = 3.5


class ShipSettings(SensorSection, frozen=True, kw_only=True):
    """Section `usbl.ship` of trial.yaml."""

    file: str = "ship.csv"
    transceiver_lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    transceiver_lever_arm_std_m: Sigma3 = (0.0, 0.0, 0.0)
    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    misalignment_std_deg: Sigma3 = (2.0, 2.0, 2.0)
    sound_speed_error_std: NonNegative = 0.005


class ShipMotion(NamedTuple):
    """Motion of the ship at M times: nRs, p_n (m), velocity (m/s) and rate (rad/s) in its body."""

    nRs: Array
    p_n: Array
    v_s: Array
    omega_s: Array


@dataclass(frozen=True)
class Ship:
    """Settings and record of the ship's reference point.

    Parameters
    ----------
    settings : ShipSettings
        Section `usbl.ship` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m).
    rph : ndarray, shape (M, 3), rad
        Roll, pitch, heading.
    source : str, optional
        Name of the file, for messages.
    """

    settings: ShipSettings
    time: Array
    geodetic: Array
    rph: Array
    source: str = "ship"

    section: ClassVar[str] = "ship"
    section_type: ClassVar[type[SensorSection]] = ShipSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", *POSITION_COLUMNS, *ATTITUDE_COLUMNS)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = ()

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        columns = self.columns()
        check_finite(columns, self.source)
        check_possible(columns, self.source)

    @classmethod
    def from_columns(
        cls, settings: ShipSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        geodetic = stack(columns, POSITION_COLUMNS) * GEODETIC_SI
        rph = stack(columns, ATTITUDE_COLUMNS) * DEG
        return cls(settings, columns["time_s"], geodetic, rph, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {
            "time_s": self.time,
            **named_columns(POSITION_COLUMNS, self.geodetic / GEODETIC_SI),
            **named_columns(ATTITUDE_COLUMNS, self.rph / DEG),
        }

    def covers(self, time: Array) -> BoolArray:
        """Whether times (M,), s, lie inside the record, and in none of its gaps."""
        if self.time.size < 2:
            return np.zeros(time.size, dtype=bool)
        steps = np.diff(self.time)
        after = np.clip(np.searchsorted(self.time, time), 1, self.time.size - 1)
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        return np.asarray(inside & (steps[after - 1] <= _GAP * median(steps)))

    def at(self, time: Array, frame: LocalFrame, body_axes: BodyAxes) -> ShipMotion:
        """Return the motion of the reference point at times (M,), s, in a tangent frame."""
        p_n, rph = self._splines(frame)
        here = p_n(time)
        level = frame.level_from_tangent(*frame.geodetic(here)[:2])
        angles = rph(time)
        nRs = np.swapaxes(level, -1, -2) @ rotation_from_rph(angles, body_axes)
        turn = rotate(theta_by_rph(angles, body_axes), rph(time, 1))
        return ShipMotion(nRs, here, rotate(np.swapaxes(nRs, -1, -2), p_n(time, 1)), turn)

    def _splines(self, frame: LocalFrame) -> tuple[CubicSpline, CubicSpline]:
        """Return position in n and the angles, without jumps of 360 degrees, over time."""
        interval = median(np.diff(self.time))
        width, gap = wave_width(interval), _GAP * interval
        p_n, rph = (
            # A cubic through noise misses it between samples: a clock would go there.
            CubicSpline(self.time, smoothed_arcs(self.time, values, width, gap))
            for values in (frame.position(*self.geodetic.T), np.unwrap(self.rph, axis=0))
        )
        return p_n, rph
