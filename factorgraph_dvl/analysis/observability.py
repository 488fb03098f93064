"""What a trial, a solution or a plan can tell: segments, singular values, marginals, shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information_shares import Shares, information_shares
from factorgraph_dvl.analysis.manoeuvres import Segment, find_segments, given_segments
from factorgraph_dvl.analysis.marginals import Marginals, marginals
from factorgraph_dvl.analysis.pwcs import (
    BodyMotion,
    Mounting,
    SingularValues,
    body_motion,
    point_set_rows,
    singular_values,
)
from factorgraph_dvl.conventions import DEG, Array, rotation_from_rph, rph_jacobian, skew
from factorgraph_dvl.information import InformationHistory
from factorgraph_dvl.sensors.dvl import (
    LEVER_ARM,
    MISALIGNMENT,
    SCALE_ERROR,
    TIME_OFFSET,
    Dvl,
    DvlSettings,
)
from factorgraph_dvl.solution import Estimate, Solution
from factorgraph_dvl.trial import Trial

_SI = {MISALIGNMENT: DEG, SCALE_ERROR: 1.0, LEVER_ARM: 1.0}
# In reported units, where a solution does not say what its priors were.
_WITHOUT_PRIOR = {MISALIGNMENT: 1.0, SCALE_ERROR: 0.01, LEVER_ARM: 1.0}
_LEAST_SIGMA = 1e-4
# A singular value that leaves 96 % of the prior's σ tells nothing.
_NOTHING = 0.3
# Where segments that were found begin and end, s: half of a slow ramp.
_MARGIN_S = 5.0


@dataclass(frozen=True)
class SegmentMotion:
    """How the vehicle moved in a segment.

    Parameters
    ----------
    segment : when.
    speed : mean over ground, m/s.
    turn : of the heading from its start to its end, to starboard, rad.
    rates : (3,) RMS of the angular rate about the body axes, rad/s.
    """

    segment: Segment
    speed: float
    turn: float
    rates: Array


@dataclass(frozen=True)
class PointSet:
    """The PWCS view.

    Parameters
    ----------
    states : names of the columns.
    scale : (n,) what each column is in units of, reported units.
    scaling : how numbers were made comparable, in words.
    segments, cumulative : of each segment, and of all up to its end.
    """

    states: tuple[str, ...]
    scale: Array
    scaling: str
    segments: tuple[SingularValues, ...]
    cumulative: tuple[SingularValues, ...]


@dataclass(frozen=True)
class Observability:
    """Three views of what data can tell.

    Parameters
    ----------
    name : of the trial.
    kind : `trial`, `solution` or `plan`.
    segments : motion of each.
    point_set : singular values; None where there is no DVL or no motion.
    marginals : posterior against prior; None where nothing was estimated.
    history, shares : along the trial; None where only a solution is known.
    missing : views that are left out, and why.
    warnings : of the solution.
    """

    name: str
    kind: str
    segments: tuple[SegmentMotion, ...]
    point_set: PointSet | None
    marginals: Marginals | None
    history: InformationHistory | None
    shares: Shares | None
    missing: tuple[str, ...]
    warnings: tuple[str, ...]


def observability(
    solution: Solution,
    *,
    trial: Trial | None = None,
    history: InformationHistory | None = None,
    given: Sequence[tuple[float, float, str]] = (),
    kind: str = "",
) -> Observability:
    """Return what a solution, and the trial that it came from, can tell.

    Parameters
    ----------
    solution : with its calibration and trajectory.
    trial : that it came from; without it the times and noise of the pings are assumed.
    history : information along the trial.
    given : segments, start and end in s and label; by default they are found.
    kind : what it is, if it is not obvious.
    """
    trajectory = solution.trajectory
    missing = []
    segments: tuple[Segment, ...] = ()
    motions: tuple[SegmentMotion, ...] = ()
    point_set = None
    if trajectory.time.size < 2:
        missing.append("segments and singular values: the trajectory has fewer than two epochs")
    else:
        first, last = float(trajectory.time[0]), float(trajectory.time[-1])
        segments = given_segments(given, first, last) if given else find_segments(trajectory)
        motion = body_motion(trajectory, solution.body_axes)
        heading = np.unwrap(trajectory.rph[:, 2])
        motions = tuple(_describe(s, motion, heading) for s in segments)
        # Who gives the segments knows where they begin.
        margin = 0.0 if given else _MARGIN_S
        point_set, why = _point_set(solution, trial, motion, segments, margin)
        missing += why
    view = marginals(solution.estimates, solution.covariance)
    if view is None:
        missing.append("marginal view: nothing was estimated from a prior that is known")
    shares = None
    if history is None:
        missing.append("σ along the trial and shares of the segments: they take the trial itself")
    elif segments and history.names:
        shares = information_shares(history, segments)
        walking = set(view.names if view is not None else ()) - set(history.names)
        if walking:
            missing.append(
                f"σ along the trial of {', '.join(sorted(walking))}: a bias that walks is no "
                "constant"
            )
    return Observability(
        name=solution.trial,
        kind=kind or ("solution" if trial is None else "trial"),
        segments=motions,
        point_set=point_set,
        marginals=view,
        history=history,
        shares=shares,
        missing=tuple(missing),
        warnings=solution.warnings,
    )


def _describe(segment: Segment, motion: BodyMotion, heading: Array) -> SegmentMotion:
    inside = (motion.time >= segment.start) & (motion.time <= segment.end)
    if not inside.any():
        return SegmentMotion(segment, np.nan, np.nan, np.full(3, np.nan))
    own = heading[inside]
    return SegmentMotion(
        segment,
        speed=float(np.mean(np.linalg.norm(motion.v_b[inside], axis=1))),
        turn=float(own[-1] - own[0]),
        rates=np.sqrt(np.mean(motion.omega_b[inside] ** 2, axis=0)),
    )


def _point_set(
    solution: Solution,
    trial: Trial | None,
    motion: BodyMotion,
    segments: Sequence[Segment],
    margin: float,
) -> tuple[PointSet | None, list[str]]:
    by_name = {e.name: e for e in solution.estimates}
    if trial is not None and trial.dvl is None:
        return None, ["singular values: the trial has no DVL"]
    if not by_name.keys() >= _SI.keys():
        return None, ["singular values: the solution has no calibration of a DVL"]
    parts = [by_name[name] for name in _SI]
    if not all(np.isfinite(e.value).all() for e in parts):
        return None, ["singular values: the calibration is not known where to linearise"]
    names = tuple(n for e in parts for n in e.component_names)
    scale, how = _prior_scale(parts)
    mounting = Mounting(*(e.value * _SI[e.name] for e in parts))
    at, sigma, source = _pings(solution, trial, motion, mounting)
    at_epoch = np.clip(np.searchsorted(motion.time, at.time - 1e-6), 0, motion.time.size - 1)
    if at.time.size == 0:
        return None, ["singular values: no ping has a lock while the IMU runs"]
    si = np.concatenate([np.full(e.value.size, _SI[e.name]) for e in parts])
    free = scale > 0.0
    if not free.any():
        return None, ["singular values: the calibration of the DVL is held fixed"]
    states = tuple(n for n, is_free in zip(names, free, strict=True) if is_free)

    def rows(v_b: Array, omega_b: Array) -> Array:
        moving = BodyMotion(at.time, v_b, omega_b)
        whole = point_set_rows(moving, mounting) * (scale * si) / sigma[:, :, None]
        return whole[:, :, free]

    none = np.zeros_like(at.v_b)
    feigned = np.zeros((at.time.size, len(states), len(states)))
    root = _velocity_root(solution, motion.v_b)[at_epoch]
    rate_sigma = _rate_sigma(trial, motion)
    for k in range(3):
        for wrong in (rows(root[:, :, k], none), rows(none, none + rate_sigma * np.eye(3)[k])):
            feigned += wrong.transpose(0, 2, 1) @ wrong
    single, cumulative = singular_values(
        rows(at.v_b, at.omega_b),
        at.time,
        segments,
        states,
        feigned=feigned,
        nothing=_NOTHING,
        margin=margin,
    )
    return PointSet(states, scale[free], f"{how}, {source}", single, cumulative), []


def _velocity_root(solution: Solution, v_b: Array) -> Array:
    """Return roots (M, 3, 3) of the covariance of the velocity in body, m/s.

    v_b = bRn v_n: the errors of velocity and attitude add up, as if they were independent.
    """
    trajectory = solution.trajectory
    bRn = rotation_from_rph(trajectory.rph, solution.body_axes).transpose(0, 2, 1)
    to_body = skew(v_b) @ np.linalg.inv(rph_jacobian(trajectory.rph, solution.body_axes))
    covariance = bRn @ trajectory.velocity_cov @ bRn.transpose(0, 2, 1)
    covariance += to_body @ trajectory.rph_cov @ to_body.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _rate_sigma(trial: Trial | None, motion: BodyMotion) -> float:
    """Return the standard deviation of a rate from attitudes, rad/s; 0 if it is not known."""
    if trial is None:
        return 0.0
    interval = float(np.median(np.diff(motion.time)))
    return float(trial.imu.settings.gyro_noise_root_psd / np.sqrt(interval))


def _prior_scale(parts: Sequence[Estimate]) -> tuple[Array, str]:
    scale = np.concatenate([e.prior_std for e in parts])
    if np.isfinite(scale).all():
        return scale, "columns in units of the priors' σ"
    stated = [np.full(e.value.size, _WITHOUT_PRIOR[e.name]) for e in parts]
    return np.concatenate(stated), "columns in units of 1 deg, 0.01 and 1 m (no priors are known)"


def _pings(
    solution: Solution, trial: Trial | None, motion: BodyMotion, mounting: Mounting
) -> tuple[BodyMotion, Array, str]:
    """Return motion and σ (M, 3) at the pings."""
    if trial is not None and isinstance(trial.dvl, Dvl):
        dvl = trial.dvl
        locked = dvl.locked.astype(bool)
        offset = [e.value[0] for e in solution.estimates if e.name == TIME_OFFSET]
        at, covered = motion.at(dvl.time[locked] - (offset[0] if offset else 0.0))
        return at, dvl.sigma()[locked][covered], "rows in units of the pings' σ"
    settings = DvlSettings()
    speed = np.linalg.norm(motion.v_b, axis=1) * (1.0 + float(np.mean(mounting.scale_error)))
    sigma = np.hypot(settings.velocity_std_m_s, settings.velocity_std_fraction * speed)
    text = (
        "rows in units of an assumed σ, as the pings are not known: one ping for each epoch of "
        f"the trajectory, {1000.0 * settings.velocity_std_m_s:g} mm/s and "
        f"{100.0 * settings.velocity_std_fraction:g} % of the speed"
    )
    return motion, np.repeat(np.maximum(sigma, _LEAST_SIGMA)[:, None], 3, axis=1), text
