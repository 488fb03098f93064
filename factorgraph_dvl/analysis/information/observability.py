"""Observability of a trial, solution or plan: segments, singular values, marginals, shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information.linearization import PointSet, point_set
from factorgraph_dvl.analysis.information.manoeuvres import Segment, find_segments, given_segments
from factorgraph_dvl.analysis.information.marginals import Marginals, marginals
from factorgraph_dvl.analysis.information.segment_singular_values import BodyMotion, body_motion
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class Shares:
    """Shares of the information on each component; they add up to 1.

    Parameters
    ----------
    names : tuple of str
        Names of the P components.
    prior : ndarray, shape (P,)
        Share of the prior.
    segments : ndarray, shape (S, P)
        Share of each segment.
    """

    names: tuple[str, ...]
    prior: Array
    segments: Array


def information_shares(history: InformationHistory, segments: Sequence[Segment]) -> Shares:
    """Return the shares of the prior and of each segment.

    Parameters
    ----------
    history : InformationHistory
        Information along the whole trial.
    segments : sequence of Segment
        Consecutive segments; data before the first and after the last count with these.
    """
    last = history.root[-1]
    P = last @ last.T
    # (P e_i)ᵀ L(t) (P e_i) with L(t) = (S Sᵀ)⁻¹, at the prior and at the ends of segments.
    ends = [np.searchsorted(history.time, s.end + 1e-6) - 1 for s in segments[:-1]]
    at = [0, *(int(np.clip(k, 0, None)) for k in ends), history.time.size - 1]
    known = np.stack([np.sum(np.linalg.solve(history.root[k], P) ** 2, axis=0) for k in at])
    known /= np.diag(P)
    return Shares(history.names, known[0], np.diff(known, axis=0))


# Chosen: uncertainty of the ends of segments that were found, s: half of a slow ramp.
_MARGIN_S = 5.0


@dataclass(frozen=True)
class SegmentMotion:
    """Motion of the vehicle in a segment.

    Parameters
    ----------
    segment : Segment
        The segment.
    speed : float
        Mean speed over ground, m/s.
    turn : float
        Change of heading from start to end, positive to starboard, rad.
    rates : ndarray, shape (3,), rad/s
        RMS of the angular rate about the body axes.
    """

    segment: Segment
    speed: float
    turn: float
    rates: Array


@dataclass(frozen=True)
class Observability:
    """Observability: singular values, marginals, and information along the trial.

    Parameters
    ----------
    name : str
        Name of the trial.
    kind : str
        Source: `trial`, `solution` or `plan`.
    segments : tuple of SegmentMotion
        Segments and the motion in each.
    point_set : PointSet or None
        Singular values; None without DVL or motion.
    marginals : Marginals or None
        Posterior against prior; None if nothing was estimated.
    history, shares : InformationHistory, Shares or None
        Information along the trial; None if only a solution is given.
    missing : tuple of str
        Omitted parts, and why.
    warnings : tuple of str
        Warnings of the solution.
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
    """Return the observability of a solution, and of its trial if that is given.

    Parameters
    ----------
    solution : Solution
        Solution with calibration and trajectory.
    trial : Trial, optional
        Trial of the solution; without it, times and noise of the pings are assumed.
    history : InformationHistory, optional
        Information along the trial.
    given : sequence of tuple of (float, float, str), optional
        Segments: start and end, s, and label; by default they are found from the motion.
    kind : str, optional
        Source; by default `trial` or `solution`.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> view = fd.observability(solution)
    >>> [m.segment.label for m in view.segments][:2]
    ['steady', 'turning']
    """
    trajectory = solution.trajectory
    missing = []
    segments: tuple[Segment, ...] = ()
    motions: tuple[SegmentMotion, ...] = ()
    points = None
    if trajectory.time.size < 2:
        missing.append("segments and singular values: the trajectory has fewer than two epochs")
    else:
        first, last = float(trajectory.time[0]), float(trajectory.time[-1])
        segments = given_segments(given, first, last) if given else find_segments(trajectory)
        motion = body_motion(trajectory, solution.body_axes)
        heading = np.unwrap(trajectory.rph[:, 2])
        motions = tuple(_describe(s, motion, heading) for s in segments)
        # The ends of the user's segments are exact.
        margin = 0.0 if given else _MARGIN_S
        points, why = point_set(solution, trial, segments, margin)
        missing += why
    view = marginals(solution.estimates, solution.covariance, solution.limits)
    if view is None:
        missing.append("posterior against prior: nothing was estimated from a known prior")
    shares = None
    if history is None:
        lacks = "they need the trial itself" if trial is None else "a planar trial has none"
        missing.append(f"σ along the trial and shares of the segments: {lacks}")
    elif segments and history.names:
        shares = information_shares(history, segments)
        varying = set(view.names if view is not None else ()) - set(history.names)
        if varying:
            missing.append(
                f"σ along the trial of {', '.join(sorted(varying))}: what varies along the trial "
                "is no constant"
            )
    return Observability(
        name=solution.trial,
        kind=kind or ("solution" if trial is None else "trial"),
        segments=motions,
        point_set=points,
        marginals=view,
        history=history,
        shares=shares,
        missing=tuple(missing),
        warnings=tuple(map(str, solution.findings)),
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
