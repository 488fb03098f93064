"""The inertial measurement unit: settings, record, bias parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.units import (
    DEG,
    DEG_PER_HOUR,
    DEG_PER_SQRT_HOUR,
    HOUR,
    MICRO_G,
    PPM,
    STANDARD_GRAVITY,
)
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import JointPrior, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import SensorSection
from factorgraph_dvl.sensors.records import (
    check_finite,
    check_range,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive

Grade = Literal["navigation", "tactical", "industrial", "mems"]

# Chosen: round figures (1 σ) of what data sheets of the class say, docs/format.md names them.
# Biases are those from one start to the next, walks what in-run instability amounts to in an
# hour. A bias prior that is too wide costs little, one that is too narrow falsifies the rest.
TYPICAL: dict[Grade, dict[str, float]] = {
    "navigation": {
        "gyro_noise_deg_sqrt_h": 0.002,
        "gyro_bias_std_deg_h": 0.01,
        "gyro_bias_walk_deg_h_sqrt_h": 0.0,
        "accel_noise_ug_sqrt_hz": 25.0,
        "accel_bias_std_ug": 50.0,
        "accel_bias_walk_ug_sqrt_h": 0.0,
        "gyro_scale_std_ppm": 5.0,
        "gyro_misalignment_std_deg": 0.0015,
        "gyro_g_sensitivity_std_deg_h_g": 0.005,
        "accel_scale_std_ppm": 100.0,
        "accel_misalignment_std_deg": 0.003,
    },
    "tactical": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "gyro_bias_std_deg_h": 2.0,
        "gyro_bias_walk_deg_h_sqrt_h": 0.3,
        "accel_noise_ug_sqrt_hz": 80.0,
        "accel_bias_std_ug": 1000.0,
        "accel_bias_walk_ug_sqrt_h": 30.0,
        "gyro_scale_std_ppm": 300.0,
        "gyro_misalignment_std_deg": 0.03,
        "gyro_g_sensitivity_std_deg_h_g": 1.0,
        "accel_scale_std_ppm": 300.0,
        "accel_misalignment_std_deg": 0.03,
    },
    "industrial": {
        "gyro_noise_deg_sqrt_h": 0.1,
        "gyro_bias_std_deg_h": 200.0,
        "gyro_bias_walk_deg_h_sqrt_h": 2.0,
        "accel_noise_ug_sqrt_hz": 40.0,
        "accel_bias_std_ug": 3000.0,
        "accel_bias_walk_ug_sqrt_h": 30.0,
        "gyro_scale_std_ppm": 1000.0,
        "gyro_misalignment_std_deg": 0.05,
        "gyro_g_sensitivity_std_deg_h_g": 10.0,
        "accel_scale_std_ppm": 1000.0,
        "accel_misalignment_std_deg": 0.04,
    },
    "mems": {
        "gyro_noise_deg_sqrt_h": 0.4,
        "gyro_bias_std_deg_h": 600.0,
        "gyro_bias_walk_deg_h_sqrt_h": 10.0,
        "accel_noise_ug_sqrt_hz": 150.0,
        "accel_bias_std_ug": 5000.0,
        "accel_bias_walk_ug_sqrt_h": 100.0,
        "gyro_scale_std_ppm": 3000.0,
        "gyro_misalignment_std_deg": 0.1,
        "gyro_g_sensitivity_std_deg_h_g": 20.0,
        "accel_scale_std_ppm": 3000.0,
        "accel_misalignment_std_deg": 0.1,
    },
}
# Without a grade these are taken as zero, and the other keys must be stated.
ZERO_WITHOUT_GRADE = frozenset(
    (
        "gyro_bias_walk_deg_h_sqrt_h",
        "accel_bias_walk_ug_sqrt_h",
        "gyro_scale_std_ppm",
        "gyro_misalignment_std_deg",
        "gyro_g_sensitivity_std_deg_h_g",
        "accel_scale_std_ppm",
        "accel_misalignment_std_deg",
    )
)


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
# Stands for a key that is not stated, until the grade or zero takes its place; as a value in a
# file it is refused.
_NOT_STATED = math.nan

_GYRO_BIAS = ParameterSpec("gyro_bias", "deg_h", frame="b", place=5)
_ACCEL_BIAS = ParameterSpec("accel_bias", "ug", frame="b", place=6)


@dataclass(frozen=True)
class ImuError:
    """One error of an IMU that grows with rate or force: an element of Mg, Gg or Ma.

    Parameters
    ----------
    of : {'rate', 'force'}
        What it changes.
    by : {'rate', 'force', 'delay'}
        What it grows with: a delay, with how fast the rate changes.
    row, column : int
        Axis that it changes, and axis that it grows with.
    """

    of: Literal["rate", "force"]
    by: Literal["rate", "force", "delay"]
    row: int
    column: int


# By definition: elements (row, column) of a matrix of errors.
_DIAGONAL = ((0, 0), (1, 1), (2, 2))
_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
_BELOW = ((1, 0), (2, 0), (2, 1))
_FULL = tuple(itertools.product(range(3), range(3)))


def _error_spec(
    stem: str,
    unit: str,
    of: Literal["rate", "force"],
    by: Literal["rate", "force", "delay"],
    elements: tuple[tuple[int, int], ...],
    plausible: float,
) -> tuple[ParameterSpec, tuple[ImuError, ...]]:
    """Return what errors of one kind are, and the elements that they stand for."""
    labels = tuple("xyz"[i] if elements is _DIAGONAL else "xyz"[i] + "xyz"[j] for i, j in elements)
    spec = ParameterSpec(
        stem,
        unit,
        labels=labels,
        frame="b",
        nuisance=True,
        plausible=plausible,
        key=f"imu: {stem}_std_{unit}",
    )
    return spec, tuple(ImuError(of, by, i, j) for i, j in elements)


# Plausible sizes. Chosen: the worst of data sheets of MEMS.
_ERRORS = (
    _error_spec("gyro_scale", "ppm", "rate", "rate", _DIAGONAL, 1e4),
    _error_spec("gyro_misalignment", "deg", "rate", "rate", _OFF_DIAGONAL, 0.5),
    _error_spec("gyro_g_sensitivity", "deg_h_g", "rate", "force", _FULL, 100.0),
    _error_spec("gyro_delay", "s", "rate", "delay", _DIAGONAL, 0.05),
    _error_spec("accel_scale", "ppm", "force", "force", _DIAGONAL, 1e4),
    _error_spec("accel_misalignment", "deg", "force", "force", _BELOW, 0.5),
)
# Of what an earlier calibration says, what this IMU may start from.
BIASES = (_GYRO_BIAS.name, _ACCEL_BIAS.name)
# The elements that the components of each parameter stand for, by its name.
ERRORS = {spec.name: elements for spec, elements in _ERRORS}
GYRO_SCALE = _ERRORS[0][0].name


def within_limits(gyro: Array, accel: Array) -> bool:
    """Whether all rates, rad/s, and forces, m/s², can be; what is not a number cannot."""
    limits = (gyro, _MAX_RATE_RAD_S), (accel, _MAX_FORCE_M_S2)
    return all(-limit <= signal.min() and signal.max() <= limit for signal, limit in limits)


@dataclass(frozen=True)
class ImuErrorStd:
    """Standard deviations of the errors of an IMU that grow with rate and force, SI.

        gyro = (I + Mg) omega + Gg f - tau alpha + bias,    accel = (I + Ma) f + bias

    with the scale errors on the diagonals, and tau by how much each gyro is late, to first order a
    delay or the time constant of a filter. Every off-diagonal element of Mg has the stated
    standard deviation; Ma is a lower triangle, as the accelerometer triad defines the body.

    Parameters
    ----------
    gyro_scale : float
        Standard deviation of a diagonal element of Mg.
    gyro_misalignment : float
        Standard deviation of an off-diagonal element of Mg, rad.
    gyro_g_sensitivity : float
        Standard deviation of an element of Gg, (rad/s)/(m/s²).
    gyro_delay : float
        Standard deviation of an element of tau, s.
    accel_scale : float
        Standard deviation of a diagonal element of Ma.
    accel_misalignment : float
        Standard deviation of an element of Ma below the diagonal, rad.
    """

    gyro_scale: float = 0.0
    gyro_misalignment: float = 0.0
    gyro_g_sensitivity: float = 0.0
    gyro_delay: float = 0.0
    accel_scale: float = 0.0
    accel_misalignment: float = 0.0


class ImuSettings(SensorSection, frozen=True, kw_only=True):
    """Section `imu` of trial.yaml; what it does not state has the value typical of the grade.

    Examples
    --------
    >>> from factorgraph_dvl import ImuSettings
    >>> ImuSettings(grade="tactical", gyro_noise_deg_sqrt_h=0.1).gyro_noise_deg_sqrt_h
    0.1
    """

    file: str = "imu.csv"
    sampling: Literal["mean", "instantaneous"] = "mean"
    grade: Grade | UnsetType = UNSET
    calibration: str | UnsetType = UNSET
    gyro_noise_deg_sqrt_h: NonNegative = _NOT_STATED
    gyro_bias_std_deg_h: Positive = _NOT_STATED
    gyro_bias_walk_deg_h_sqrt_h: NonNegative = _NOT_STATED
    accel_noise_ug_sqrt_hz: NonNegative = _NOT_STATED
    accel_bias_std_ug: Positive = _NOT_STATED
    accel_bias_walk_ug_sqrt_h: NonNegative = _NOT_STATED
    gyro_scale_std_ppm: NonNegative = _NOT_STATED
    gyro_misalignment_std_deg: NonNegative = _NOT_STATED
    gyro_g_sensitivity_std_deg_h_g: NonNegative = _NOT_STATED
    accel_scale_std_ppm: NonNegative = _NOT_STATED
    accel_misalignment_std_deg: NonNegative = _NOT_STATED
    gyro_delay_std_s: NonNegative = 0.0
    gravity_deflection_std_arcsec: NonNegative = 10.0

    def __post_init__(self) -> None:
        typical = {} if isinstance(self.grade, UnsetType) else TYPICAL[self.grade]
        for name in next(iter(TYPICAL.values())):
            if not math.isnan(getattr(self, name)):
                continue
            if not typical and name not in ZERO_WITHOUT_GRADE:
                raise ValueError(f"Object missing required field `{name}`, or `grade`")
            msgspec.structs.force_setattr(self, name, typical.get(name, 0.0))
        super().__post_init__()

    @property
    def error_std(self) -> ImuErrorStd:
        """Standard deviations of scale, axes and g-sensitivity, SI."""
        return ImuErrorStd(
            gyro_scale=self.gyro_scale_std_ppm * PPM,
            gyro_misalignment=self.gyro_misalignment_std_deg * DEG,
            gyro_g_sensitivity=(
                self.gyro_g_sensitivity_std_deg_h_g * DEG_PER_HOUR / STANDARD_GRAVITY
            ),
            gyro_delay=self.gyro_delay_std_s,
            accel_scale=self.accel_scale_std_ppm * PPM,
            accel_misalignment=self.accel_misalignment_std_deg * DEG,
        )

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
        Section `imu` of trial.yaml.
    time : ndarray, shape (N,), s
        Strictly increasing.
    gyro : ndarray, shape (N, 3)
        Angular rate relative to inertial space, in body, rad/s.
    accel : ndarray, shape (N, 3), m/s²
        Specific force in body.
    source : str, optional
        Name of the file, for messages.
    prior : JointPrior, optional
        What the calibration that `settings` name knows of the biases at the first sample; it takes
        the place of their keys.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import Imu, ImuSettings
    >>> time = np.arange(1, 101) / 100.0
    >>> force = np.tile([0.0, 0.0, 9.8], (100, 1))
    >>> Imu(ImuSettings(grade="mems"), time, np.zeros((100, 3)), force).time.size
    100
    """

    settings: ImuSettings
    time: Array
    gyro: Array
    accel: Array
    source: str = "imu"
    prior: JointPrior | None = None

    section: ClassVar[str] = "imu"
    section_type: ClassVar[type[SensorSection]] = ImuSettings
    required: ClassVar[tuple[str, ...]] = COLUMNS
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(_GYRO_BIAS, _ACCEL_BIAS),
        *(spec for spec, _ in _ERRORS),
    )

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        if within_limits(self.gyro, self.accel):
            return
        gyro = named_columns(COLUMNS[1:4], self.gyro)
        accel = named_columns(COLUMNS[4:7], self.accel)
        check_finite({**gyro, **accel}, self.source)
        check_range(gyro, -_MAX_RATE_RAD_S, _MAX_RATE_RAD_S, "rad/s", self.source)
        check_range(accel, -_MAX_FORCE_M_S2, _MAX_FORCE_M_S2, "m/s²", self.source)

    @classmethod
    def from_columns(
        cls, settings: ImuSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        gyro, accel = stack(columns, COLUMNS[1:4]), stack(columns, COLUMNS[4:7])
        return cls(settings, columns["time_s"], gyro, accel, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table, whose columns are views."""
        return dict(zip(COLUMNS, [self.time, *self.gyro.T, *self.accel.T], strict=True))

    @property
    def error_std(self) -> ImuErrorStd:
        """Standard deviations of scale, axes and g-sensitivity, SI."""
        return self.settings.error_std

    def nominal(self) -> Self:
        """Return this IMU as trial.yaml describes it, without the calibration it names."""
        settings = msgspec.structs.replace(self.settings, calibration=UNSET)
        return replace(self, settings=settings, prior=None)

    def error_parameters(self) -> tuple[Parameter, ...]:
        """Return scale, axes and g-sensitivity with their priors."""
        return tuple(
            Parameter(
                spec, np.zeros(spec.size), np.full(spec.size, getattr(self.error_std, spec.stem))
            )
            for spec, _ in _ERRORS
        )

    def parameters(self, duration: float) -> tuple[Parameter, Parameter]:
        """Return gyro and accelerometer bias; a walking one as its mean over `duration` s.

        The mean of a random walk b(t) = b0 + w(t) over T has the variance
        var(b0) + q T / 3.

        Raises
        ------
        ConfigError
            If the calibration that trial.yaml names has not been read.
        """
        s = self.settings
        if self.prior is None and s.calibration is not UNSET:
            raise ConfigError(
                f"the calibration {s.calibration} has not been read",
                where="imu.calibration",
                expected="a trial loaded from its folder",
            )
        return (
            self._bias(
                _GYRO_BIAS, s.gyro_bias_std_deg_h, s.gyro_bias_walk_root_psd**2 * duration / 3.0
            ),
            self._bias(
                _ACCEL_BIAS, s.accel_bias_std_ug, s.accel_bias_walk_root_psd**2 * duration / 3.0
            ),
        )

    def bias_covariance(self) -> Array:
        """Return the prior covariance of gyro and accelerometer bias at the start, (6, 6), SI."""
        both = self.parameters(0.0)
        if self.prior is None:
            return np.diag(np.concatenate([p.sigma for p in both]) ** 2)
        of_all = np.arange(len(self.prior.covariance))
        rows = np.concatenate([of_all[self.prior.rows(p.name)] for p in both])
        si = np.repeat([p.si for p in both], 3)
        return np.asarray(self.prior.covariance[np.ix_(rows, rows)] * np.outer(si, si))

    def prior_after(self, seconds: float) -> JointPrior | None:
        """Return what is known of the biases some time after the start, None if as stated."""
        s = self.settings
        if self.prior is None or not s.bias_walks or seconds <= 0.0:
            return self.prior
        P = self.prior.covariance.copy()
        for spec, root_psd in (
            (_GYRO_BIAS, s.gyro_bias_walk_root_psd),
            (_ACCEL_BIAS, s.accel_bias_walk_root_psd),
        ):
            rows = np.arange(len(P))[self.prior.rows(spec.name)]
            P[rows, rows] += root_psd**2 * seconds / spec.si**2
        return replace(self.prior, covariance=P)

    def _bias(self, spec: ParameterSpec, std: float, walked: float) -> Parameter:
        """Return a bias with its prior, to whose variance `walked` is added, SI."""
        mean, sigma = np.zeros(3), np.full(3, std)
        if self.prior is not None:
            mean, sigma = self.prior.values[spec.name], self.prior.std(spec.name)
        return Parameter(
            spec, mean * spec.si, np.sqrt((sigma * spec.si) ** 2 + walked), joint=self.prior
        )
