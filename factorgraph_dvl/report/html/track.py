"""The track from above, as SVG on a plain grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.html.markup import Html, labels, round_step, tspans

# Size of the drawing and its margins, in its own units.
_SIZE = 720.0
_MARGIN = 90.0
# Points of the track closer than this, in the drawing's units, are one. Chosen: half a line.
_APART = 0.8
# About as many lines of the grid to each side, and marks of time on the track.
_LINES = 6
_MARKS = 6


def track_svg(trajectory: Trajectory) -> Html:
    """Return the track, with its start, its end, marks of time, a compass and a grid.

    Parameters
    ----------
    trajectory : Trajectory
        The track; positions are drawn from its start, in metres.
    """
    known = np.isfinite(trajectory.geodetic).all(axis=1)
    time = trajectory.time[known]
    geodetic = trajectory.geodetic[known]
    frame = LocalFrame(*geodetic[0])
    places = frame.position(*geodetic.T)[:, :2]
    low, high = places.min(axis=0), places.max(axis=0)
    span = max(float((high - low).max()), 1.0)
    middle = 0.5 * (low + high)
    scale = (_SIZE - 2.0 * _MARGIN) / (1.08 * span)

    def pixel(p: Array) -> Array:
        """Return places (M, 2), m, in the drawing, (M, 2)."""
        return 0.5 * _SIZE + (np.atleast_2d(p) - middle) * [scale, -scale]

    step = round_step(span / _LINES)
    unit, metres = ("km", 1000.0) if step >= 1000.0 else ("m", 1.0)
    parts = [
        f'<svg viewBox="0 0 {_SIZE:g} {_SIZE:g}" role="img" class="track" {_label()}>',
        f'<rect class="ground" x="{_MARGIN:g}" y="{_MARGIN:g}" width="{_SIZE - 2 * _MARGIN:g}" '
        f'height="{_SIZE - 2 * _MARGIN:g}"/>',
        *_grid(middle, (_SIZE - 2.0 * _MARGIN) / scale, step, metres, pixel),
        f'<path class="way" d="{_path(pixel(places))}"/>',
    ]
    interval = round_step(float(time[-1] - time[0]) / _MARKS) if time.size > 1 else 0.0
    if interval > 0.0:
        marks = np.arange(interval, float(time[-1] - time[0]), interval)
        for t in marks:
            k = int(np.searchsorted(time, time[0] + t))
            x, y = pixel(places[k])[0]
            # The number stands on the side on which the track was going least.
            ahead = places[min(k + 1, len(places) - 1)] - places[max(k - 1, 0)]
            side = "" if abs(ahead[1]) >= abs(ahead[0]) else " above"
            dx, dy = (9.0, 4.0) if not side else (0.0, -9.0)
            parts.append(f'<circle class="mark" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>')
            parts.append(
                f'<text class="when{side}" x="{x + dx:.1f}" y="{y + dy:.1f}">{t:g} s</text>'
            )
    (x0, y0), (x1, y1) = pixel(places[[0, -1]])
    parts += [
        f'<circle class="start" cx="{x0:.1f}" cy="{y0:.1f}" r="7"/>',
        f'<rect class="end" x="{x1 - 6:.1f}" y="{y1 - 6:.1f}" width="12" height="12"/>',
        _compass(_SIZE - _MARGIN - 26.0, _MARGIN + 44.0),
        f'<text class="axis" x="{0.5 * _SIZE:g}" y="{_SIZE - 8:g}">'
        f"{tspans(f'east of start, {unit}', f'起点以东，{unit}')}</text>",
        f'<text class="axis" transform="translate(14 {0.5 * _SIZE:g}) rotate(-90)">'
        f"{tspans(f'north of start, {unit}', f'起点以北，{unit}')}</text>",
        "</svg>",
    ]
    return Html("".join(parts))


def _label() -> str:
    given = labels("Track from above")
    return " ".join(f'{key.replace("_", "-")}="{text}"' for key, text in given.items())


def _grid(
    middle: Array, width: float, step: float, metres: float, pixel: Callable[[Array], Array]
) -> list[str]:
    out = []
    for axis in (0, 1):
        first = np.ceil((middle[axis] - 0.5 * width) / step)
        last = np.floor((middle[axis] + 0.5 * width) / step)
        for k in np.arange(first, last + 1):
            at = middle.copy()
            at[axis] = k * step
            x, y = pixel(at)[0]
            number = f"{k * step / metres + 0.0:g}".replace("-", "−")
            if axis == 0:
                out.append(
                    f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_MARGIN:g}" '
                    f'y2="{_SIZE - _MARGIN:g}"/><text class="tick" x="{x:.1f}" '
                    f'y="{_SIZE - _MARGIN + 18:g}">{number}</text>'
                )
            else:
                out.append(
                    f'<line class="grid" y1="{y:.1f}" y2="{y:.1f}" x1="{_MARGIN:g}" '
                    f'x2="{_SIZE - _MARGIN:g}"/><text class="tick side" x="{_MARGIN - 6:g}" '
                    f'y="{y + 4:.1f}">{number}</text>'
                )
    return out


def _compass(x: float, y: float) -> str:
    return (
        f'<g class="compass" transform="translate({x:g} {y:g})"><circle r="20"/>'
        '<path d="M0,-18 L6,12 L0,6 L-6,12 Z"/><text y="-24">N</text></g>'
    )


def _path(points: Array) -> str:
    """Return a path through points (M, 2), without those that no one sees apart."""
    cells = np.round(points / _APART)
    kept = np.ones(len(points), dtype=bool)
    kept[1:] = np.any(np.diff(cells, axis=0) != 0.0, axis=1)
    text = " ".join(f"{x:g},{y:g}" for x, y in np.round(points[kept], 1))
    return f"M{text}"
