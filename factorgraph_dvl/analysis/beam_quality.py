"""Beams against each other: velocities of groups of three, error velocity, equivalent DVL."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.beam_geometry import (
    error_rows,
    error_velocity,
    group_velocities,
    groups,
    velocities,
)
from factorgraph_dvl.conventions import DEG, Array, exp_so3
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.sensors.dvl_beams import DIRECTION, SCALE_ERROR, DvlBeams
from factorgraph_dvl.solution import Calibration, Solution


@dataclass(frozen=True)
class BeamCalibration:
    """Beams as a solution has them.

    Parameters
    ----------
    directions_d, directions_b : (N, 3) unit vectors in the instrument's axes and in body;
        between both is the nominal misalignment.
    scale_error : (N,).
    lever_arm : (3,) m.
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
    """How well the beams of each ping agree, with their calibration.

    Parameters
    ----------
    time : (M,) s.
    valid : (M,) number of beams that were received.
    velocity : (M, 3) by least squares over all of them, in d, m/s; nan below three.
    groups : names of the groups of three beams, such as `123`.
    group_velocity : (M, G, 3) in d, m/s; nan where a beam of the group was lost.
    error_velocity : (M,) m/s; nan below four beams.
    error_sigma : (M,) what the noise of the beams makes of it.
    """

    time: Array
    valid: Array
    velocity: Array
    groups: tuple[str, ...]
    group_velocity: Array
    error_velocity: Array
    error_sigma: Array

    def columns(self) -> dict[str, Array]:
        """Return all of it as a table."""
        table = {"time_s": self.time, "beams": self.valid}
        table |= {f"vel_{x}_m_s": v for x, v in zip("xyz", self.velocity.T, strict=True)}
        table["error_velocity_m_s"] = self.error_velocity
        for g, name in enumerate(self.groups):
            for i, x in enumerate("xyz"):
                table[f"vel_{name}_{x}_m_s"] = self.group_velocity[:, g, i]
        return table


def calibrates(solution: Solution | Calibration, beams: DvlBeams) -> bool:
    """Whether a solution is one of a DVL's beams, and not of something else in the trial."""
    return any(e.name == f"{beams.prefix}lever_arm_m" for e in solution.estimates)


def calibration_of(beams: DvlBeams, solution: Solution | Calibration) -> BeamCalibration:
    """Return the beams as a solution has them.

    Parameters
    ----------
    beams : of the trial.
    solution : of it, in either parametrisation.

    Raises
    ------
    DataError
        If the solution is not one of these beams.
    """
    s = beams.settings
    nominal = exp_so3(np.array(s.misalignment_deg) * DEG)
    found = {e.name: e for e in solution.estimates}
    n = len(s.nominal_d)
    lever_arm = found.get(f"{beams.prefix}lever_arm_m")
    if DIRECTION in found and lever_arm is not None:
        directions = found[DIRECTION].directions
        scale = found[SCALE_ERROR].value
        if len(directions) == n:
            return BeamCalibration(directions @ nominal.T, directions, scale, lever_arm.value)
    misalignment = found.get(f"{beams.prefix}misalignment_deg")
    common = found.get(f"{beams.prefix}scale_error")
    if misalignment is not None and common is not None and lever_arm is not None:
        directions = s.nominal_d @ exp_so3(misalignment.value * DEG)
        scale = np.full(n, common.value.mean())
        return BeamCalibration(directions @ nominal.T, directions, scale, lever_arm.value)
    raise DataError(
        f"the solution does not calibrate the {n} beams of the trial",
        where=solution.trial,
        expected="beam_direction_b, beam_scale_error and lever_arm_m of these beams",
    )


def beam_quality(beams: DvlBeams, calibration: BeamCalibration) -> BeamQuality:
    """Return how well the beams of each ping agree.

    Parameters
    ----------
    beams : the record.
    calibration : of them.
    """
    gain, sigma = calibration.gain_d, beams.sigma()
    # Unit rows across all beams spread the error velocity's variance over them evenly.
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
