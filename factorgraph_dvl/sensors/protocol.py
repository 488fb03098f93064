"""What every sensor offers: settings, parameters, and observations with Jacobians."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, IntArray, cross_variance
from factorgraph_dvl.message import Message
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.settings.sections import Section

Values = Mapping[str, Array]

# Whether the noise of a sensor is estimated from its residuals, or final as it is stated.
NoiseModel = Literal["estimated", "stated"]

# Derivatives by the motion, as `Linearization` names them.
_BY_MOTION = ("d_theta", "d_p", "d_v", "d_omega")
# Least noise of a velocity, m/s. Chosen: below any that is measured.
LEAST_VELOCITY_SIGMA = 1e-4
# Correlation time where none is stated, s. Chosen: that of multipath and atmosphere.
USUAL_CORRELATION_TIME = 100.0


@dataclass(frozen=True)
class MeanMotion:
    """How velocity and rate that are means over windows depend on the motion in their middles.

    Parameters
    ----------
    turn_rate_b, move_rate_n : ndarray, shape (M, 3), rad/s, m/s
        Rates at which attitude and position change.
    v_by_v, v_by_theta : ndarray, shape (M, 3, 3)
        Derivatives of the mean v_n by the velocity and by the attitude.
    v_by_length, omega_by_length : ndarray, shape (M, 3)
        Derivatives of the mean v_n and omega_eb_b by the length of the windows.
    """

    turn_rate_b: Array
    move_rate_n: Array
    v_by_v: Array
    v_by_theta: Array
    v_by_length: Array
    omega_by_length: Array


@dataclass(frozen=True)
class Motion:
    """Motion of the body at the times of M measurements.

    Parameters
    ----------
    nRb : ndarray, shape (M, 3, 3)
        Attitude, body to n.
    p_n, v_n : ndarray, shape (M, 3)
        Position and Earth-relative velocity of the IMU in n, m, m/s.
    omega_eb_b : ndarray, shape (M, 3), rad/s
        Angular rate of the body relative to the Earth.
    a_n : ndarray, shape (M, 3)
        Earth-relative acceleration, dv_n/dt, m/s².
    alpha_b : ndarray, shape (M, 3), rad/s²
        Time derivative of the angular rate.
    omega_sigma : ndarray, shape (M, 3), rad/s
        Standard deviation of omega_eb_b from the gyro's noise and from motion that its samples do
        not resolve.
    turning_b : ndarray, shape (M, 3), optional
        Rate at which two attitudes that differ are blended, rad/s.
    rough_b : ndarray, shape (M, 3), optional
        Rate at which the attitude changes, less omega_eb_b, which is smooth, rad/s.
    moving_n : ndarray, shape (M, 3), optional
        Rate at which the position changes, less v_n, m/s.
    mean : MeanMotion, optional
        How v_n and omega_eb_b depend on the motion, where they are means over windows.
    """

    nRb: Array
    p_n: Array
    v_n: Array
    omega_eb_b: Array
    a_n: Array
    alpha_b: Array
    omega_sigma: Array
    turning_b: Array | None = None
    rough_b: Array | None = None
    moving_n: Array | None = None
    mean: MeanMotion | None = None

    @property
    def changes(self) -> tuple[Array, Array]:
        """Rates at which attitude and position change, (M, 3) each, rad/s in b and m/s in n."""
        if self.mean is not None:
            return self.mean.turn_rate_b, self.mean.move_rate_n
        turning = [each for each in (self.turning_b, self.rough_b) if each is not None]
        moving = [] if self.moving_n is None else [self.moving_n]
        return sum(turning, self.omega_eb_b), sum(moving, self.v_n)


@dataclass(frozen=True)
class Linearization:
    """Residual = predicted - measured, and its derivatives (None where zero).

    Parameters
    ----------
    residual : ndarray, shape (M, d)
        Residual in the unit of the measurement.
    d_theta : ndarray, shape (M, d, 3), optional
        Derivative with respect to theta in nRb Exp(theta).
    d_p, d_v : ndarray, shape (M, d, 3), optional
        Derivatives with respect to p_n and v_n.
    d_omega : ndarray, shape (M, d, 3), optional
        Derivative with respect to omega_eb_b.
    d_parameters : dict of str to ndarray, optional
        Name to (M, d, n); for a rotation, with respect to delta in R Exp(delta).
    """

    residual: Array
    d_theta: Array | None = None
    d_p: Array | None = None
    d_v: Array | None = None
    d_omega: Array | None = None
    d_parameters: dict[str, Array] = field(default_factory=dict)

    @property
    def by_motion(self) -> Array:
        """Derivatives by attitude, position, velocity and rate, (M, d, 12)."""
        out = np.zeros((*self.residual.shape, 12))
        for i, name in enumerate(_BY_MOTION):
            jacobian = getattr(self, name)
            if jacobian is not None:
                out[:, :, 3 * i : 3 * i + 3] = jacobian
        return out

    def some(self, index: slice | IntArray) -> Linearization:
        """Return residuals and derivatives of some of the M measurements."""
        count = len(self.residual)

        def own(each: Array) -> Array:
            # What is the same for all stands there once.
            return np.asarray(np.broadcast_to(each, (count, *each.shape[1:]))[index])

        by_motion = {
            name: own(each) for name in _BY_MOTION if (each := getattr(self, name)) is not None
        }
        by_parameters = {name: own(each) for name, each in self.d_parameters.items()}
        return Linearization(self.residual[index], **by_motion, d_parameters=by_parameters)


class Window(NamedTuple):
    """Window over which a sensor averages.

    Parameters
    ----------
    length : float
        Length, s.
    of_body : bool
        Whether the mean is that of velocities in body axes, as a DVL takes it; else in n.
    """

    length: float
    of_body: bool = True


class SensorClock(Protocol):
    """What the stamps of a sensor depend on."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters offset, rate and others."""

    def lag(self, time: Array, values: Values, zero: float) -> Array:
        """Return stamps minus true times, (M,), s."""

    def by_parameters(self, time: Array, values: Values, zero: float) -> dict[str, Array]:
        """Return the derivatives of the lag by each parameter, (M,) by name."""


@dataclass(frozen=True)
class ExpectedCorrelation:
    """What is known in advance of noise that persists from one measurement to the next.

    Parameters
    ----------
    time : float, s
        Correlation time, within a factor of three.
    sigma : ndarray, shape (d,), optional
        Standard deviation of the part that persists, beside the white one; None where the
        standard deviation of the measurement is that of both.
    """

    time: float
    sigma: Array | None = None


def expected_correlation(
    time: float | UnsetType, sigma: object | UnsetType, size: int, usual: float | None = None
) -> ExpectedCorrelation | None:
    """Return what settings state of correlated noise; None if that is nothing.

    Parameters
    ----------
    time : float or unset, s
        Stated correlation time.
    sigma : array_like or unset
        Stated standard deviation, one for all components or one each.
    size : int
        Number of components.
    usual : float, optional
        Correlation time where none is stated, s.
    """
    std = None if isinstance(sigma, UnsetType) else np.broadcast_to(np.array(sigma, float), size)
    if not isinstance(time, UnsetType):
        return ExpectedCorrelation(time, std)
    if usual is not None:
        return ExpectedCorrelation(usual, std)
    return None if std is None else ExpectedCorrelation(USUAL_CORRELATION_TIME, std)


@dataclass(frozen=True, eq=False)
class ScaleWalk:
    """A scale that walks at random from one measurement to the next.

    Parameters
    ----------
    parameter : str
        Name of the scale error, which is the mean over the trial.
    rate : float, 1/√s
        Standard deviation of its change; 0 where none is stated.
    time : ndarray, shape (M,), s
        Times of the measurements, in order.
    measured : ndarray, shape (M, d)
        What was measured; a unit of scale adds what is predicted of it.
    """

    parameter: str
    rate: float
    time: Array
    measured: Array


class Observation(Protocol):
    """M measurements of one kind, of d components each."""

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""

    @property
    def unit(self) -> str:
        """Unit of the residual."""

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the d components."""

    @property
    def time(self) -> Array:
        """Times as in the record, (M,), s."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that it depends on, those of its clock aside."""

    @property
    def gate(self) -> float | None:
        """Standard deviations from which on a measurement is an echo; None = never."""

    @property
    def noise_groups(self) -> tuple[tuple[int, ...], ...]:
        """Components that share a factor on their stated standard deviation.

        The factors are estimated from the data. Components that are in no group have the
        standard deviation that is stated.
        """

    @property
    def correlated(self) -> ExpectedCorrelation | None:
        """What is known in advance of noise that persists; None = nothing."""

    @property
    def scale_walk(self) -> ScaleWalk | None:
        """How its scale walks; None = not at all."""

    @property
    def independent(self) -> bool:
        """Whether components are measured apart, so that one may be an outlier alone."""

    @property
    def clock(self) -> SensorClock | None:
        """Clock of the sensor; None = that of the IMU."""

    @property
    def averaging(self) -> str | None:
        """Name of the length of the window over which it averages; None = it does not."""

    @property
    def averages_in_body(self) -> bool:
        """Whether its mean is that of velocities in body axes; else in n."""

    @property
    def noise_by_speed(self) -> tuple[float, float] | None:
        """Standard deviation that is constant, m/s, and what grows, over the speed.

        None where noise has not both, or does not follow from them.
        """

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the (M, d) standard deviations of the residual.

        Infinite where a component was not measured; its residual need only be finite. A factor,
        (d,), multiplies the noise of the sensor itself, and not what the gyro adds. Where noise
        grows with speed, it may be (2, d): on the part that is constant, and on what grows.
        """

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, d)."""

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians, of the parameters `wanted` at least.

        Those of the clock follow from the motion, for every sensor alike.
        """


class PlainObservation:
    """What is the same for most observations; a class of its own states what differs."""

    gate: float | None = None
    noise_groups: tuple[tuple[int, ...], ...] = ()
    correlated: ExpectedCorrelation | None = None
    scale_walk: ScaleWalk | None = None
    independent: bool = False
    averaging: str | None = None
    averages_in_body: bool = True
    noise_by_speed: tuple[float, float] | None = None


class ObservationByRows(PlainObservation):
    """A data class of which every array with as many rows as measurements has one for each."""

    time: Array

    def some(self, index: IntArray) -> Self:
        """Return some of its M measurements, (K,); of three, an axis would count as one."""
        count = self.time.size

        def own(value: Any) -> Any:
            if isinstance(value, Mapping):
                return {name: own(each) for name, each in value.items()}
            by_row = isinstance(value, np.ndarray) and value.ndim and len(value) == count
            return value[index] if by_row else value

        every: Any = self
        return replace(every, **{f.name: own(getattr(self, f.name)) for f in fields(every)})


class SensorSection(Section, frozen=True, kw_only=True):
    """A sensor's section of trial.yaml, with the table that contains its record.

    `noise` says whether the stated noise is a start value or final; unset = as the trial says.
    """

    file: str
    noise: NoiseModel | UnsetType = UNSET

    @property
    def left_out(self) -> tuple[str, ...]:
        """Keys that state an error which is estimated only with an IMU."""
        return ()

    @property
    def more_columns(self) -> tuple[str, ...]:
        """Columns that the table must have because the settings say so."""
        return ()


class SensorRecord(Protocol):
    """A sensor's record, and how it stands in files.

    `section` names its part of trial.yaml and its table, `section_type` contains the
    settings, `specs` lists what can be calibrated, with each number of components. Of the
    columns, `required` and the settings' `more_columns` must be there, and of each group of
    `optional` ones all or none. A record that has another one, with its section within its own,
    names it in `parts`; `parts_of` returns those that there are.
    """

    section: ClassVar[str]
    section_type: ClassVar[type[SensorSection]]
    required: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[tuple[str, ...], ...]]
    specs: ClassVar[tuple[ParameterSpec, ...]]

    @property
    def settings(self) -> SensorSection:
        """Settings of the sensor."""

    @classmethod
    def from_columns(cls, settings: Any, columns: Mapping[str, Array], source: str) -> Self:
        """Return the record in a table; columns that it does not have are nan."""

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""


def part_types(kind: type[SensorRecord]) -> Mapping[str, type[SensorRecord]]:
    """Return the records that one may have within itself, by key and attribute."""
    return getattr(kind, "parts", {})


def parts_of(record: SensorRecord) -> dict[str, SensorRecord]:
    """Return the records that one has within itself, by key and attribute."""
    found = {name: getattr(record, name) for name in part_types(type(record))}
    return {name: part for name, part in found.items() if part is not None}


class Aid(SensorRecord, Protocol):
    """A sensor that observes the motion which the IMU integrates."""

    @property
    def label(self) -> str:
        """Name of the sensor, for people."""

    @property
    def time(self) -> Array:
        """Times of the record, (M,), s."""

    @property
    def missing(self) -> Array:
        """Rows without a measurement, (M,) bool."""

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the calibration parameters, fixed ones included."""

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the measurements.

        Parameters
        ----------
        frame : LocalFrame
            Tangent frame n, in which positions are expressed.
        body_axes : {'RFU', 'FRD', 'FLU'}
            Axes b of the body: a heading, roll or pitch refers to its bow.
        """

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message | str:
        """Say why a component could not be observed, given the motion of the trial."""


@dataclass(frozen=True)
class Attitudes:
    """Attitudes that a sensor measures by itself, without any motion.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the attitudes.
    nRs : ndarray, shape (M, 3, 3)
        Attitude of the sensor's axes.
    sigma : ndarray, shape (M,), rad
        Standard deviation about the axis that is known best.
    mounting : Parameter
        The parameter sRb, with its prior.
    """

    time: Array
    nRs: Array
    sigma: Array
    mounting: Parameter


@runtime_checkable
class AttitudeAid(Aid, Protocol):
    """An aid from which a vehicle at rest can start."""

    def attitudes(self, frame: LocalFrame) -> Attitudes:
        """Return the attitudes that were measured, in `frame`."""


@runtime_checkable
class ClocksAid(Aid, Protocol):
    """An aid that may measure by several clocks."""

    def of_one_clock(self) -> tuple[Aid, ...]:
        """Return what was measured by each of its clocks, itself if it has one."""


def velocity_sigma(noise: tuple[float, float], speed: Array, factor: Array | float) -> Array:
    """Return the standard deviations of velocities whose noise grows with speed, (M, d), m/s.

    Parameters
    ----------
    noise : tuple of (float, float)
        Floor, m/s, and fraction of the speed.
    speed : ndarray, shape (M, 1) or (M, d), m/s
        Speeds.
    factor : ndarray, shape (d,) or (2, d), or float
        Factors on both parts, or on each.
    """
    by_part = np.asarray(factor)
    floor, growth = by_part if by_part.ndim == 2 else (by_part, by_part)
    std = np.hypot(noise[0] * floor, noise[1] * growth * speed)
    return np.asarray(np.maximum(std, LEAST_VELOCITY_SIGMA * floor))


def lever_arm_sigma(motion: Motion, lever_arm: Array) -> Array:
    """Return the standard deviation, (M,), m/s, of omega x l from that of omega.

    Across the lever arm, (3,) or (M, 3), where it is largest.
    """
    return np.sqrt(cross_variance(motion.omega_sigma, lever_arm**2))


def observed(
    aids: Sequence[Aid], frame: LocalFrame, body_axes: BodyAxes
) -> tuple[tuple[Observation, ...], tuple[Parameter, ...]]:
    """Return the measurements and the calibration parameters of aiding sensors."""
    observations = tuple(o for aid in aids for o in aid.observations(frame, body_axes))
    return observations, tuple(p for aid in aids for p in aid.parameters())
