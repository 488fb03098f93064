"""The vessel from above and from the side, to scale: IMU, antenna, and DVL turned as found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from factorgraph_dvl.analysis.instrument_terms import InstrumentTerms
from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.html.markup import (
    Html,
    both,
    element,
    joined,
    labels,
    paragraph,
    round_step,
    tspans,
)
from factorgraph_dvl.report.vessel import (
    LEGEND,
    SHORTEST,
    SIGMAS,
    VIEWS,
    Place,
    beams,
    ellipse,
    label_places,
    places_of,
    seen,
)
from factorgraph_dvl.solution import Solution

# Size of each drawing, and what is left free around the instruments, in its own units.
_SIZE, _MARGIN = 360.0, 124.0
# Length of the DVL's axes and beams, in units of the drawing. Chosen: their directions are seen.
_AXIS, _BEAM = 54.0, 76.0
# Height of a name, and width of a letter of it, in units of the drawing.
_LINE, _LETTER = 16.0, 8.7
# Chosen: an ellipse widens a vessel at most so many times.
_WIDEST = 1.0


def vessel_drawing(
    terms: InstrumentTerms, solution: Solution, settings: Mapping[str, Any]
) -> Html:
    """Return both views, side by side where there is room.

    Parameters
    ----------
    terms : InstrumentTerms
        Calibration of the DVL.
    solution : Solution
        Solution with the antenna's lever arm, if it was estimated.
    settings : mapping of str to object
        Settings of the trial, by section.
    """
    places, axes = places_of(terms, solution, settings), terms.attitude
    figures = [
        element("figure", _view(view, places, axes, title),
                element("figcaption", both(title)))
        for title, view in VIEWS.items()
    ]  # fmt: skip
    return joined(
        element("div", *figures, class_="vessel"),
        paragraph(
            joined(
                both(f"Reference point: {terms.origin}."),
                *map(both, LEGEND),
            )
        ),
    )


def _view(view: Array, places: Sequence[Place], axes: Array, title: str) -> Html:
    """Return a drawing of one view (2, 3): what is seen to the right, and upward."""
    points, middle, span = seen(view, places)
    largest = SIGMAS * np.sqrt(max(np.diag(p.covariance).max() for p in places))
    span += 2.0 * min(float(largest), _WIDEST * span)
    scale = (_SIZE - 2.0 * _MARGIN) / span

    def pixel(p: Array) -> Array:
        return 0.5 * _SIZE + (p - middle) * [scale, -scale]

    at = np.stack([pixel(p) for p in points])
    given = " ".join(f'{k.replace("_", "-")}="{v}"' for k, v in labels(title).items())
    parts = [
        f'<svg viewBox="0 0 {_SIZE:g} {_SIZE:g}" role="img" {given}>',
        f'<rect class="ground" width="{_SIZE:g}" height="{_SIZE:g}"/>',
        _bow(view),
        *(
            _ellipse(xy, scale, view @ p.covariance @ view.T)
            for xy, p in zip(at, places, strict=True)
        ),
        f'<path class="arm" d="M{_xy(at[0])} L{_xy(at[-1])}"/>',
        *_dvl(at[-1], view, axes),
        *_names(at, [p.name for p in places], -(view @ axes.sum(axis=1)) * [1.0, -1.0]),
        *(f'<circle class="point" cx="{x:.1f}" cy="{y:.1f}" r="4"/>' for x, y in at),
        _ruler(span, scale),
        "</svg>",
    ]
    return Html("".join(parts))


def _dvl(at: Array, view: Array, axes: Array) -> Iterator[str]:
    """Yield axes and beams of the DVL, as they are seen."""
    for beam in beams():
        end = at + _BEAM * (view @ axes @ beam) * [1.0, -1.0]
        yield f'<path class="beam" d="M{_xy(at)} L{_xy(end)}"/>'
    for k, name in enumerate(FRD_NAMES):
        axis = (view @ axes[:, k]) * [1.0, -1.0]
        length = float(np.hypot(*axis))
        if length < SHORTEST:
            continue
        end = at + _AXIS * axis
        along, across = axis / length, np.array([-axis[1], axis[0]]) / length
        head = " L".join(_xy(end - 7.0 * along + side * across) for side in (-4.0, 4.0))
        yield f'<path class="axis{k}" d="M{_xy(at)} L{_xy(end)} M{_xy(end)} L{head} Z"/>'
        x, y = end + [6.0, 12.0] * along
        anchor = "middle" if abs(along[0]) < 0.5 else "start" if along[0] > 0.0 else "end"
        yield (
            f'<text class="axis{k}" text-anchor="{anchor}" x="{x:.1f}" y="{y + 4.0:.1f}">'
            f"{tspans(name)}</text>"
        )


def _names(at: Array, names: Sequence[str], free: Array) -> Iterator[str]:
    """Yield the names of the points.

    A name is on the side of its point on which there are no others; that of the last, the DVL,
    on the side that its axes leave free.
    """
    sides = np.stack([*(at[:-1] - at.mean(axis=0)), free])
    widths = [_LETTER * len(name) for name in names]
    found = label_places(at, sides, widths, _LINE)
    for xy, name, (right, below, far) in zip(at, names, found, strict=True):
        x = xy[0] + (0.5 if right else -0.5) * _LINE
        # The line on which letters are is a quarter above the bottom of their box.
        y = xy[1] + (far + 0.75 * _LINE if below else -far - 0.25 * _LINE)
        anchor = "start" if right else "end"
        yield (
            f'<text class="place" text-anchor="{anchor}" x="{x:.1f}" y="{y:.1f}">'
            f"{tspans(name)}</text>"
        )


def _ellipse(at: Array, scale: float, covariance: Array) -> str:
    """Return an ellipse about a point, of a covariance (2, 2) seen to the right and upward."""
    found = ellipse(covariance)
    if found is None:
        return ""
    a, b, angle = found
    return (
        f'<ellipse class="sigma" rx="{scale * a:.2f}" ry="{scale * b:.2f}" '
        f'transform="translate({_xy(at)}) rotate({-angle:.1f})"/>'
    )


def _bow(view: Array) -> str:
    """Return an arrow that points to the bow."""
    x, y = view[:, 0] * [1.0, -1.0]
    start = np.array([24.0, 56.0]) if y else np.array([_SIZE - 64.0, 24.0])
    end = start + 32.0 * np.array([x, y])
    side = np.array([-y, x])
    back = end - 8.0 * np.array([x, y])
    text = end + (np.array([8.0, 10.0]) if y else np.array([-16.0, 18.0]))
    return (
        f'<path class="bow" d="M{_xy(start)} L{_xy(end)} M{_xy(end)} L{_xy(back + 4.0 * side)} '
        f'L{_xy(back - 4.0 * side)} Z"/>'
        f'<text x="{text[0]:g}" y="{text[1]:g}">{tspans("bow")}</text>'
    )


def _ruler(span: float, scale: float) -> str:
    length = round_step(0.4 * span)
    y = _SIZE - 14.0
    return (
        f'<path class="bow" d="M14,{y - 4:g} V{y:g} H{14.0 + length * scale:.1f} V{y - 4:g}"/>'
        f'<text x="{22.0 + length * scale:.1f}" y="{y:g}">{length:g} m</text>'
    )


def _xy(p: Array) -> str:
    return f"{p[0]:.1f},{p[1]:.1f}"
