"""Measurement matrix of a solution's DVL: linearisation point, units, noise of the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import comb

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.analysis.information.segment_singular_values import (
    GAP,
    BeamMounting,
    BodyMotion,
    MountingModel,
    SingularValues,
    beam_rows,
    body_motion,
    point_set_rows,
    singular_values,
)
from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.geometry.rotations import BodyAxes, log_so3, rotation_from_rph, rph_jacobian
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.dvl import (
    BIAS,
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
    DvlSettings,
)
from factorgraph_dvl.sensors.dvl_beams import DIRECTION as BEAM_DIRECTION
from factorgraph_dvl.sensors.dvl_beams import SCALE_ERROR as BEAM_SCALE_ERROR
from factorgraph_dvl.sensors.dvl_water import CURRENT
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

# Parameters of a DVL, of single beams, and those that have columns only if they are estimated.
_ALWAYS = (MISALIGNMENT, SCALE_ERROR, LEVER_ARM)
_OF_BEAMS = (BEAM_DIRECTION, BEAM_SCALE_ERROR, LEVER_ARM)
_IF_ESTIMATED = (BIAS, CURRENT)
_SI = {MISALIGNMENT: DEG, BEAM_DIRECTION: DEG}
# Chosen: scales of the columns, in reported units, for a solution that states no priors; they
# are about what installers know beforehand.
_WITHOUT_PRIOR = {
    MISALIGNMENT: (1.0, "1 deg"),
    SCALE_ERROR: (0.01, "0.01"),
    LEVER_ARM: (1.0, "1 m"),
    BEAM_DIRECTION: (1.0, "1 deg"),
    BEAM_SCALE_ERROR: (0.01, "0.01"),
    BIAS: (0.1, "0.1 m/s"),
    CURRENT: (0.5, "0.5 m/s"),
}
# Chosen: a tenth of a millimetre per second, below the noise of any DVL.
_LEAST_SIGMA = 1e-4
# Chosen: a singular value below this leaves 96 % of the prior's σ and counts as zero.
_NOTHING = 0.3
# Chosen: differences of rates of this order count as noise; they retain 9 % of a motion with
# five epochs per period, 0.2 % with ten.
_ORDER = 6


@dataclass(frozen=True)
class PointSet:
    """Singular values of a trial's segments (piece-wise constant system).

    Parameters
    ----------
    states : tuple of str
        Names of the columns.
    scale : ndarray, shape (n,)
        Unit of each column, in reported units.
    scaling : str
        Description of the scaling of rows and columns.
    segments, cumulative : tuple of SingularValues
        Singular values of each segment alone, and of all data up to its end.
    """

    states: tuple[str, ...]
    scale: Array
    scaling: str
    segments: tuple[SingularValues, ...]
    cumulative: tuple[SingularValues, ...]


def point_set(
    solution: Solution, trial: Trial | None, segments: Sequence[Segment], margin: float
) -> tuple[PointSet | None, list[str]]:
    """Return the singular values of the DVL's rows, and a list of what they omit.

    The rows are those of `point_set_rows`, for the velocity relative to the ground or the
    water, with further columns if these are estimated:

        bias: I,        current: -(1 + k) D bRn (e, n);

    for single beams without a DVL, those of `beam_rows`.

    Parameters
    ----------
    solution : Solution
        Solution with a trajectory of at least two epochs.
    trial : Trial or None
        Trial of the solution; without it, times and noise of the pings are assumed.
    segments : sequence of Segment
        Segments of the trial.
    margin : float
        Argument of `singular_values`, s.
    """
    found = _parameters(solution, trial)
    if isinstance(found, str):
        return None, [f"singular values: {found}"]
    always, parts = found
    by_name = {e.name: e for e in solution.estimates}
    names = tuple(n for e in parts for n in e.component_names)
    scale, how = _prior_scale(parts)
    si = np.concatenate([np.full(e.value.size, _SI.get(e.name, 1.0)) for e in parts])
    free = scale > 0.0
    if not free.any():
        return None, ["singular values: the calibration of the DVL is fixed"]
    values = [by_name[n].value * _SI.get(n, 1.0) for n in always]
    nominal = parts[0].nominal
    mounting = MountingModel(*values) if nominal is None else BeamMounting(nominal, *values)
    axes = solution.body_axes
    relative = _relative(solution)
    motion = body_motion(relative, axes)
    at, sigma, source = _pings(solution, trial, motion, mounting)
    if at.time.size == 0:
        return None, ["singular values: no ping has a lock within the record of the IMU"]
    bRn = rotation_from_rph(relative.rph, axes).transpose(0, 2, 1)
    level = CubicSpline(motion.time, bRn[:, :, :2])(at.time)
    further = [e.name for e in parts[len(always) :]]
    states = tuple(n for n, is_free in zip(names, free, strict=True) if is_free)

    def rows(v_b: Array, omega_b: Array, others: Mapping[str, Array]) -> Array:
        moving = BodyMotion(at.time, v_b, omega_b)
        whole = _rows(moving, mounting, [others[name] for name in further])
        return (whole * (scale * si) / sigma[:, :, None])[:, :, free]

    none = np.zeros_like(at.v_b)
    nothing = {BIAS: np.zeros((3, 3)), CURRENT: np.zeros((3, 2))}
    epoch = np.clip(np.searchsorted(motion.time, at.time - 1e-6), 0, motion.time.size - 1)
    velocity_root, attitude_root = (root[epoch] for root in _motion_roots(relative, axes, bRn))
    rate_sigma = _rate_sigma(trial, relative, axes)
    spurious = np.zeros((at.time.size, len(states), len(states)))
    for k in range(3):
        turn = attitude_root[:, :, k]
        turned = np.cross(level, turn[:, :, None], axis=1)
        for wrong in (
            rows(velocity_root[:, :, k], none, nothing),
            rows(np.cross(at.v_b, turn), none, nothing | {CURRENT: -mounting.gain @ turned}),
            rows(none, none + rate_sigma[k] * np.eye(3)[k], nothing),
        ):
            spurious += wrong.transpose(0, 2, 1) @ wrong
    single, cumulative = singular_values(
        rows(at.v_b, at.omega_b, {BIAS: np.eye(3), CURRENT: -mounting.gain @ level}),
        at.time,
        segments,
        states,
        spurious=spurious,
        nothing=_NOTHING,
        margin=margin,
    )
    view = PointSet(states, scale[free], f"{how}, {source}", single, cumulative)
    return view, _taken_as_known(by_name, trial)


def _rows(
    moving: BodyMotion, mounting: MountingModel | BeamMounting, further: Sequence[Array]
) -> Array:
    """Return the rows of pings (M,): of the mounting, then further columns."""
    if isinstance(mounting, BeamMounting):
        base = beam_rows(moving, mounting)
    else:
        base = point_set_rows(moving, mounting)
    own = [np.broadcast_to(x, (moving.time.size, *x.shape[-2:])) for x in further]
    return np.concatenate([base, *own], axis=2)


def _motion_roots(motion: Trajectory, axes: BodyAxes, bRn: Array) -> tuple[Array, Array]:
    """Return roots of the covariances of velocity and attitude in body axes, (N, 3, 3) each."""
    to_body = np.linalg.inv(rph_jacobian(motion.rph, axes))
    varying = _varying(motion.rph_cov)
    return (
        _root(bRn @ motion.velocity_cov @ bRn.transpose(0, 2, 1)),
        _root(to_body @ varying @ to_body.transpose(0, 2, 1)),
    )


def _parameters(
    solution: Solution, trial: Trial | None
) -> tuple[tuple[str, ...], list[Estimate]] | str:
    """Return names of the parameters that have columns always, and all parameters that have some.

    Or why there is nothing to linearise.
    """
    by_name = {e.name: e for e in solution.estimates}
    if trial is not None and trial.log is None:
        return "the trial has no DVL"
    of_beams = by_name.keys() >= set(_OF_BEAMS) and (trial is None or trial.dvl is None)
    always = _OF_BEAMS if of_beams else _ALWAYS
    if not by_name.keys() >= set(always):
        return "the solution does not calibrate a DVL"
    parts = [by_name[name] for name in always]
    parts += [by_name[n] for n in _IF_ESTIMATED if n in by_name and _is_estimated(by_name[n])]
    if not all(np.isfinite(e.value).all() for e in parts):
        return "the calibration has no values to linearise at"
    return always, parts


def _is_estimated(e: Estimate) -> bool:
    return bool(np.any(np.isfinite(e.std) & (e.std > 0.0)))


def _taken_as_known(by_name: Mapping[str, Estimate], trial: Trial | None) -> list[str]:
    """Return the estimated parameters that the rows treat as known."""
    out = []
    if TIME_OFFSET in by_name and _is_estimated(by_name[TIME_OFFSET]):
        out.append(f"{TIME_OFFSET} in the singular values: it is treated as known")
    dvl = None if trial is None else trial.dvl
    through_water = dvl is not None and dvl.settings.reference == "water"
    if through_water and CURRENT not in by_name:
        out.append(
            f"{CURRENT} in the singular values: it was not estimated, so they use the velocity "
            "over ground"
        )
    return out


def _relative(solution: Solution) -> Trajectory:
    """Return the trajectory with the velocity relative to the ground or the water.

    The variances of velocity and current are added, as if their errors were independent.
    """
    trajectory = solution.trajectory
    found = [e for e in solution.estimates if e.name == CURRENT]
    if not found:
        return trajectory
    (current,) = found
    index = [solution.order.index(name) for name in current.component_names]
    level = np.eye(3)[:, :2]
    own = level @ solution.covariance[np.ix_(index, index)] @ level.T
    return replace(
        trajectory,
        velocity=trajectory.velocity - level @ current.value,
        velocity_cov=trajectory.velocity_cov + own,
    )


def _varying(rph_cov: Array) -> Array:
    """Return covariances (M, 3, 3) of attitudes without the error that all headings share.

    A constant heading error rotates all rows alike and adds no spurious information. The
    smallest variance of the heading is taken as that constant part.
    """
    variance = rph_cov[:, 2, 2]
    scale = np.ones((variance.size, 3))
    known = variance > 0.0
    scale[known, 2] = np.sqrt(1.0 - variance.min() / variance[known])
    return rph_cov * scale[:, :, None] * scale[:, None, :]


def _root(covariance: Array) -> Array:
    """Return roots (M, 3, 3) of covariances, a direction in each column."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _rate_sigma(trial: Trial | None, trajectory: Trajectory, body_axes: BodyAxes) -> Array:
    """Return the standard deviations of the angular rates, (3,), rad/s.

    With the trial, those of the gyro. Without it, the scatter of the mean rates between
    epochs: their differences of sixth order, divided by sqrt(924), the factor by which these
    amplify white noise.
    """
    step = np.diff(trajectory.time)
    interval = float(np.median(step))
    if trial is not None and trial.imu is not None:
        sigma = trial.imu.settings.gyro_noise_root_psd / np.sqrt(interval)
        return np.full(3, float(sigma))
    nRb = rotation_from_rph(trajectory.rph, body_axes)
    rates = log_so3(nRb[:-1].transpose(0, 2, 1) @ nRb[1:]) / step[:, None]
    # With fewer epochs, all of it may be noise.
    order = min(_ORDER, step.size - 1)
    whole = np.convolve(step > GAP * interval, np.ones(order + 1), mode="valid") < 0.5
    if not whole.any():
        return np.sqrt(np.mean(rates**2, axis=0))
    scatter = np.diff(rates, n=order, axis=0)[whole]
    return np.asarray(np.sqrt(np.mean(scatter**2, axis=0) / comb(2 * order, order)))


def _prior_scale(parts: Sequence[Estimate]) -> tuple[Array, str]:
    scale = np.concatenate([e.prior_std for e in parts])
    if np.isfinite(scale).all():
        return scale, "columns in units of the priors' σ"
    stated = [np.full(e.value.size, _WITHOUT_PRIOR[e.name][0]) for e in parts]
    units = ", ".join(_WITHOUT_PRIOR[e.name][1] for e in parts)
    return np.concatenate(stated), f"columns in units of {units} (the priors are unknown)"


def _pings(
    solution: Solution,
    trial: Trial | None,
    motion: BodyMotion,
    mounting: MountingModel | BeamMounting,
) -> tuple[BodyMotion, Array, str]:
    """Return motion and σ (M, d) at the pings; infinite where a beam was lost."""
    of_beams = isinstance(mounting, BeamMounting)
    sensor = None if trial is None else trial.beams if of_beams else trial.dvl
    if sensor is not None:
        received = np.logical_not(sensor.missing)
        offset = [e.value[0] for e in solution.estimates if e.name == TIME_OFFSET]
        late = offset[0] if offset and not of_beams else 0.0
        at, covered = motion.at(sensor.time[received] - late)
        sigma = sensor.sigma()[received][covered]
        return at, np.where(np.isnan(sigma), np.inf, sigma), "rows in units of the pings' σ"
    settings = DvlSettings()
    measured = motion.v_b @ mounting.gain.T
    if not of_beams:
        measured = np.linalg.norm(measured, axis=1, keepdims=True) * np.ones(3)
    sigma = np.hypot(settings.velocity_std_m_s, settings.velocity_std_fraction * measured)
    text = (
        "rows in units of an assumed σ, because the pings are unknown: one ping per epoch of "
        f"the trajectory, {1000.0 * settings.velocity_std_m_s:g} mm/s and "
        f"{100.0 * settings.velocity_std_fraction:g} % of "
        + ("each beam's velocity" if of_beams else "the speed")
    )
    return motion, np.maximum(sigma, _LEAST_SIGMA), text
