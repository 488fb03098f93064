"""Where the instruments of a vessel are, and how its DVL is turned: what drawings show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import ANTENNA, InstrumentTerms
from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.gnss import LEVER_ARM as GNSS_LEVER_ARM
from factorgraph_dvl.solution import Solution

# Beams of a Janus DVL, by direction from its axis and from ahead, deg.
_SLANT, _AZIMUTHS = 30.0, (45.0, 135.0, 225.0, 315.0)
# Standard deviations of an ellipse.
SIGMAS = 2.0
# Chosen: a vessel is drawn at least so wide, m.
_LEAST_M = 0.5
# Seen length of an axis from which on it is drawn: another points nearly at the reader, and hides
# behind its point.
SHORTEST = 0.25
# What is seen to the right and upward, of forward, starboard, down.
VIEWS = {
    "From above": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "From the side, seen from starboard": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
LEGEND = (
    "Arrows: axes of the DVL. Dashed: four beams at 30° from its axis.",
    "Ellipses: 2 σ, to scale, so that small ones hide behind their points.",
)


@dataclass(frozen=True)
class Place:
    """An instrument of a vessel.

    Parameters
    ----------
    name : str
        Name to show.
    place : ndarray, shape (3,), m
        Place forward, starboard, down of the reference point.
    covariance : ndarray, shape (3, 3), m²
        Covariance of `place`.
    """

    name: str
    place: Array
    covariance: Array


def places_of(
    terms: InstrumentTerms, solution: Solution, settings: Mapping[str, Any]
) -> list[Place]:
    """Return reference point, antenna if there is another one, and DVL.

    Parameters
    ----------
    terms : InstrumentTerms
        Calibration of the DVL.
    solution : Solution
        Solution with the antenna's lever arm, if it was estimated.
    settings : mapping of str to object
        Settings of the trial, by section: the antenna's lever arm, if it was not.
    """
    return [
        Place(terms.origin, np.zeros(3), np.zeros((3, 3))),
        *_antenna(terms, solution, settings),
        Place("DVL", terms.lever_arm, terms.lever_arm_covariance),
    ]


def seen(view: Array, places: Sequence[Place]) -> tuple[Array, Array, float]:
    """Return where places are seen in a view (2, 3): points (n, 2), their middle and span, m.

    The span is the largest of all views, so that they have one scale.
    """
    where = np.stack([p.place for p in places])
    points = where @ view.T
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    span = max(float(np.ptp(where @ v.T, axis=0).max()) for v in VIEWS.values())
    return points, middle, max(span, _LEAST_M)


def label_places(
    at: Array, sides: Array, widths: Sequence[float], height: float
) -> Iterator[tuple[bool, bool, float]]:
    """Yield where the names of points are: to the right or left, below or above, and how far, px.

    Each has the first place, beginning on its own side, without another name or point.

    Parameters
    ----------
    at : ndarray, shape (n, 2), px
        Points, to the right and downward.
    sides : ndarray, shape (n, 2)
        Directions to the side of each point on which its name begins to look for room.
    widths : sequence of float, px
        Widths of the names.
    height : float, px
        Height of a name.
    """
    taken = [np.array([*(xy - 0.3 * height), *(xy + 0.3 * height)]) for xy in at]
    for xy, side, width in zip(at, sides, widths, strict=True):
        right, below = map(bool, side >= 0.0)
        tried = [
            (is_right, is_below, (0.5 + line) * height)
            for line in range(len(at))
            for is_below in (below, not below)
            for is_right in (right, not right)
        ]
        boxes = [_box(xy, width, height, place) for place in tried]
        first = next((k for k, box in enumerate(boxes) if not _overlaps(box, taken)), 0)
        taken.append(boxes[first])
        yield tried[first]


def _box(xy: Array, width: float, height: float, place: tuple[bool, bool, float]) -> Array:
    """Return left, top, right, bottom of a name at one of its places."""
    right, below, far = place
    x = xy[0] + (0.5 * height if right else -0.5 * height - width)
    y = xy[1] + (far if below else -far - height)
    return np.array([x, y, x + width, y + height])


def _overlaps(box: Array, others: Sequence[Array]) -> bool:
    return any((box[:2] < o[2:]).all() and (o[:2] < box[2:]).all() for o in others)


def ellipse(covariance: Array) -> tuple[float, float, float] | None:
    """Return semi-axes for `SIGMAS` of a covariance (2, 2), m, and the angle of the longer, deg.

    None where there is no uncertainty, or it is not known.
    """
    variance, turned = np.linalg.eigh(covariance)
    if not np.isfinite(variance).all() or variance[1] <= 0.0:
        return None
    b, a = SIGMAS * np.sqrt(np.maximum(variance, 0.0))
    return float(a), float(b), float(np.arctan2(turned[1, 1], turned[0, 1])) / DEG


def beams() -> Iterator[Array]:
    """Yield directions of four beams, (3,), in the axes of the DVL."""
    level = np.sin(_SLANT * DEG)
    for azimuth in _AZIMUTHS:
        yield np.array(
            [level * np.cos(azimuth * DEG), level * np.sin(azimuth * DEG), np.cos(_SLANT * DEG)]
        )


def _antenna(
    terms: InstrumentTerms, solution: Solution, settings: Mapping[str, Any]
) -> Iterator[Place]:
    if terms.origin == ANTENNA or "gnss" not in settings:
        return
    frd = frd_from_body(solution.body_axes)
    order = list(solution.order)
    for e in solution.estimates:
        if e.name == GNSS_LEVER_ARM:
            rows = [order.index(name) for name in e.component_names]
            covariance = frd @ solution.covariance[np.ix_(rows, rows)] @ frd.T
            yield Place(ANTENNA, frd @ e.value, covariance)
            return
    stated = np.array(settings["gnss"].get("lever_arm_m", np.zeros(3)), dtype=float)
    yield Place(ANTENNA, frd @ stated, np.zeros((3, 3)))
