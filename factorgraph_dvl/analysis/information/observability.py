"""What a trial, a solution or a plan can tell: segments, singular values, marginals, shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.analysis.information.linearization import PointSet, point_set
from factorgraph_dvl.analysis.information.manoeuvres import Segment, find_segments, given_segments
from factorgraph_dvl.analysis.information.marginals import Marginals, marginals
from factorgraph_dvl.analysis.information.segment_singular_values import BodyMotion, body_motion
from factorgraph_dvl.analysis.information.shares import Shares, information_shares
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import Trial

# Where segments that were found begin and end, s: half of a slow ramp.
_MARGIN_S = 5.0


@dataclass(frozen=True)
class SegmentMotion:
    """How the vehicle moved in a segment.

    Parameters
    ----------
    segment : Segment
        When.
    speed : float
        Mean over ground, m/s.
    turn : float
        Of the heading from its start to its end, to starboard, rad.
    rates : ndarray, shape (3,), rad/s
        RMS of the angular rate about the body axes.
    """

    segment: Segment
    speed: float
    turn: float
    rates: Array


@dataclass(frozen=True)
class Observability:
    """Three views of what data can tell.

    Parameters
    ----------
    name : str
        Of the trial.
    kind : str
        `trial`, `solution` or `plan`.
    segments : tuple of SegmentMotion
        Motion of each.
    point_set : PointSet or None
        Singular values; None where there is no DVL or no motion.
    marginals : Marginals or None
        Posterior against prior; None where nothing was estimated.
    history, shares : along the trial; None where only a solution is known.
    missing : tuple of str
        Views that are left out, and why.
    warnings : tuple of str
        Of the solution.
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
    solution : Solution
        With its calibration and trajectory.
    trial : Trial, optional
        That it came from; without it the times and noise of the pings are assumed.
    history : InformationHistory, optional
        Information along the trial.
    given : sequence of tuple of (float, float, str), optional
        Segments, start and end in s and label; by default they are found.
    kind : str, optional
        What it is, if it is not obvious.
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
        # Who gives the segments knows where they begin.
        margin = 0.0 if given else _MARGIN_S
        points, why = point_set(solution, trial, segments, margin)
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
        point_set=points,
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
