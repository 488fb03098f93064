"""The Doppler velocity log: settings, record, and the velocity that it reports."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.units import DEG, HOUR
from factorgraph_dvl.geometry.vectors import Array, cross, rotate, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.averaging import (
    Stamp,
    averaging_spec,
    stamp_in_the_middle,
    usual_parameter,
)
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.dvl_distortion import (
    AXES_SPEC,
    NAMES,
    SCALE_DIFFERENCE,
    SPECS,
    Distortion,
    is_distorted,
)
from factorgraph_dvl.sensors.dvl_water import (
    CURRENT,
    CURRENT_SPEC,
    WATER,
    WATER_SPAN,
    WATER_SPAN_SPEC,
    WATER_SPEC,
)
from factorgraph_dvl.sensors.parameters import SCALAR, XYZ, JointPrior, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    LEAST_VELOCITY_SIGMA,
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    ObservationByRows,
    ScaleWalk,
    SensorSection,
    Values,
    expected_correlation,
    lever_arm_sigma,
    velocity_sigma,
)
from factorgraph_dvl.sensors.records import (
    check_all_or_none,
    check_range,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3, Vector3

VELOCITY_COLUMNS = ("vel_x_m_s", "vel_y_m_s", "vel_z_m_s")
STD_COLUMNS = ("std_x_m_s", "std_y_m_s", "std_z_m_s")

# Limits of what is good enough. Chosen: dead reckoning then drifts by 0.2 % of the distance.
MISALIGNMENT_SPEC = ParameterSpec(
    "misalignment", "deg", kind="rotation", frame="b", place=2, limit=0.1
)
SCALE_SPEC = ParameterSpec("scale_error", labels=SCALAR, place=3, limit=1e-3, above=-1.0)
SCALES_SPEC = replace(SCALE_SPEC, labels=XYZ, frame="d")
LEVER_ARM_SPEC = ParameterSpec("lever_arm", "m", frame="b", place=4, limit=0.1)
# Plausible size, m/s. Chosen: ten times the bias of a DVL that is in order.
BIAS_SPEC = ParameterSpec(
    "dvl_bias", "m_s", frame="d", nuisance=True, plausible=0.1, key="dvl: bias_std_m_s"
)
CLOCK = Clock.of("dvl")
AVERAGING_SPEC = averaging_spec()

MISALIGNMENT = MISALIGNMENT_SPEC.name
SCALE_ERROR = SCALE_SPEC.name
LEVER_ARM = LEVER_ARM_SPEC.name
BIAS = BIAS_SPEC.name
TIME_OFFSET = CLOCK.offset.name
AVERAGING = AVERAGING_SPEC.name

# What a calibration says of the DVL, and not of the sea that day.
CALIBRATED = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM, BIAS, TIME_OFFSET)


class DvlSettings(ClockSection, frozen=True, kw_only=True):
    """Section `dvl` of trial.yaml.

    Examples
    --------
    >>> from factorgraph_dvl import DvlSettings
    >>> DvlSettings(misalignment_deg=(0.0, 0.0, 45.0)).scale_error_std
    0.1
    """

    file: str = "dvl.csv"
    calibration: str | UnsetType = UNSET
    velocity_std_m_s: NonNegative = 0.001
    velocity_std_fraction: NonNegative = 0.002
    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    misalignment_std_deg: Sigma3 = (180.0, 180.0, 180.0)
    scale_error: float | Vector3 = 0.0
    # msgspec (0.22 at least) corrupts memory where a union holds a constrained number and
    # a tuple of fixed length; the number is checked by its name.
    scale_error_std: float | Sigma3 = 0.1
    axes_std_deg: Sigma3 = (0.0, 0.0, 0.0)
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    lever_arm_std_m: Sigma3 = (10.0, 10.0, 10.0)
    bias_std_m_s: Sigma3 = (0.001, 0.001, 0.001)
    time_offset_std_s: NonNegative = 0.5
    averaging_s: NonNegative = 0.0
    averaging_std_s: NonNegative | UnsetType = UNSET
    stamp: Stamp = "middle"
    correlation_time_s: Positive | UnsetType = UNSET
    correlated_std_m_s: float | Sigma3 | UnsetType = UNSET
    scale_walk_std_sqrt_h: NonNegative = 0.0
    reference: Literal["bottom", "water"] = "bottom"
    current_std_m_s: tuple[NonNegative, NonNegative] = (0.5, 0.5)
    # Of the current as a process about its mean; estimated where they are not stated.
    current_variation_std_m_s: NonNegative | UnsetType = UNSET
    current_correlation_time_s: Positive | UnsetType = UNSET

    @property
    def left_out(self) -> tuple[str, ...]:
        """The walk of the scale, the window and the axes, where there are any."""
        keys = ("scale_walk_std_sqrt_h", "averaging_s", "axes_std_deg")
        return tuple(key for key in keys if np.any(np.array(getattr(self, key)) > 0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        scales = np.atleast_1d(self.scale_error)
        if np.any(scales <= -1.0):
            raise ValueError("`scale_error` must be above -1")


@dataclass(frozen=True)
class Dvl:
    """Settings and record of the DVL.

    Parameters
    ----------
    settings : DvlSettings
        Section `dvl` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing; true time plus the time offset. Stamps of means at the start or end of
        their windows are moved to the middle.
    velocity : ndarray, shape (M, 3)
        Velocity of the DVL over the seabed (or through the water), in its own axes d, m/s; nan =
        no lock.
    std : ndarray, shape (M, 3), m/s
        Standard deviations; nan where the record has none.
    source : str, optional
        Name of the file, for messages.
    prior : JointPrior, optional
        What the calibration that `settings` name knows; it takes the place of the keys for the
        parameters that it has.

    Examples
    --------
    >>> import numpy as np
    >>> from factorgraph_dvl import Dvl, DvlSettings
    >>> velocity = np.array([[1.5, 0.0, 0.0], [np.nan, np.nan, np.nan]])
    >>> dvl = Dvl(DvlSettings(), np.array([0.0, 0.5]), velocity, np.full((2, 3), np.nan))
    >>> dvl.locked
    array([ True, False])
    """

    settings: DvlSettings
    time: Array
    velocity: Array
    std: Array
    source: str = "dvl"
    label: str = "DVL"
    prior: JointPrior | None = None

    section: ClassVar[str] = "dvl"
    section_type: ClassVar[type[SensorSection]] = DvlSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", *VELOCITY_COLUMNS)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (STD_COLUMNS,)
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(MISALIGNMENT_SPEC, SCALE_SPEC, SCALES_SPEC, LEVER_ARM_SPEC),
        *(BIAS_SPEC, *CLOCK.specs, AVERAGING_SPEC),
        *(CURRENT_SPEC, WATER_SPEC, WATER_SPAN_SPEC),
        *SPECS,
    )

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        stamp_in_the_middle(self)
        velocity = named_columns(VELOCITY_COLUMNS, self.velocity)
        check_all_or_none(velocity, self.source)
        check_range(velocity, -50.0, 50.0, "m/s", self.source)
        std = named_columns(STD_COLUMNS, self.std)
        check_all_or_none(std, self.source)
        check_range(std, 1e-6, 100.0, "m/s, above 0", self.source)

    @classmethod
    def from_columns(
        cls, settings: DvlSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        velocity, std = stack(columns, VELOCITY_COLUMNS), stack(columns, STD_COLUMNS)
        return cls(settings, columns["time_s"], velocity, std, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        table = {"time_s": self.time, **named_columns(VELOCITY_COLUMNS, self.velocity)}
        if not np.isnan(self.std).all():
            table |= named_columns(STD_COLUMNS, self.std)
        return table

    @property
    def missing(self) -> Array:
        """Pings without a velocity, (M,) bool."""
        return np.isnan(self.velocity[:, 0])

    @property
    def locked(self) -> Array:
        """Pings with a velocity, (M,) bool."""
        return np.logical_not(self.missing)

    def nominal(self) -> Self:
        """Return this DVL as trial.yaml describes it, without the calibration it names."""
        settings = msgspec.structs.replace(self.settings, calibration=UNSET)
        return replace(self, settings=settings, prior=None)

    def sigma(self) -> Array:
        """Return the standard deviations of the velocity components, (M, 3), m/s.

        The record's own where it has them, else sqrt(floor² + (fraction · speed)²).
        """
        s = self.settings
        speed = np.linalg.norm(self.velocity, axis=1, keepdims=True)
        model = velocity_sigma((s.velocity_std_m_s, s.velocity_std_fraction), speed, 1.0)
        own = np.maximum(self.std, LEAST_VELOCITY_SIGMA)
        return np.where(np.isnan(self.std), model, own)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return misalignment, scale error, lever arm, bias, clock, current and distortion.

        Raises
        ------
        ConfigError
            If the calibration that trial.yaml names has not been read.
        """
        if self.prior is None:
            if self.settings.calibration is not UNSET:
                raise ConfigError(
                    f"the calibration {self.settings.calibration} has not been read",
                    where="dvl.calibration",
                    expected="a trial loaded from its folder",
                )
            return self._nominal()
        return tuple(
            _from_joint(p, self.prior) if p.name in self.prior.values else p
            for p in self._nominal()
        )

    def prior_means(self) -> dict[str, Array]:
        """Return the prior means of all parameters by name, SI; a rotation as its vector."""
        return {p.name: p.mean for p in self.parameters()}

    def _nominal(self) -> tuple[Parameter, ...]:
        s = self.settings
        mean = np.atleast_1d(np.array(s.scale_error, dtype=float))
        sigma = np.atleast_1d(np.array(s.scale_error_std, dtype=float))
        axes = max(mean.size, sigma.size)
        through_water = s.reference == "water"
        current = np.array(s.current_std_m_s) if through_water else np.zeros(2)
        stated = {AXES_SPEC.name: np.array(s.axes_std_deg) * DEG}
        return (
            Parameter(
                MISALIGNMENT_SPEC,
                np.array(s.misalignment_deg) * DEG,
                np.array(s.misalignment_std_deg) * DEG,
            ),
            Parameter(
                _scale_spec(axes),
                np.broadcast_to(mean, axes).copy(),
                np.broadcast_to(sigma, axes).copy(),
            ),
            Parameter(LEVER_ARM_SPEC, np.array(s.lever_arm_m), np.array(s.lever_arm_std_m)),
            Parameter(BIAS_SPEC, np.zeros(3), np.array(s.bias_std_m_s)),
            *CLOCK.parameters(s),
            usual_parameter(AVERAGING_SPEC, s.averaging_s, s.averaging_std_s),
            Parameter(CURRENT_SPEC, np.zeros(2), current),
            *(Parameter(spec, np.zeros(2), np.zeros(2)) for spec in (WATER_SPEC, WATER_SPAN_SPEC)),
            *(
                Parameter(spec, np.zeros(spec.size), stated.get(spec.name, np.zeros(spec.size)))
                for spec in SPECS
                # The scale of each axis is there already.
                if axes == 1 or spec.name != SCALE_DIFFERENCE
            ),
        )

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the pings that have a lock."""
        m = self.locked
        if not m.any():
            return ()
        s = self.settings
        noise = (s.velocity_std_m_s, s.velocity_std_fraction)
        s = self.settings
        correlated = expected_correlation(s.correlation_time_s, s.correlated_std_m_s, 3)
        time, velocity = self.time[m], self.velocity[m]
        rate = s.scale_walk_std_sqrt_h / np.sqrt(HOUR)
        walk = ScaleWalk(SCALE_ERROR, rate, time, velocity)
        return (
            DvlVelocity(
                time,
                velocity,
                self.std[m],
                noise,
                correlated=correlated,
                scale_walk=walk,
                middle=0.5 * float(time[0] + time[-1]),
            ),
        )

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component could not be observed, given the motion of the trial."""
        if motion is None or motion.v_n.shape[0] < 2:
            return message("not_observable.no_ping")
        v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        speed = np.linalg.norm(v_b, axis=1)
        moving = speed > 0.3 * max(speed.max(), 1e-9)
        direction = v_b[moving] / speed[moving, None]
        spread = np.degrees(
            np.linalg.svd(direction, full_matrices=False)[1][1] / np.sqrt(moving.sum())
        )
        rates = np.degrees(np.std(motion.omega_eb_b, axis=0))
        if parameter == MISALIGNMENT:
            return message("not_observable.misalignment", spread=spread)
        if parameter == LEVER_ARM:
            return message("not_observable.lever_arm", rates=rates)
        if parameter == SCALE_ERROR:
            return message("not_observable.scale", least=speed.min(), largest=speed.max())
        if parameter == BIAS:
            return message("not_observable.bias")
        if parameter in CLOCK.names:
            return message("not_observable.clock")
        return message("not_observable.current")


@dataclass(frozen=True)
class DvlVelocity(ObservationByRows):
    """Velocity reported by a DVL.

    The error is zero where

        v_d = (1 + k) dRb (nRbᵀ (v_n - c_n) + omega_eb_b x l) + beta,

    all at the true time of the ping, which is time - offset. k acts per axis of d where
    it has three components. c_n is the current, zero for bottom track. The large-angle
    form of Luo et al. (2024), eq. 1, with the rate relative to the Earth; what else there
    may be is in `sensors.dvl_distortion`.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times as in the file.
    measured_d : ndarray, shape (M, 3), m/s
        Velocity in d.
    std : ndarray, shape (M, 3), m/s
        Standard deviations; nan where they follow from `noise`.
    noise : tuple of (float, float), optional
        Floor, m/s, and fraction of the speed.
    middle : float, optional
        When a scale that changes with time is that of the trial, s.
    """

    time: Array
    measured_d: Array
    std: Array
    noise: tuple[float, float] = (0.0, 0.0)
    label: str = "DVL velocity"
    unit: str = "m/s"
    components: tuple[str, ...] = ("x", "y", "z")
    noise_groups: tuple[tuple[int, ...], ...] = ((0,), (1,), (2,))
    correlated: ExpectedCorrelation | None = None
    scale_walk: ScaleWalk | None = None
    parameters: tuple[str, ...] = (
        MISALIGNMENT,
        SCALE_ERROR,
        LEVER_ARM,
        BIAS,
        CURRENT,
        WATER,
        *NAMES,
    )
    middle: float = 0.0
    clock: Clock = CLOCK
    averaging: str | None = AVERAGING

    @property
    def noise_by_speed(self) -> tuple[float, float] | None:  # type: ignore[override]
        """Standard deviation that is constant, m/s, and what grows, over the speed."""
        grows = min(self.noise) > 0.0 and bool(np.isnan(self.std).all())
        return self.noise if grows else None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, the gyro's share through the lever arm included.

        By the predicted speed: by the measured one, pings whose noise makes them smaller
        would count more, and the scale would come out too small by twice the squared fraction.
        """
        predicted = self.residual(motion, values) + self.measured_d
        speed = np.sqrt((predicted * predicted).sum(axis=1, keepdims=True))
        own = np.maximum(self.std, LEAST_VELOCITY_SIGMA) * np.atleast_2d(factor)[0]
        std = np.where(np.isnan(self.std), velocity_sigma(self.noise, speed, factor), own)
        return np.hypot(std, lever_arm_sigma(motion, values[LEVER_ARM])[:, None])

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured in d, (M, 3), m/s."""
        dvl_b, _ = _velocity_at_dvl(motion, values, self.time)
        scale, axes = values[SCALE_ERROR], values[MISALIGNMENT]
        if is_distorted(values):
            found = self._distortion(motion, values, dvl_b)
            axes = found.axes @ axes
            seen_d = found.truncated((1.0 + found.scale) * (found.turned() @ axes.T))
        else:
            seen_d = (1.0 + scale) * (dvl_b @ axes.T)
        return seen_d + values[BIAS] - self.measured_d

    def _distortion(self, motion: Motion, values: Values, dvl_b: Array) -> Distortion:
        """Return what else becomes of velocities at the DVL, in body."""
        return Distortion(values, motion, dvl_b, self.time - self.middle, values[SCALE_ERROR])

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        dvl_b, imu_b = _velocity_at_dvl(motion, values, self.time)
        bRn = motion.nRb.transpose(0, 2, 1)
        scale, axes, flexed_b = 1.0 + values[SCALE_ERROR], values[MISALIGNMENT], dvl_b
        distorted, found = is_distorted(values), self._distortion(motion, values, dvl_b)
        if distorted:
            scale, axes, flexed_b = 1.0 + found.scale, found.axes @ axes, found.turned()
        unscaled_d = flexed_b @ axes.T
        seen_d, passed = scale * unscaled_d, np.ones_like(unscaled_d)
        dMb = by_velocity = scale[..., None] * axes
        if distorted:
            passed = found.passed(seen_d)
            seen_d = found.truncated(seen_d)
            dMb = by_velocity = passed[:, :, None] * dMb
        d_scale = (passed * unscaled_d)[:, :, None]
        if values[SCALE_ERROR].size == 3:
            d_scale = d_scale * np.eye(3)
        derivatives: dict[str, Callable[[], Array]] = {}
        more = None
        if distorted or not set(NAMES).isdisjoint(wanted):
            more = found.derivatives(unscaled_d, dMb, passed)
            derivatives |= more.parameters
            by_velocity = more.velocity
        d_v = by_velocity @ bRn
        derivatives |= {
            MISALIGNMENT: lambda: -dMb @ skew(flexed_b),
            SCALE_ERROR: lambda: d_scale,
            LEVER_ARM: lambda: by_velocity @ skew(motion.omega_eb_b),
            BIAS: lambda: np.broadcast_to(np.eye(3), d_v.shape),
            CURRENT: lambda: -d_v[:, :, :2],
            WATER: lambda: -d_v[:, :, :2] * _in_water(self.time, values)[:, None, None],
        }
        d_theta, d_omega = by_velocity @ skew(imu_b), -by_velocity @ skew(values[LEVER_ARM])
        if more is not None:
            d_theta, d_omega = d_theta + more.theta, d_omega + more.omega
        return Linearization(
            residual=seen_d + values[BIAS] - self.measured_d,
            d_theta=d_theta,
            d_p=None if more is None or not distorted else more.place,
            d_v=d_v,
            d_omega=np.broadcast_to(d_omega, d_v.shape),
            d_parameters={name: make() for name, make in derivatives.items() if name in wanted},
        )


def _scale_spec(axes: int) -> ParameterSpec:
    """Return what a scale error is: one number, or one for each axis."""
    return SCALES_SPEC if axes == 3 else SCALE_SPEC


def _from_joint(p: Parameter, joint: JointPrior) -> Parameter:
    """Return a parameter with the mean and the standard deviations of a calibration."""
    value = joint.values[p.name]
    spec = _scale_spec(value.size) if p.name == SCALE_ERROR else p.spec
    return Parameter(spec, value * p.si, joint.std(p.name) * p.si, joint)


def _in_water(time: Array, values: Values) -> Array:
    """Whether pings are within the span in which water is seen, (M,)."""
    first, last = values.get(WATER_SPAN, np.zeros(2))
    return (time >= first) & (time <= last)


def _velocity_at_dvl(motion: Motion, values: Values, time: Array) -> tuple[Array, Array]:
    """Return the velocities of DVL and IMU, relative to bottom or water, in body, (M, 3)."""
    # One for all, or one for each.
    current_n = np.zeros((*values[CURRENT].shape[:-1], 3))
    current_n[..., :2] = values[CURRENT]
    if WATER in values and values[WATER].any():
        water_n = _in_water(time, values)[:, None] * np.array([*values[WATER], 0.0])
        current_n = current_n + water_n
    imu_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n - current_n)
    return imu_b + cross(motion.omega_eb_b, values[LEVER_ARM]), imu_b
