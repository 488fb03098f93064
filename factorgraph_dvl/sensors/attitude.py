"""Sensors of attitude: AHRS, gyrocompass, GNSS compass or magnetic compass."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    rph_from_rotation,
    rph_jacobian,
    wrapped,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    ObservationByRows,
    SensorSection,
    Values,
)
from factorgraph_dvl.sensors.records import (
    check_possible,
    check_range,
    check_times,
    named_columns,
    stack,
    white_noise,
)
from factorgraph_dvl.settings.sections import NonNegative, Positive, Sigma3

TILT_COLUMNS = ("roll_deg", "pitch_deg")
COLUMNS = (*TILT_COLUMNS, "heading_deg")
# Period of Schuler's pendulum, s: 2 pi sqrt(R / g), R the radius and g the gravity of the Earth.
SCHULER_PERIOD = 84.4 * 60.0
# Fewest samples whose white noise is measured. Chosen: it is then known to a third.
_FEWEST = 12
# Times the correlation time after which an error counts as another one beside an IMU: the mean of
# a Gauss-Markov process over a long time T has the variance 2 sigma² tau / T.
_APART = 2.0

HEADING_OFFSET_SPEC = ParameterSpec("heading_offset", "deg", labels=SCALAR, kind="angle")
SCHULER_SPEC = ParameterSpec("heading_schuler", "deg", labels=("cos", "sin"), nuisance=True)
DEVIATION_SPEC = ParameterSpec(
    "compass_deviation", "deg", labels=("sin_1", "cos_1", "sin_2", "cos_2"), nuisance=True
)
# Plausible deviation, deg. Chosen: that of a compass near steel that nobody compensated.
_DEVIATION_DEG = 3.0
_CLOCK = Clock.of("attitude", prefix="attitude_")

HEADING_OFFSET = HEADING_OFFSET_SPEC.name
SCHULER = SCHULER_SPEC.name
DEVIATION = DEVIATION_SPEC.name

Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class AttitudeSettings(ClockSection, frozen=True, kw_only=True):
    """Section `attitude` of trial.yaml.

    `std_deg` is the total of roll, pitch and heading; `correlated_share` of its square is a
    Gauss-Markov process. Of roll and pitch that were not measured it is how far they are from 0.
    """

    file: str = "attitude.csv"
    std_deg: Sigma3 = (0.05, 0.05, 0.2)
    heading_offset_std_deg: NonNegative = 0.0
    correlation_time_s: Positive = 300.0
    correlated_share: Share = 1.0
    schuler_std_deg: NonNegative = 0.0
    deviation_std_deg: NonNegative = 0.0
    time_offset_std_s: NonNegative = 5.0


@dataclass(frozen=True)
class AttitudeError:
    """Errors of attitudes that are the same for a while.

    Parameters
    ----------
    sigma : ndarray, shape (3,), rad
        Standard deviation of the Gauss-Markov process of roll, pitch, heading.
    tau : float
        Its correlation time, s.
    white : ndarray, shape (3,), rad
        Standard deviation of what is new in each sample.
    """

    sigma: Array
    tau: float
    white: Array

    @classmethod
    def of(cls, std_deg: tuple[float, float, float], share: float, tau: float) -> AttitudeError:
        """Return the errors that settings state: total, correlated share of the variance, time."""
        total = np.array(std_deg) * DEG
        return cls(np.sqrt(share) * total, tau, np.sqrt(1.0 - share) * total)


@dataclass(frozen=True)
class Attitude:
    """Settings and record of a sensor of attitude.

    Parameters
    ----------
    settings : AttitudeSettings
        Section `attitude` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad; nan where not measured. All of roll and pitch may be.
    source : str, optional
        Name of the file, for messages.
    """

    settings: AttitudeSettings
    time: Array
    rph: Array
    source: str = "attitude"
    label: str = "Attitude"

    section: ClassVar[str] = "attitude"
    section_type: ClassVar[type[SensorSection]] = AttitudeSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "heading_deg")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (TILT_COLUMNS,)
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(HEADING_OFFSET_SPEC, SCHULER_SPEC, DEVIATION_SPEC),
        *_CLOCK.specs,
    )
    clock: ClassVar[Clock] = _CLOCK

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        check_angles(self.rph, self.source)

    @classmethod
    def from_columns(
        cls, settings: AttitudeSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(settings, columns["time_s"], stack(columns, COLUMNS) * DEG, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        table = {"time_s": self.time, "heading_deg": self.rph[:, 2] / DEG}
        if self.measures_tilt:
            table |= named_columns(TILT_COLUMNS, self.rph[:, :2] / DEG)
        return table

    @property
    def missing(self) -> Array:
        """Rows without a heading, (M,) bool."""
        return np.isnan(self.rph[:, 2])

    @property
    def measures_tilt(self) -> bool:
        """Whether the record has roll and pitch, as that of a gyrocompass has not."""
        return not bool(np.isnan(self.rph[:, :2]).all())

    @property
    def error(self) -> AttitudeError:
        """What is stated of its errors; tilt that was not measured is new in each sample."""
        s = self.settings
        stated = AttitudeError.of(s.std_deg, s.correlated_share, s.correlation_time_s)
        if self.measures_tilt:
            return stated
        tilt = np.array([True, True, False])
        white = np.where(tilt, np.array(s.std_deg) * DEG, stated.white)
        return AttitudeError(np.where(tilt, 0.0, stated.sigma), stated.tau, white)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return heading offset, Schuler oscillation, compass deviation and the clock."""
        s = self.settings
        deviation = DEVIATION_SPEC
        if self._turns:
            deviation = replace(deviation, plausible=_DEVIATION_DEG)
        return (
            *(
                Parameter(spec, np.zeros(spec.size), np.full(spec.size, std * DEG))
                for spec, std in (
                    (HEADING_OFFSET_SPEC, s.heading_offset_std_deg),
                    (SCHULER_SPEC, s.schuler_std_deg),
                    (deviation, s.deviation_std_deg),
                )
            ),
            *_CLOCK.parameters(s),
        )

    @property
    def _turns(self) -> bool:
        """Whether there are headings enough to show a deviation: its four numbers, and an offset.

        On a straight run anything that follows the heading, as a lag, looks like one.
        """
        heading = self.rph[:, 2]
        octants = np.floor(heading[np.isfinite(heading)] / (0.25 * np.pi)) % 8.0
        return np.unique(octants).size > DEVIATION_SPEC.size

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return attitudes that are far enough apart to have errors of their own."""
        tilt = self.measures_tilt
        measured = ~np.isnan(self.rph if tilt else self.rph[:, 2:])
        known = np.asarray(measured.all(axis=1))
        error = self.error
        rows = spaced(self.time, known, _APART * error.tau if error.sigma.any() else 0.0)
        if not rows.size:
            return ()
        total = np.hypot(error.sigma, error.white)
        rph = self.rph[rows]
        std = np.where(np.isnan(rph), np.inf, np.maximum(total, LEAST_STD))
        angles = AttitudeAngles(self.time[rows], np.nan_to_num(rph), std, frame, body_axes, _CLOCK)
        return (angles,)

    def dense_observations(
        self, frame: LocalFrame, body_axes: BodyAxes
    ) -> tuple[Observation, ...]:
        """Return all attitudes: their lasting error is a process beside the noise of each."""
        tilt = self.measures_tilt
        rows = np.flatnonzero(~np.isnan(self.rph[:, 2]))
        rph = self.rph[rows].copy()
        if not tilt:
            rph[:, :2] = 0.0
        own = dense_angles(
            self.time[rows], rph, self.error, frame, body_axes, _CLOCK, self.label, measured=tilt
        )
        return (own,)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why an error of the attitude or its clock could not be observed."""
        if parameter in _CLOCK.names:
            return message("not_observable.clock_by_attitude")
        if parameter == HEADING_OFFSET:
            return message("not_observable.heading_offset")
        return message("not_observable.all_headings")


# Stands for a standard deviation of 0 of an angle, rad. Chosen: far below what is measured.
LEAST_STD = 1e-6


def check_angles(rph: Array, source: str) -> None:
    """Raise DataError where roll, pitch and heading (M, 3), rad, cannot be."""
    columns = named_columns(COLUMNS, rph / DEG)
    check_range({"pitch_deg": columns["pitch_deg"]}, -90.0, 90.0, "deg", source)
    check_possible(columns, source)


def spaced(time: Array, usable: NDArray[np.bool_], apart: float) -> NDArray[np.int_]:
    """Return indices of usable times (M,) that are at least so many seconds apart."""
    at = np.flatnonzero(usable)
    if apart <= 0.0 or not at.size:
        return at
    bins = np.floor((time[at] - time[at[0]]) / apart)
    return np.asarray(at[np.unique(bins, return_index=True)[1]])


def heading_error(
    time: Array, heading: Array, values: Values, zero: float
) -> tuple[Array, dict[str, Array]]:
    """Return the lasting error of a heading, (M,), rad, and its derivatives, (M, n) by name.

        e = o + a cos w (t - t0) + b sin w (t - t0)
          + d1 sin h + d2 cos h + d3 sin 2 h + d4 cos 2 h

    The deviation is A. Smith's formula (Admiralty Manual for the Deviations of the Compass).

    Parameters
    ----------
    time, heading : ndarray, shape (M,)
        Times, s, and headings of the body, rad.
    values : mapping of str to ndarray
        Heading offset o, Schuler oscillation (a, b) and deviation d by name, rad; those that are
        absent are zero.
    zero : float, s
        Time t0.
    """
    phase = 2.0 * np.pi / SCHULER_PERIOD * (time - zero)
    by = {
        HEADING_OFFSET: np.ones((time.size, 1)),
        SCHULER: np.stack([np.cos(phase), np.sin(phase)], axis=1),
        DEVIATION: np.stack(
            [np.sin(heading), np.cos(heading), np.sin(2.0 * heading), np.cos(2.0 * heading)],
            axis=1,
        ),
    }
    by = {name: matrix for name, matrix in by.items() if name in values}
    total = np.zeros(time.size)
    for name, matrix in by.items():
        total += matrix @ values[name]
    return total, by


def heading_error_slope(heading: Array, values: Values) -> Array:
    """Return the derivative of `heading_error` by the heading, (M,): that of the deviation."""
    if DEVIATION not in values:
        return np.zeros(heading.size)
    sin, cos, sin_2, cos_2 = values[DEVIATION]
    once = sin * np.cos(heading) - cos * np.sin(heading)
    return np.asarray(once + 2.0 * (sin_2 * np.cos(2.0 * heading) - cos_2 * np.sin(2.0 * heading)))


def dense_angles(
    time: Array,
    rph: Array,
    error: AttitudeError,
    frame: LocalFrame,
    body_axes: BodyAxes,
    clock: Clock,
    label: str,
    parameters: tuple[str, ...] | None = None,
    *,
    measured: bool = True,
) -> AttitudeAngles:
    """Return attitudes (M, 3) whose errors persist, with the noise that is new in each.

    That is at least the noise of the record; roll and pitch are new in each if not `measured`.
    """
    known = np.asarray(~np.isnan(rph).any(axis=1))
    white = error.white
    if known.sum() >= _FEWEST:
        own = white_noise(np.unwrap(rph[known], axis=0))
        white = np.maximum(white, own if measured else own * [0.0, 0.0, 1.0])
    std = np.where(np.isnan(rph), np.inf, np.maximum(white, LEAST_STD))
    return AttitudeAngles(
        time,
        np.nan_to_num(rph),
        std,
        frame,
        body_axes,
        clock,
        label=label,
        parameters=AttitudeAngles.parameters if parameters is None else parameters,
        noise_groups=((0,), (1,), (2,)) if measured else ((2,),),
        correlated=ExpectedCorrelation(error.tau, error.sigma) if error.sigma.any() else None,
    )


@dataclass(frozen=True)
class AttitudeAngles(ObservationByRows):
    """Roll, pitch and heading; zero error where measured = angles of nRb + heading error.

    The deviation of a compass is that at the heading of the body. One of the measured heading
    would need the density of the numbers as recorded: without it, a deviation that undoes the
    turns of a ship makes its motion smoother, and so likelier.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the samples.
    measured : ndarray, shape (M, 3), rad
        Roll, pitch, heading.
    std : ndarray, shape (M, 3), rad
        Infinite where not measured.
    frame : LocalFrame
        Tangent frame n.
    body_axes : BodyAxes
        Axes of the body.
    clock : Clock
        Clock of the sensor.
    label : str, optional
        Name of the measurement.
    """

    time: Array
    measured: Array
    std: Array
    frame: LocalFrame
    body_axes: BodyAxes
    clock: Clock
    label: str = "Attitude"
    unit: str = "rad"
    components: tuple[str, ...] = ("roll", "pitch", "heading")
    parameters: tuple[str, ...] = (HEADING_OFFSET, SCHULER, DEVIATION)
    noise_groups: tuple[tuple[int, ...], ...] = ()
    correlated: ExpectedCorrelation | None = None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, (M, 3), rad."""
        return self.std * np.where(np.isinf(self.std), 1.0, factor)

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 3), rad."""
        return self._predict(motion, values)[0]

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        residual, rph, by = self._predict(motion, values)
        by_rotation = rph_jacobian(rph, self.body_axes)
        by_rotation[:, 2] *= 1.0 + heading_error_slope(rph[:, 2], self._own(values))[:, None]
        found = {}
        for name in self.parameters:
            if name in wanted:
                found[name] = np.zeros((*residual.shape, by[name].shape[1]))
                found[name][:, 2] = by[name]
        return Linearization(residual, by_rotation, d_parameters=found)

    def _predict(self, motion: Motion, values: Values) -> tuple[Array, Array, dict[str, Array]]:
        lat, lon, _ = self.frame.geodetic(motion.p_n)
        lRb = self.frame.level_from_tangent(lat, lon) @ motion.nRb
        rph = rph_from_rotation(lRb, self.body_axes)
        lasting, by = heading_error(self.time, rph[:, 2], self._own(values), 0.0)
        predicted = rph + lasting[:, None] * np.array([0.0, 0.0, 1.0])
        return wrapped(predicted - self.measured), rph, by

    def _own(self, values: Values) -> dict[str, Array]:
        """Return the values of the errors of this heading."""
        return {name: values[name] for name in self.parameters if name in values}
