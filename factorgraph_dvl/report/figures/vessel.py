"""The vessel from above and from the side, to scale, in axes of Matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.figures.drawing import DARK, GREY, PALE, SMALL
from factorgraph_dvl.report.vessel import SHORTEST, Place, beams, ellipse, label_places, seen

# Chosen: free space, axes and beams, as shares of the width of a vessel.
_FREE, _AXIS, _BEAM = 0.9, 0.3, 0.45
_COLOURS = ("#b34700", "#00694b", "#332288")


def draw_vessel(
    ax: Axes,
    view: Array,
    places: Sequence[Place],
    axes: Array,
    said: Callable[[str], str] = str,
) -> None:
    """Draw a view of a vessel: its instruments, and the axes and beams of its DVL.

    Parameters
    ----------
    ax : Axes
        Where to draw.
    view : ndarray, shape (2, 3)
        What is seen to the right and upward, of forward, starboard, down.
    places : sequence of Place
        Instruments, the DVL last.
    axes : ndarray, shape (3, 3)
        Axes of the DVL, a column each, in forward, starboard, down.
    said : callable, optional
        Translates names.
    """
    points, middle, span = seen(view, places)
    half = (0.5 + _FREE) * span
    box = ax.get_window_extent()
    wide = half * max(float(box.width / box.height), 1.0)
    tall = half * max(float(box.height / box.width), 1.0)
    ax.set_xlim(middle[0] - wide, middle[0] + wide)
    ax.set_ylim(middle[1] - tall, middle[1] + tall)
    ax.set_aspect("equal", adjustable="box")
    ax.set_facecolor(PALE)
    ax.spines[:].set_color(GREY)
    ax.tick_params(labelsize=SMALL, length=3, color=GREY)
    at = points[-1]
    ax.plot(*np.stack([points[0], at]).T, color=GREY, lw=0.8, ls=":")
    for beam in beams():
        ax.plot(*np.stack([at, at + _BEAM * span * (view @ axes @ beam)]).T, color=GREY, lw=0.8,
                ls="--")  # fmt: skip
    for k, (name, colour) in enumerate(zip(FRD_NAMES, _COLOURS, strict=True)):
        axis = view @ axes[:, k]
        length = float(np.hypot(*axis))
        if length < SHORTEST:
            continue
        end = at + _AXIS * span * axis
        ax.annotate("", end, at, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.3})
        side = axis[0] / length
        ax.annotate(
            said(name), end, (6.0 * side, 6.0 * axis[1] / length),
            textcoords="offset points", color=colour, fontsize=SMALL, va="center",
            ha="left" if side > 0.5 else "right" if side < -0.5 else "center",
        )  # fmt: skip
    for place, xy in zip(places, points, strict=True):
        _draw_ellipse(ax, xy, view @ place.covariance @ view.T)
    ax.plot(*points.T, "o", color=DARK, ms=4)
    # A name is on the side without other points; that of the DVL, where its axes leave room.
    sides = np.stack([*(points[:-1] - points.mean(axis=0)), -(view @ axes.sum(axis=1))])
    names = [said(place.name) for place in places]
    scale = 72.0 * min(box.width / wide, box.height / tall) / (2.0 * ax.figure.dpi)
    widths = [SMALL * sum(0.7 if letter.isascii() else 1.1 for letter in name) for name in names]
    found = label_places(points * [scale, -scale], sides * [1.0, -1.0], widths, 1.3 * SMALL)
    for name, xy, (right, below, far) in zip(names, points, found, strict=True):
        ax.annotate(
            name, xy, (0.65 * SMALL * (1 if right else -1), -far if below else far),
            textcoords="offset points", fontsize=SMALL, fontweight="bold", color=DARK,
            ha="left" if right else "right", va="top" if below else "bottom",
        )  # fmt: skip


def _draw_ellipse(ax: Axes, at: Array, covariance: Array) -> None:
    found = ellipse(covariance)
    if found is None:
        return
    a, b, angle = found
    place = (float(at[0]), float(at[1]))
    ax.add_patch(Ellipse(place, 2.0 * a, 2.0 * b, angle=angle, fc="#0072b233", ec="#0072b2"))
