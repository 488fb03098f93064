"""The star tracker: attitude of its axes in inertial space, or the star vectors for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.celestial import (
    attitudes_from_vectors,
    earth_from_inertial,
    spread,
)
from factorgraph_dvl.geometry.earth import LocalFrame, enu_from_ecef
from factorgraph_dvl.geometry.rotations import BodyAxes, inverse_right_jacobian, log_so3
from factorgraph_dvl.geometry.units import ARCSEC, DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import (
    Attitudes,
    Linearization,
    Motion,
    Observation,
    PlainObservation,
    SensorSection,
    Values,
)
from factorgraph_dvl.sensors.records import (
    at_row,
    check_all_or_none,
    check_finite,
    check_times,
    named_columns,
    stack,
)
from factorgraph_dvl.settings.sections import Sigma3, Vector3

QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
VECTOR_COLUMNS = ("body_x", "body_y", "body_z", "inertial_x", "inertial_y", "inertial_z")

_MOUNTING = ParameterSpec("star_mounting", "deg", kind="rotation", frame="b")
MOUNTING = _MOUNTING.name

# By how much the norm of a quaternion may differ from 1. Chosen: what four decimals leave of it.
_NORM = 1e-3
# Vectors closer to one line than this, rad, are parallel. Chosen: they show the rotation about
# themselves a thousand times less well than the other two.
_PARALLEL = 1e-3


class StarSettings(SensorSection, frozen=True, kw_only=True):
    """Section `star` of trial.yaml."""

    file: str = "star.csv"
    std_arcsec: float | Vector3 = 5.0
    ut1_utc_s: Annotated[float, msgspec.Meta(ge=-1, le=1)] = 0.0
    mounting_deg: Vector3 = (0.0, 0.0, 0.0)
    mounting_std_deg: Sigma3 = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.min(self.std_arcsec) <= 0.0:
            raise ValueError("`std_arcsec` must be above 0")


@dataclass(frozen=True)
class StarVectors:
    """Directions to stars, several at a time, that attitudes were found from.

    Parameters
    ----------
    time : ndarray, shape (K,)
        Not decreasing, s; rows of one time belong together.
    body, inertial : ndarray, shape (K, 3)
        Unit vectors in the tracker's axes and in GCRS.
    """

    time: Array
    body: Array
    inertial: Array

    @property
    def first(self) -> np.ndarray:
        """First row of each epoch, (M,)."""
        return np.flatnonzero(np.append(True, np.diff(self.time) > 0.0))


@dataclass(frozen=True)
class Star:
    """Settings and record of the star tracker.

    Parameters
    ----------
    settings : StarSettings
        Section `star` of trial.yaml.
    time : ndarray, shape (M,), s
        Strictly increasing.
    quaternion : ndarray, shape (M, 4)
        Scalar first, of iRs: the tracker's axes to GCRS; nan where not measured.
    covariance : ndarray, shape (M, 3, 3), rad²
        Covariances of phi in iRs Exp(phi).
    source : str, optional
        Name of the file, for messages.
    vectors : StarVectors, optional
        What the attitudes were found from, None if they were measured as such.
    """

    settings: StarSettings
    time: Array
    quaternion: Array
    covariance: Array
    source: str = "star"
    vectors: StarVectors | None = None
    label: str = "Star tracker"

    section: ClassVar[str] = "star"
    section_type: ClassVar[type[SensorSection]] = StarSettings
    required: ClassVar[tuple[str, ...]] = ("time_s",)
    optional: ClassVar[tuple[tuple[str, ...], ...]] = (QUATERNION_COLUMNS, VECTOR_COLUMNS)
    specs: ClassVar[tuple[ParameterSpec, ...]] = (_MOUNTING,)

    def __post_init__(self) -> None:
        check_times(self.time, self.source)
        check_all_or_none(named_columns(QUATERNION_COLUMNS, self.quaternion), self.source)
        norm = np.linalg.norm(self.quaternion, axis=1)
        bad = np.flatnonzero(np.abs(norm - 1.0) > _NORM)
        if bad.size:
            raise DataError(
                f"the quaternion has norm {norm[bad[0]]:.6g}",
                where=at_row(self.source, bad[0]),
                expected=f"a unit quaternion, to {_NORM:g}",
            )

    @classmethod
    def from_columns(
        cls, settings: StarSettings, columns: Mapping[str, Array], source: str
    ) -> Self:
        """Return the record in a table: quaternions, or vectors."""
        time = columns["time_s"]
        quaternion, vectors = (stack(columns, group) for group in cls.optional)
        as_vectors = not np.isnan(vectors).all()
        if as_vectors != np.isnan(quaternion).all():
            raise DataError(
                "there are both quaternions and star vectors"
                if as_vectors
                else "there are neither quaternions nor star vectors",
                where=source,
                expected=f"columns {', '.join(QUATERNION_COLUMNS)}, or star, "
                f"{', '.join(VECTOR_COLUMNS)}",
            )
        if as_vectors:
            return cls.from_vectors(settings, time, vectors[:, :3], vectors[:, 3:], source)
        variance = (np.broadcast_to(settings.std_arcsec, 3) * ARCSEC) ** 2
        covariance = np.tile(np.diag(variance), (time.size, 1, 1))
        return cls(settings, time, quaternion, covariance, source)

    @classmethod
    def from_vectors(
        cls, settings: StarSettings, time: Array, body: Array, inertial: Array, source: str
    ) -> Self:
        """Return the record of attitudes that star vectors give, by Wahba's problem.

        Parameters
        ----------
        settings : StarSettings
            Its standard deviation is that of a direction, per axis across it.
        time : ndarray, shape (K,)
            Not decreasing, s; rows of one time belong together.
        body, inertial : ndarray, shape (K, 3)
            Directions in the tracker's axes and in GCRS, of any length.
        source : str
            Name of the file, for messages.

        Raises
        ------
        DataError
            If the vectors of an epoch are all parallel, or a vector is not one.
        """
        if np.ndim(settings.std_arcsec) != 0:
            raise ConfigError(
                "`std_arcsec` has three components, but star vectors need one number",
                where="trial.yaml star.std_arcsec",
                expected="one number",
            )
        _check_vectors(time, body, inertial, source)
        body = body / np.linalg.norm(body, axis=1, keepdims=True)
        inertial = inertial / np.linalg.norm(inertial, axis=1, keepdims=True)
        vectors = StarVectors(time, body, inertial)
        first = vectors.first
        for kind, directions in (("body", body), ("inertial", inertial)):
            bad = np.flatnonzero(spread(directions, first) < _PARALLEL)
            if bad.size:
                rows = np.append(first, time.size)[bad[0] : bad[0] + 2]
                lines = (
                    at_row(source, rows[0])
                    if rows[1] - rows[0] == 1
                    else f"{source} lines {rows[0] + 2} to {rows[1] + 1}"
                )
                raise DataError(
                    f"all {kind} vectors at {time[rows[0]]:.9g} s are parallel, so the rotation "
                    "about them is unknown",
                    where=lines,
                    expected="at least two directions at every time",
                )
        rotation, unit = attitudes_from_vectors(body, inertial, first)
        sigma = float(np.max(settings.std_arcsec)) * ARCSEC
        quaternion = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
        return cls(settings, time[first], quaternion, sigma**2 * unit, source, vectors)

    def columns(self) -> dict[str, Array]:
        """Return the record as a table; stars are numbered anew at each time."""
        v = self.vectors
        if v is None:
            quaternion = named_columns(QUATERNION_COLUMNS, self.quaternion)
            return {"time_s": self.time, **quaternion}
        count = np.diff(np.append(v.first, v.time.size))
        number = np.arange(v.time.size) - np.repeat(v.first, count) + 1.0
        both = named_columns(VECTOR_COLUMNS, np.hstack([v.body, v.inertial]))
        return {"time_s": v.time, "star": number, **both}

    @property
    def missing(self) -> Array:
        """Epochs without an attitude, (M,) bool."""
        return np.isnan(self.quaternion[:, 0])

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the mounting, the rotation vector of C_b^s."""
        s = self.settings
        mean, sigma = np.array(s.mounting_deg) * DEG, np.array(s.mounting_std_deg) * DEG
        return (Parameter(_MOUNTING, mean, sigma),)

    def attitudes(self, frame: LocalFrame) -> Attitudes:
        """Return the tracker's attitude in `frame`, and how it is mounted.

        Raises
        ------
        ConfigError
            If the trial has no epoch.
        """
        known = np.logical_not(self.missing)
        time = self.time[known]
        iRs = Rotation.from_quat(self.quaternion[known][:, [1, 2, 3, 0]]).as_matrix()
        nRe = enu_from_ecef(frame.lat, frame.lon)
        eRi = earth_from_inertial(frame.epoch, time, self.settings.ut1_utc_s)
        best = np.linalg.eigvalsh(self.covariance[known])[:, 0]
        nRs = nRe @ eRi @ iRs
        return Attitudes(time, nRs, np.sqrt(best), self.parameters()[0])

    @property
    def misfit(self) -> float:
        """Angles between stars against the catalogue's: rms over its expectation.

        The square is the loss of Wahba's problem over sigma² and the degrees of freedom: two
        components across each direction, less three of each attitude. nan where the record
        contains attitudes.
        """
        v = self.vectors_of_epochs
        if v is None:
            return np.nan
        freedom = 2 * v.time.size - 3 * self.time.size
        return float(np.sqrt(np.sum(self.star_misfits() ** 2) / freedom))

    @property
    def vectors_of_epochs(self) -> StarVectors | None:
        """Vectors of the record's epochs; None where they are not those of every epoch.

        Some rows of a record keep all vectors, and joined ones those of the first.
        """
        v = self.vectors
        if v is None:
            return None
        rows = np.isin(v.time, self.time)
        v = StarVectors(v.time[rows], v.body[rows], v.inertial[rows])
        return v if np.array_equal(v.time[v.first], self.time) else None

    def star_misfits(self) -> Array:
        """Return the angles from the catalogue's directions to the measured ones, (K,), sigmas."""
        v = self.vectors_of_epochs
        assert v is not None
        count = np.diff(np.append(v.first, v.time.size))
        iRs = Rotation.from_quat(np.repeat(self.quaternion[:, [1, 2, 3, 0]], count, axis=0))
        apart = np.linalg.norm(iRs.apply(v.body) - v.inertial, axis=1)
        return apart / (float(np.max(self.settings.std_arcsec)) * ARCSEC)

    def observations(self, frame: LocalFrame, body_axes: BodyAxes) -> tuple[Observation, ...]:
        """Return the attitudes that were measured.

        Raises
        ------
        ConfigError
            If the trial has no epoch.
        """
        known = np.logical_not(self.missing)
        if not known.any():
            return ()
        found = self.attitudes(frame)
        variance, axes = np.linalg.eigh(self.covariance[known])
        if self.vectors is None:
            variance, axes = np.diagonal(self.covariance[known], axis1=1, axis2=2), np.eye(3)
            axes = np.broadcast_to(axes, found.nRs.shape)
        components = ("x", "y", "z") if self.vectors is None else ("best", "middle", "worst")
        std = np.sqrt(variance) / ARCSEC
        return (StarAttitude(found.time, found.nRs, axes, std, components),)

    def explain(self, parameter: str, component: int, motion: Motion | None) -> Message:
        """Say why a component of the mounting could not be observed."""
        if motion is None or motion.nRb.shape[0] < 2:
            return message("not_observable.no_star")
        rates = np.degrees(np.std(motion.omega_eb_b, axis=0))
        return message("not_observable.star_mounting", rates=rates)


def _check_vectors(time: Array, body: Array, inertial: Array, source: str) -> None:
    """Raise DataError unless times do not decrease and all vectors have a direction."""
    bad = np.flatnonzero(np.diff(time) < 0.0)
    if bad.size:
        raise DataError(
            f"time_s decreases ({time[bad[0]]:.9g} is followed by {time[bad[0] + 1]:.9g})",
            where=at_row(source, bad[0] + 1),
            expected="all stars of one time together, times increasing",
        )
    for kind, vectors, names in (
        ("body", body, VECTOR_COLUMNS[:3]),
        ("inertial", inertial, VECTOR_COLUMNS[3:]),
    ):
        check_finite(named_columns(names, vectors), source)
        bad = np.flatnonzero(np.linalg.norm(vectors, axis=1) < _PARALLEL)
        if bad.size:
            raise DataError(
                f"the {kind} vector is zero",
                where=at_row(source, bad[0]),
                expected="a direction, best of unit length",
            )


@dataclass(frozen=True)
class StarAttitude(PlainObservation):
    """Attitude from a star tracker.

    The error is zero where

        nRs = nRb sRbᵀ,

    with nRs = nRe eRi(t) iRs: what the tracker measured, carried to n by the Earth's
    attitude at that time. The residual is axesᵀ Log(nRsᵀ nRb sRbᵀ), arcsec: the rotation
    from measured to predicted, in the tracker's axes turned into those in which its
    components are independent.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the attitudes.
    nRs : ndarray, shape (M, 3, 3)
        Measured.
    axes : ndarray, shape (M, 3, 3)
        Principal axes of the covariance, in the tracker's.
    std : ndarray, shape (M, 3), arcsec
        Standard deviations along them.
    components : tuple of str, optional
        Names of the axes.
    """

    time: Array
    nRs: Array
    axes: Array
    std: Array
    components: tuple[str, ...] = ("x", "y", "z")
    label: str = "Star attitude"
    unit: str = "arcsec"
    parameters: tuple[str, ...] = (MOUNTING,)
    # The sky turns with UTC: an attitude of another time is another measurement.
    clock: None = None

    def sigma(self, motion: Motion, values: Values, factor: Array | float = 1.0) -> Array:
        """Return the standard deviations along the axes, (M, 3), arcsec."""
        return self.std * factor

    def residual(self, motion: Motion, values: Values) -> Array:
        """Return predicted - measured along the axes, (M, 3), arcsec."""
        return rotate(self.axes.transpose(0, 2, 1), self._rotation_error(motion, values)) / ARCSEC

    def linearize(self, motion: Motion, values: Values, wanted: Collection[str]) -> Linearization:
        """Return the residual and its Jacobians."""
        apart = self._rotation_error(motion, values)
        to_axes = self.axes.transpose(0, 2, 1) / ARCSEC
        turned = to_axes @ inverse_right_jacobian(apart) @ values[MOUNTING]
        return Linearization(
            residual=rotate(to_axes, apart),
            d_theta=turned,
            d_parameters={MOUNTING: -turned},
        )

    def _rotation_error(self, motion: Motion, values: Values) -> Array:
        """Return Log(nRsᵀ nRb sRbᵀ), (M, 3), rad."""
        return log_so3(self.nRs.transpose(0, 2, 1) @ motion.nRb @ values[MOUNTING].T)
