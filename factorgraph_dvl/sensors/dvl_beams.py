"""The single beams of a Doppler velocity log: settings, record, radial velocities."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, cross, rotate, skew
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.averaging import (
    Stamp,
    averaging_spec,
    stamp_in_the_middle,
    usual_parameter,
)
from factorgraph_dvl.sensors.beam_model import CommonGeometry, FreeGeometry, Geometry
from factorgraph_dvl.sensors.clock import Clock, ClockSection
from factorgraph_dvl.sensors.dvl import (
    AVERAGING,
    AVERAGING_SPEC,
    CLOCK,
    LEVER_ARM_SPEC,
    MISALIGNMENT_SPEC,
    SCALE_SPEC,
)
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    ScaleWalk,
    SensorSection,
    Values,
    lever_arm_sigma,
    velocity_sigma,
)
from factorgraph_dvl.sensors.records import check_range, check_times, named_columns, stack
from factorgraph_dvl.settings.sections import NonNegative, Sigma3, Vector3

# Chosen: no instrument has more.
MOST_BEAMS = 16


def direction_spec(count: int) -> ParameterSpec:
    """Return what the directions of so many beams are."""
    labels = tuple(f"{i}{axis}" for i in range(1, count + 1) for axis in "xy")
    return ParameterSpec(
        "beam_direction", "deg", labels, kind="directions", frame="b", place=0, limit=0.1
    )


def scale_spec(count: int) -> ParameterSpec:
    """Return what the scale errors of so many beams are."""
    labels = tuple(str(i) for i in range(1, count + 1))
    return ParameterSpec("beam_scale_error", "", labels, place=1, limit=1e-3, above=-1.0)


def of_beams(spec: ParameterSpec, prefix: str) -> ParameterSpec:
    """Return a parameter of a DVL as that of its beams, with a prefix before its name."""
    stem = f"{prefix}{spec.stem}"
    if stem == scale_spec(1).stem:
        return replace(scale_spec(1), labels=SCALAR)
    return replace(spec, stem=stem, place=None, limit=None) if prefix else spec


# Names of the parameters of beams that have directions and scales of their own.
DIRECTION = direction_spec(1).name
SCALE_ERROR = scale_spec(1).name
# Of the parameters that a DVL beside the beams has under the same names.
BEAM_PREFIX = "beam_"
_OWN_CLOCK = Clock.of("beam", prefix=BEAM_PREFIX, section="dvl_beams")
_OWN_AVERAGING = averaging_spec(BEAM_PREFIX)

Angle = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Acute = Annotated[float, msgspec.Meta(ge=0, le=90)]

# Sine of the angle to one plane up to which beams do not determine a velocity, and what the norm
# of a stated direction may differ from 1 by. Chosen: 3 degrees; two digits.
_LEAST_SPREAD = 0.05
_UNIT = 0.05
_ROUNDING = 1e-12
# Signs of x and y in the octants V to VIII, below the plane of x and y.
_OCTANTS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


class DvlBeamsSettings(ClockSection, frozen=True, kw_only=True):
    """Section `dvl_beams` of trial.yaml."""

    file: str = "dvl_beams.csv"
    directions: tuple[Vector3, ...] | UnsetType = UNSET
    slant_azimuth_deg: tuple[tuple[Acute, Angle], ...] | UnsetType = UNSET
    alpha_theta_deg: tuple[tuple[Acute, Acute], ...] | UnsetType = UNSET
    misalignment_deg: Vector3 = (0.0, 0.0, 0.0)
    parametrisation: Literal["beams", "common"] = "beams"
    misalignment_std_deg: Sigma3 | UnsetType = UNSET
    direction_std_deg: NonNegative = 1.0
    scale_error: float | tuple[float, ...] = 0.0
    scale_error_std: NonNegative = 0.02
    lever_arm_m: Vector3 = (0.0, 0.0, 0.0)
    lever_arm_std_m: Sigma3 = (3.0, 3.0, 3.0)
    time_offset_std_s: NonNegative = 0.5
    velocity_std_m_s: NonNegative = 0.005
    velocity_std_fraction: NonNegative = 0.002
    averaging_s: NonNegative = 0.0
    averaging_std_s: NonNegative | UnsetType = UNSET
    stamp: Stamp = "middle"

    @property
    def left_out(self) -> tuple[str, ...]:
        """The window, where there is one."""
        return ("averaging_s",) if self.averaging_s > 0.0 else ()

    def __post_init__(self) -> None:
        super().__post_init__()
        ways = {
            "directions": self.directions,
            "slant_azimuth_deg": self.slant_azimuth_deg,
            "alpha_theta_deg": self.alpha_theta_deg,
        }
        given = [name for name, value in ways.items() if value is not UNSET]
        if len(given) != 1:
            found = " and ".join(f"`{name}`" for name in given) or "none of them"
            raise ValueError(
                "the beams' nominal directions must be given one way, as `directions`, "
                f"`slant_azimuth_deg` or `alpha_theta_deg`; found {found}"
            )
        beams = self.nominal_d
        name = given[0]
        if len(beams) < 3 or np.linalg.svd(beams, compute_uv=False)[2] < _LEAST_SPREAD:
            raise ValueError(
                f"`{name}` must contain three or more beams that are not in one plane"
            )
        scale = np.atleast_1d(self.scale_error)
        if scale.size not in (1, len(beams)):
            raise ValueError(f"`scale_error` must have one number, or {len(beams)}")
        if np.any(scale <= -1.0):
            raise ValueError("`scale_error` must be above -1")
        common = self.parametrisation == "common"
        if common and scale.size != 1:
            raise ValueError("`scale_error` must be one number with `parametrisation: common`")
        if self.misalignment_std_deg is not UNSET and not common:
            raise ValueError(
                "`misalignment_std_deg` cannot be used if each beam has its own direction; it "
                "belongs to `parametrisation: common`"
            )

    @property
    def nominal_d(self) -> Array:
        """Nominal unit vectors of the beams in d, (N, 3)."""
        if not isinstance(self.directions, UnsetType):
            vectors = np.array(self.directions, dtype=float).reshape(-1, 3)
            length = np.linalg.norm(vectors, axis=1)
            worst = int(np.argmax(np.abs(length - 1.0))) if length.size else 0
            if length.size and abs(length[worst] - 1.0) > _UNIT:
                raise ValueError(
                    "`directions` must contain unit vectors; the vector of "
                    f"beam {worst + 1} has the length {length[worst]:.3g}"
                )
            return np.asarray(vectors / length[:, None])
        if not isinstance(self.slant_azimuth_deg, UnsetType):
            slant, azimuth = np.array(self.slant_azimuth_deg).reshape(-1, 2).T * DEG
            level = np.sin(slant)
            return np.stack(
                [level * np.sin(azimuth), level * np.cos(azimuth), -np.cos(slant)], axis=1
            )
        assert not isinstance(self.alpha_theta_deg, UnsetType)
        alpha, theta = np.array(self.alpha_theta_deg).reshape(-1, 2).T * DEG
        if alpha.size != 4:
            raise ValueError("`alpha_theta_deg` must contain four beams, in octants V to VIII")
        # A beam in the xz plane may be beyond it by rounding.
        y2 = np.cos(alpha + theta) * np.cos(alpha - theta)
        if np.any(y2 < -_ROUNDING):
            beam = int(np.argmin(y2)) + 1
            raise ValueError(
                f"`alpha_theta_deg` must not add up to more than 90 deg; those of beam {beam} do"
            )
        x, z = np.sin(alpha), -np.sin(theta)
        y = np.sqrt(np.maximum(y2, 0.0))
        return np.stack([_OCTANTS[:, 0] * x, _OCTANTS[:, 1] * y, z], axis=1)

    @property
    def more_columns(self) -> tuple[str, ...]:
        """Columns of the beams."""
        return beam_columns(len(self.nominal_d))


def beam_columns(count: int) -> tuple[str, ...]:
    """Return the names of the columns of so many beams."""
    return tuple(f"beam{i}_m_s" for i in range(1, count + 1))


@dataclass(frozen=True)
class DvlBeams:
    """Settings and record of the beams of a DVL.

    Parameters
    ----------
    settings : DvlBeamsSettings
        Section `dvl_beams` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    velocity : ndarray, shape (M, N)
        Velocity of the transducer along each beam's outward direction, m/s; nan = beam lost.
    source : str, optional
        Name of the file, for messages.
    prefix : str, optional
        Prefix of the parameters that a `dvl` beside it has under the same names.
    """

    settings: DvlBeamsSettings
    time: Array
    velocity: Array
    source: str = "dvl_beams"
    label: str = "DVL beams"
    prefix: str = ""

    section: ClassVar[str] = "dvl_beams"
    section_type: ClassVar[type[SensorSection]] = DvlBeamsSettings
    required: ClassVar[tuple[str, ...]] = ("time_s",)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (
        *(of_beams(spec, BEAM_PREFIX) for spec in (MISALIGNMENT_SPEC, SCALE_SPEC, LEVER_ARM_SPEC)),
        *_OWN_CLOCK.specs,
        *(direction_spec(count) for count in range(3, MOST_BEAMS + 1)),
        *(scale_spec(count) for count in range(3, MOST_BEAMS + 1)),
    )

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        stamp_in_the_middle(self)
        beams = named_columns(self.settings.more_columns, self.velocity)
        check_range(beams, -50.0, 50.0, "m/s", self.source)

    @classmethod
    def from_columns(
        cls, settings: DvlBeamsSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table."""
        return cls(settings, columns["time_s"], stack(columns, settings.more_columns), source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, **named_columns(self.settings.more_columns, self.velocity)}

    @property
    def missing(self) -> Array:
        """Pings at which every beam was lost, (M,) bool."""
        return np.asarray(np.isnan(self.velocity).all(axis=1))

    @property
    def nominal_b(self) -> Array:
        """Nominal unit vectors of the beams in body, (N, 3)."""
        dRb = exp_so3(np.array(self.settings.misalignment_deg) * DEG)
        return np.asarray(self.settings.nominal_d @ dRb)

    def sigma(self) -> Array:
        """Return the standard deviations sqrt(floor² + (fraction v)²), (M, N), m/s.

        v is the beam's own velocity; nan where the beam was lost.
        """
        s = self.settings
        noise = s.velocity_std_m_s, s.velocity_std_fraction
        return velocity_sigma(noise, self.velocity, 1.0)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return directions or misalignment, scale errors, lever arm, clock and window."""
        clock = self.clock.parameters(self.settings)
        return (*self.mounting_parameters(), *clock, self.window_length)

    def mounting_parameters(self) -> tuple[Parameter, Parameter, Parameter]:
        """Return directions or misalignment, scale errors and lever arm."""
        s = self.settings
        lever_arm = Parameter(
            of_beams(LEVER_ARM_SPEC, self.prefix),
            np.array(s.lever_arm_m),
            np.array(s.lever_arm_std_m),
        )
        if s.parametrisation == "common":
            std = s.misalignment_std_deg
            sigma = [s.direction_std_deg] * 3 if isinstance(std, UnsetType) else std
            return (
                Parameter(
                    of_beams(MISALIGNMENT_SPEC, self.prefix),
                    np.array(s.misalignment_deg) * DEG,
                    np.array(sigma) * DEG,
                ),
                Parameter(
                    of_beams(SCALE_SPEC, self.prefix),
                    np.atleast_1d(np.array(s.scale_error, dtype=float)),
                    np.array([s.scale_error_std]),
                ),
                lever_arm,
            )
        n = len(self.nominal_b)
        scale = np.broadcast_to(np.array(s.scale_error, dtype=float), (n,))
        return (
            Parameter(
                direction_spec(n),
                np.zeros(2 * n),
                np.full(2 * n, s.direction_std_deg * DEG),
                nominal=self.nominal_b,
            ),
            Parameter(scale_spec(n), scale.copy(), np.full(n, s.scale_error_std)),
            lever_arm,
        )

    @property
    def clock(self) -> Clock:
        """Clock of the instrument, that of the DVL unless a `dvl` stands beside it."""
        return _OWN_CLOCK if self.prefix else CLOCK

    @property
    def window_length(self) -> Parameter:
        """Length of the window over which the instrument averages."""
        s = self.settings
        spec = _OWN_AVERAGING if self.prefix else AVERAGING_SPEC
        return usual_parameter(spec, s.averaging_s, s.averaging_std_s)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the pings at which at least one beam was not lost."""
        m = np.logical_not(self.missing)
        if not m.any():
            return ()
        misalignment, scale, lever_arm = (p.name for p in self.mounting_parameters())
        geometry: Geometry = (
            CommonGeometry(self.settings.nominal_d, misalignment, scale)
            if self.settings.parametrisation == "common"
            else FreeGeometry(self.nominal_b, misalignment, scale)
        )
        lost = np.isnan(self.velocity[m])
        measured = np.where(lost, 0.0, self.velocity[m])
        s = self.settings
        noise = (s.velocity_std_m_s, s.velocity_std_fraction)
        return (
            BeamVelocity(
                self.time[m],
                measured,
                lost,
                noise,
                geometry,
                lever_arm,
                self.clock,
                self.window_length.name,
            ),
        )

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component could not be observed, given the motion of the trial."""
        if motion is None or motion.v_n.shape[0] < 2:
            return message("not_observable.no_beam")
        if parameter in self.clock.names:
            return message("not_observable.clock")
        received = np.flatnonzero(~np.isnan(self.velocity).all(axis=0)) + 1
        if parameter == of_beams(LEVER_ARM_SPEC, self.prefix).name:
            if received.size < 3:
                return message("not_observable.few_beams", beams=received)
            rates = np.degrees(np.std(motion.omega_eb_b, axis=0))
            return message("not_observable.lever_arm", rates=rates)
        of_a_beam = {DIRECTION: component // 2, SCALE_ERROR: component}
        if self.settings.parametrisation == "beams":
            beam = of_a_beam[parameter]
            if beam + 1 not in received:
                return message("not_observable.beam_lost", beam=beam + 1)
        v_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        return message("not_observable.beam", speeds=np.sqrt(np.mean(v_b**2, axis=0)))


@dataclass(frozen=True)
class BeamVelocity:
    """Radial velocities of the beams of a DVL.

    The error is zero where

        v_i = (1 + k_i) d_i^T (nRb^T v_n + omega_eb_b x l)

    with d_i the outward direction of beam i in body. A lost beam has an infinite standard
    deviation, so that any number of valid ones counts.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the pings.
    measured : ndarray, shape (M, N), m/s
        Velocities along the beams; any number where lost.
    lost : ndarray of bool, shape (M, N)
        Whether a beam was lost.
    noise : tuple of (float, float)
        Floor, m/s, and fraction of the beam's velocity.
    geometry : Geometry
        Directions and scales.
    lever_arm : str
        Name of the parameter.
    clock : Clock
        Clock of the instrument.
    averaging, averages_in_body : optional
        Name of the length of the window over which it averages.
    """

    time: Array
    measured: Array
    lost: Array
    noise: tuple[float, float]
    geometry: Geometry
    lever_arm: str
    clock: Clock = CLOCK
    averaging: str | None = AVERAGING
    averages_in_body: bool = True
    label: str = "Beam velocity"
    unit: str = "m/s"
    gate: float | None = None
    correlated: ExpectedCorrelation | None = None
    scale_walk: ScaleWalk | None = None

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the beams."""
        return tuple(f"beam {i}" for i in range(1, self.measured.shape[1] + 1))

    @property
    def independent(self) -> bool:
        """Whether components are measured apart: one beam may lock on a fish alone."""
        return True

    @property
    def noise_groups(self) -> tuple[tuple[int, ...], ...]:
        """Each beam by itself."""
        return tuple((i,) for i in range(self.measured.shape[1]))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of directions or misalignment, scale and lever arm."""
        return (*self.geometry.parameters, self.lever_arm)

    @property
    def noise_by_speed(self) -> tuple[float, float] | None:
        """Standard deviation that is constant, m/s, and what grows, over the velocity."""
        return self.noise if min(self.noise) > 0.0 else None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, the gyro's share through the lever arm included.

        By the predicted velocity: by the measured one, pings whose noise makes them smaller
        would count more, and the scale would come out too small by twice the squared fraction.
        """
        predicted = self.residual(motion, values) + self.measured
        std = velocity_sigma(self.noise, predicted, factor)
        std = np.hypot(std, lever_arm_sigma(motion, values[self.lever_arm])[:, None])
        return np.where(self.lost, np.inf, std)

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, N), m/s."""
        dvl_b, _ = self._velocities(motion, values)
        return dvl_b @ self.geometry.gain(values).T - self.measured

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        dvl_b, imu_b = self._velocities(motion, values)
        gain = self.geometry.gain(values)
        found = self.geometry.derivatives(values, dvl_b)
        found[self.lever_arm] = gain @ skew(motion.omega_eb_b)
        d_omega = -gain @ skew(values[self.lever_arm])
        return Linearization(
            residual=dvl_b @ gain.T - self.measured,
            d_theta=gain @ skew(imu_b),
            d_v=gain @ motion.nRb.transpose(0, 2, 1),
            d_omega=np.broadcast_to(d_omega, (len(dvl_b), *d_omega.shape)),
            d_parameters={name: found[name] for name in found if name in wanted},
        )

    def _velocities(self, motion: Motion, values: Values) -> tuple[Array, Array]:
        """Return the velocities of DVL and IMU in body, (M, 3)."""
        imu_b = rotate(motion.nRb.transpose(0, 2, 1), motion.v_n)
        return imu_b + cross(motion.omega_eb_b, values[self.lever_arm]), imu_b
