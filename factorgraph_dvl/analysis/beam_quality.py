"""Beams against each other: velocities of groups of three, error velocity, equivalent DVL."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from msgspec import UnsetType

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import values_of
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beam_geometry import (
    error_rows,
    error_velocity,
    group_velocities,
    groups,
    velocities,
)
from factorgraph_dvl.sensors.dvl_beams import BEAM_PREFIX, DIRECTION, SCALE_ERROR, DvlBeams
from factorgraph_dvl.solution import Calibration, Solution

# Chosen: a beam further from its nominal direction than this many standard deviations, and
# than this many deg, belongs to another instrument; good beams stay within 3.
_FAR = 5.0
_LEAST_DEG = 1.0


@dataclass(frozen=True)
class BeamCalibration:
    """Calibrated beams of a DVL.

    Parameters
    ----------
    directions_d, directions_b : ndarray, shape (N, 3)
        Unit vectors in the DVL's nominal axes d, and in body axes b.
    scale_error : ndarray, shape (N,)
        Scale error of each beam.
    lever_arm : ndarray, shape (3,), m
        Lever arm from the IMU to the DVL, in body.
    """

    directions_d: Array
    directions_b: Array
    scale_error: Array
    lever_arm: Array

    @property
    def gain_d(self) -> Array:
        """Rows (1 + k_i) d_i^T in d, (N, 3)."""
        return np.asarray((1.0 + self.scale_error)[:, None] * self.directions_d)


@dataclass(frozen=True)
class BeamQuality:
    """Consistency of the beams of each ping, given their calibration.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the pings.
    valid : ndarray, shape (M,)
        Number of beams that were received.
    velocity : ndarray, shape (M, 3)
        Least-squares velocity in d, m/s; nan with fewer than three beams.
    groups : tuple of str
        Names of the groups of three beams, such as `123`.
    group_velocity : ndarray, shape (M, G, 3)
        Group velocity in d, m/s; nan where a beam of the group was lost.
    error_velocity : ndarray, shape (M,)
        Error velocity, m/s; nan with fewer than four beams.
    error_sigma : ndarray, shape (M,)
        Standard deviation of the error velocity from the noise of the beams, m/s.
    """

    time: Array
    valid: Array
    velocity: Array
    groups: tuple[str, ...]
    group_velocity: Array
    error_velocity: Array
    error_sigma: Array

    def columns(self) -> dict[str, Array]:
        """Return the columns of `beams.csv`."""
        table = {"time_s": self.time, "beams": self.valid}
        table |= {f"vel_{x}_m_s": v for x, v in zip("xyz", self.velocity.T, strict=True)}
        table["error_velocity_m_s"] = self.error_velocity
        for g, name in enumerate(self.groups):
            for i, x in enumerate("xyz"):
                table[f"vel_{name}_{x}_m_s"] = self.group_velocity[:, g, i]
        return table


def calibrates(solution: Solution | Calibration, beams: DvlBeams) -> bool:
    """Whether a solution calibrates these beams."""
    return any(e.name == f"{beams.prefix}lever_arm_m" for e in solution.estimates)


def calibration_of(beams: DvlBeams, solution: Solution | Calibration) -> BeamCalibration:
    """Return the beams that a solution calibrates.

    Parameters
    ----------
    beams : DvlBeams
        Beams of the trial.
    solution : Solution or Calibration
        Solution of that trial, in either parametrisation.

    Raises
    ------
    DataError
        If the solution does not calibrate these beams.
    """
    return beam_calibration(beams, values_of(solution.estimates), solution.trial)


def beam_calibration(
    beams: DvlBeams, values: Mapping[str, Array], source: str = "calibration"
) -> BeamCalibration:
    """Return the beams that reported values describe.

    Parameters
    ----------
    beams : DvlBeams
        Beams of the trial; their settings give scale and lever arm where `values` do not.
    values : mapping of str to ndarray
        Values by name as in calibration.json, in reported units; directions as (N, 3) vectors.
    source : str, default 'calibration'
        Name of the origin of the values, for messages.

    Raises
    ------
    DataError
        If the values do not describe these beams.
    """
    s = beams.settings
    n = len(s.nominal_d)
    # Of beams beside a DVL, the names without a prefix are those of the DVL.
    prefix = BEAM_PREFIX if "beam_lever_arm_m" in values else beams.prefix
    if DIRECTION in values:
        prefix = prefix if f"{prefix}lever_arm_m" in values else ""
        rows = values[DIRECTION]
        rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        scale = values.get(SCALE_ERROR, np.array(s.scale_error))
    elif f"{prefix}misalignment_deg" in values:
        # One number, or one for each axis of d.
        common = values.get(f"{prefix}scale_error", np.zeros(1))
        axes = common if common.size in (1, 3) else np.full(3, np.nan)
        rows = (s.nominal_d * (1.0 + axes)) @ exp_so3(values[f"{prefix}misalignment_deg"] * DEG)
        scale = np.zeros(1)
    else:
        rows, scale = np.empty((0, 3)), np.zeros(1)
    if len(rows) != n or scale.size not in (1, n) or not np.isfinite(rows).all():
        raise DataError(
            f"the solution does not calibrate the {n} beams of the trial",
            where=source,
            expected="beam_direction_b, beam_scale_error and lever_arm_m of these beams",
        )
    length = np.linalg.norm(rows, axis=1)
    directions = rows / length[:, None]
    return BeamCalibration(
        directions @ exp_so3(np.array(s.misalignment_deg) * DEG).T,
        directions,
        (1.0 + scale) * length - 1.0,
        np.asarray(values.get(f"{prefix}lever_arm_m", s.lever_arm_m)),
    )


def check_same_instrument(beams: DvlBeams, calibration: BeamCalibration, source: str) -> None:
    """Raise DataError if a calibration belongs to other beams than those of a trial.

    Parameters
    ----------
    beams : DvlBeams
        Beams of the trial, with nominal directions and their standard deviations.
    calibration : BeamCalibration
        Calibration to check.
    source : str
        Name of the file of the calibration, for messages.
    """
    s = beams.settings
    std = s.misalignment_std_deg
    sigma = s.direction_std_deg if isinstance(std, UnsetType) else max(std)
    allowed = max(_FAR * np.sqrt(2.0) * sigma, _LEAST_DEG)
    apart = np.linalg.norm(calibration.directions_b - beams.nominal_b, axis=1)
    angle = 2.0 * np.arcsin(np.minimum(0.5 * apart, 1.0)) / DEG
    if angle.max() > allowed:
        raise DataError(
            f"beam {np.argmax(angle) + 1} of the calibration is {angle.max():.3g} deg from its "
            "nominal direction in the trial",
            where=source,
            expected=f"at most {allowed:.3g} deg, from the standard deviations in the trial",
            hint="Check that it is the same instrument, mounted and described in the same way",
        )


def beam_quality(beams: DvlBeams, calibration: BeamCalibration) -> BeamQuality:
    """Return the consistency of the beams of each ping.

    Parameters
    ----------
    beams : DvlBeams
        Record of the beams.
    calibration : BeamCalibration
        Calibration of the beams.
    """
    gain, sigma = calibration.gain_d, beams.sigma()
    # The rows have unit length, so each beam contributes its share of the variance.
    spread = np.mean(error_rows(gain) ** 2, axis=0) if len(gain) > 3 else np.zeros(len(gain))
    share = np.where(np.isnan(beams.velocity), 0.0, spread)
    variance = np.sum(share * np.nan_to_num(sigma) ** 2, axis=1)
    total = np.sum(share, axis=1)
    error = error_velocity(gain, beams.velocity)
    with np.errstate(invalid="ignore", divide="ignore"):
        error_sigma = np.where(np.isnan(error), np.nan, np.sqrt(variance / total))
    return BeamQuality(
        time=beams.time,
        valid=np.sum(~np.isnan(beams.velocity), axis=1).astype(float),
        velocity=velocities(gain, beams.velocity, sigma)[0],
        groups=tuple("".join(str(i + 1) for i in g) for g in groups(gain)),
        group_velocity=group_velocities(gain, beams.velocity),
        error_velocity=error,
        error_sigma=error_sigma,
    )
