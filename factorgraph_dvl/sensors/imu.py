"""The inertial measurement unit: settings, record, bias parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from factorgraph_dvl.geometry.units import DEG_PER_HOUR, DEG_PER_SQRT_HOUR, HOUR, MICRO_G
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.records import (
    check_finite,
    check_range,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive

COLUMNS = (
    "time_s",
    "gyro_x_rad_s",
    "gyro_y_rad_s",
    "gyro_z_rad_s",
    "accel_x_m_s2",
    "accel_y_m_s2",
    "accel_z_m_s2",
)
# Below these the preintegrated covariance loses its digits; no gyro or accelerometer
# that exists is quieter.
_LEAST_GYRO_NOISE = 1e-6 * DEG_PER_SQRT_HOUR
_LEAST_ACCEL_NOISE = 0.01 * MICRO_G
_MAX_RATE_RAD_S = 100.0
_MAX_FORCE_M_S2 = 1000.0

_GYRO_BIAS = ParameterSpec("gyro_bias", "deg_h", frame="b", place=5)
_ACCEL_BIAS = ParameterSpec("accel_bias", "ug", frame="b", place=6)


class ImuSettings(SensorSection, frozen=True, kw_only=True):
    """Section `imu` of trial.yaml."""

    file: str = "imu.csv"
    sampling: Literal["mean", "instantaneous"] = "mean"
    gyro_noise_deg_sqrt_h: NonNegative
    gyro_bias_std_deg_h: Positive
    gyro_bias_walk_deg_h_sqrt_h: NonNegative = 0.0
    accel_noise_ug_sqrt_hz: NonNegative
    accel_bias_std_ug: Positive
    accel_bias_walk_ug_sqrt_h: NonNegative = 0.0

    @property
    def gyro_noise_root_psd(self) -> float:
        """Angle random walk, rad/√s."""
        return max(self.gyro_noise_deg_sqrt_h * DEG_PER_SQRT_HOUR, _LEAST_GYRO_NOISE)

    @property
    def accel_noise_root_psd(self) -> float:
        """Velocity random walk, m/s/√s."""
        return max(self.accel_noise_ug_sqrt_hz * MICRO_G, _LEAST_ACCEL_NOISE)

    @property
    def gyro_bias_walk_root_psd(self) -> float:
        """Random walk of the gyro bias, rad/s/√s."""
        return self.gyro_bias_walk_deg_h_sqrt_h * DEG_PER_HOUR / np.sqrt(HOUR)

    @property
    def accel_bias_walk_root_psd(self) -> float:
        """Random walk of the accelerometer bias, m/s²/√s."""
        return self.accel_bias_walk_ug_sqrt_h * MICRO_G / np.sqrt(HOUR)

    @property
    def bias_walks(self) -> bool:
        """Whether any bias is a random walk."""
        return self.gyro_bias_walk_deg_h_sqrt_h > 0 or self.accel_bias_walk_ug_sqrt_h > 0


@dataclass(frozen=True)
class Imu:
    """Settings and record of the IMU.

    Parameters
    ----------
    settings : ImuSettings
    time : ndarray, shape (N,)
        S, strictly increasing.
    gyro : ndarray, shape (N, 3)
        Angular rate relative to inertial space, in body, rad/s.
    accel : ndarray, shape (N, 3), m/s²
        Specific force in body.
    source : str, optional
        Name of the file, for messages.
    """

    settings: ImuSettings
    time: Array
    gyro: Array
    accel: Array
    source: str = "imu"

    section: ClassVar[str] = "imu"
    section_type: ClassVar[type[SensorSection]] = ImuSettings
    required: ClassVar[tuple[str, ...]] = COLUMNS
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (_GYRO_BIAS, _ACCEL_BIAS)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        gyro = named_columns(COLUMNS[1:4], self.gyro)
        accel = named_columns(COLUMNS[4:7], self.accel)
        check_finite({**gyro, **accel}, self.source)
        check_range(gyro, -_MAX_RATE_RAD_S, _MAX_RATE_RAD_S, "rad/s", self.source)
        check_range(accel, -_MAX_FORCE_M_S2, _MAX_FORCE_M_S2, "m/s²", self.source)

    @classmethod
    def from_columns(
        cls, settings: ImuSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record that a table holds."""
        gyro, accel = stack(columns, COLUMNS[1:4]), stack(columns, COLUMNS[4:7])
        return cls(settings, columns["time_s"], gyro, accel, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return named_columns(COLUMNS, np.column_stack([self.time, self.gyro, self.accel]))

    def parameters(self, duration: float) -> tuple[Parameter, Parameter]:
        """Return gyro and accelerometer bias; a walking one as its mean over `duration` s.

        The mean of a random walk b(t) = b0 + w(t) over T has the variance
        var(b0) + q T / 3.
        """
        s = self.settings
        gyro_sigma = np.hypot(
            s.gyro_bias_std_deg_h * DEG_PER_HOUR,
            s.gyro_bias_walk_root_psd * np.sqrt(duration / 3.0),
        )
        accel_sigma = np.hypot(
            s.accel_bias_std_ug * MICRO_G,
            s.accel_bias_walk_root_psd * np.sqrt(duration / 3.0),
        )
        zero = np.zeros(3)
        return (
            Parameter(_GYRO_BIAS, zero, np.full(3, gyro_sigma)),
            Parameter(_ACCEL_BIAS, zero, np.full(3, accel_sigma)),
        )
