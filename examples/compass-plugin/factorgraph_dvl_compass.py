"""A sensor of your own as a plug-in
====================================

A magnetic compass with a bias. Once this package is installed, a trial may have a section
``compass``::

    compass: {file: compass.csv, std_deg: 1.0, declination_deg: -5.3, bias_std_deg: 10}

and a table with the columns ``time_s`` and ``heading_deg``, clockwise from magnetic north.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import (
    BodyAxes,
    rph_from_rotation,
    rph_jacobian,
    wrapped,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.parameters import SCALAR, Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    PlainObservation,
    SensorSection,
    Values,
)
from factorgraph_dvl.sensors.records import check_range, check_times
from factorgraph_dvl.settings.sections import NonNegative, Positive

# An angle wraps; files and reports have it in degrees, as the unit says.
BIAS = ParameterSpec("compass_bias", "deg", labels=SCALAR, kind="angle")


class CompassSettings(SensorSection, frozen=True, kw_only=True):
    """Section `compass` of trial.yaml."""

    file: str = "compass.csv"
    std_deg: Positive = 1.0
    declination_deg: float = 0.0
    bias_std_deg: NonNegative = 10.0


@dataclass(frozen=True)
class Compass:
    """Settings and record of the compass.

    Parameters
    ----------
    settings : CompassSettings
        Section `compass` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    heading : ndarray, shape (M,)
        Clockwise from magnetic north, rad; nan where not measured.
    source : str, optional
        Name of the file, for messages.
    """

    settings: CompassSettings
    time: Array
    heading: Array
    source: str = "compass"
    label: str = "Compass"

    section: ClassVar[str] = "compass"
    section_type: ClassVar[type[SensorSection]] = CompassSettings
    required: ClassVar[tuple[str, ...]] = ("time_s", "heading_deg")
    optional: ClassVar[tuple[tuple[str, ...], ...]] = ()
    specs: ClassVar[tuple[ParameterSpec, ...]] = (BIAS,)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        check_range({"heading_deg": self.heading / DEG}, -360.0, 360.0, "deg", self.source)

    @classmethod
    def from_columns(
        cls, settings: CompassSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record that a table holds."""
        return cls(settings, columns["time_s"], columns["heading_deg"] * DEG, source)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table."""
        return {"time_s": self.time, "heading_deg": self.heading / DEG}

    @property
    def missing(self) -> Array:
        """Rows without a heading, (M,) bool."""
        return np.isnan(self.heading)

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the bias, in SI."""
        return (Parameter(BIAS, np.zeros(1), np.array([self.settings.bias_std_deg * DEG])),)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the headings, where there are any."""
        known = np.logical_not(self.missing)
        if not known.any():
            return ()
        s = self.settings
        true_north = self.heading[known] + s.declination_deg * DEG
        return (CompassHeading(self.time[known], true_north, s.std_deg, frame, body_axes),)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> str:
        """Say why the bias could not be observed."""
        return "nothing else in the trial shows the heading: it takes GNSS and turns"


@dataclass(frozen=True)
class CompassHeading(PlainObservation):
    """Heading of a compass; zero error where measured = heading of nRb + bias.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Of the headings.
    measured : ndarray, shape (M,), rad
        Clockwise from true north.
    std_deg : float
        Standard deviation, deg.
    frame : LocalFrame
        Tangent frame n: north of the vehicle turns against it.
    body_axes : BodyAxes
        Where the bow is in body.
    """

    time: Array
    measured: Array
    std_deg: float
    frame: LocalFrame
    body_axes: BodyAxes
    label: str = "Compass heading"
    unit: str = "deg"
    components: tuple[str, ...] = ("heading",)
    parameters: tuple[str, ...] = (BIAS.name,)
    # Its noise is estimated from its residuals; it is white, on the clock of the IMU.
    noise_groups: tuple[tuple[int, ...], ...] = ((0,),)
    clock: None = None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations, (M, 1), deg."""
        return np.full((self.time.size, 1), self.std_deg) * factor

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured, (M, 1), deg, within half a turn."""
        heading = self._rph(motion)[:, 2]
        return wrapped(heading + values[BIAS.name] - self.measured)[:, None] / DEG

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        by_attitude = rph_jacobian(self._rph(motion), self.body_axes)[:, 2:, :]
        return Linearization(
            residual=self.residual(motion, values),
            d_theta=by_attitude / DEG,
            d_parameters={BIAS.name: np.full((self.time.size, 1, 1), 1.0 / DEG)},
        )

    def _rph(self, motion: Motion) -> Array:
        """Return roll, pitch and heading against the vehicle's own north, (M, 3), rad."""
        lat, lon, _ = self.frame.geodetic(motion.p_n)
        lRb = self.frame.level_from_tangent(lat, lon) @ motion.nRb
        return rph_from_rotation(lRb, self.body_axes)
