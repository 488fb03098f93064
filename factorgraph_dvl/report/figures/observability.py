"""Figures of observability: singular values, σ along the trial, weak directions, shares."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from factorgraph_dvl.analysis.information.linearization import PointSet
from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.analysis.information.marginals import OPEN, Marginals
from factorgraph_dvl.analysis.information.observability import Observability, Shares
from factorgraph_dvl.analysis.information.segment_singular_values import (
    OBSERVABLE,
    SPURIOUS,
    SingularValues,
)
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.figures.calibration import heat_map, readable
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    LIGHT,
    NORMAL,
    SMALL,
    TITLE,
    Canvas,
    clock,
    log_axis,
    new_figure,
    new_grid,
    save_figures,
    style,
)
from factorgraph_dvl.statistics.information_history import InformationHistory

# Of what is drawn for each kind of motion; mixtures take that of their last kind.
_SHADES = {
    "drifting": "#f4efe3",
    "steady": "#ffffff",
    "turning": "#dcebf7",
    "accelerating": "#f7e3d4",
    "other": "#eeeeee",
}
_SHARE_COLOURS = {
    "drifting": "#c9b37e",
    "steady": "#9a9a9a",
    "turning": ACCENT,
    "accelerating": "#d07b3c",
    "other": "#dddddd",
}
_LINES = ((ACCENT, "-"), (DARK, "--"), ("#d07b3c", "-."), (GREY, ":"))
_BEAM_COLOURS = (ACCENT, DARK, "#d07b3c", "#5b8c5a", GREY, "#a0478f")
_MOST_IN_A_LINE = 8
_MOST_NAMED = 10
_MOST_TICKS = 24
_FLOOR = 1e-2


def write_observability_figures(
    view: Observability, folder: Path, verdict: Verdict | None = None, *, kind: str = "png"
) -> list[Path]:
    """Draw what there is; return the paths of the files.

    `singular_values.png`, `std_along_trial.png`, `correlation.png`, `directions.png`,
    `shares.png`; those for which there is nothing to draw are left out.

    Parameters
    ----------
    view : Observability
        What to draw.
    folder : path-like
        Where the PNG files go.
    verdict : Verdict, optional
        Verdict on the result.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside them.
    """
    figures: dict[str, Canvas] = {}
    segments = [m.segment for m in view.segments]
    if view.point_set is not None:
        figures["singular_values"] = singular_value_figure(view.point_set)
    if view.history is not None and view.history.names and view.history.time.size > 1:
        figures["std_along_trial"] = history_figure(view.history, segments)
    if view.marginals is not None:
        if len(view.marginals.names) > 1:
            figures["correlation"] = heat_map(view.marginals.names, view.marginals.correlation)
        figures["directions"] = direction_figure(view.marginals)
    if view.shares is not None:
        figures["shares"] = share_figure(view.shares, segments)
    return save_figures(figures, folder, verdict, name=view.name, kind=kind)


def singular_value_figure(point_set: PointSet) -> Figure:
    """Draw singular values of each segment and of all up to its end, on a log axis."""
    count = len(point_set.segments)
    figure = new_figure(min(max(11.0, 2.0 + 0.95 * count), 18.0), 7.2)
    grid = new_grid(figure, 2, 1, bottom=0.95, top=0.7, gap=(0.42, 0.0))
    kinds = list(dict.fromkeys(_kind(state) for state in point_set.states))
    colours = dict(zip(kinds, (ACCENT, "#d07b3c", DARK, GREY, "#5b8c5a"), strict=False))
    stacks_of_all = (*point_set.segments, *point_set.cumulative)
    highest = max(float(s.values.max()) for s in stacks_of_all)
    lowest = min(float(s.values.min()) for s in stacks_of_all)
    for i, (stacks, title) in enumerate(
        (
            (point_set.segments, "Singular values of each segment"),
            (point_set.cumulative, "Singular values of all data up to the end of each segment"),
        )
    ):
        ax = figure.add_subplot(grid[i, 0])
        for x, stack in enumerate(stacks):
            _draw_stack(ax, x, stack, colours, named=count <= _MOST_NAMED)
        log_axis(ax, "y", max(_FLOOR, min(lowest, 1.0)), 2.5 * max(highest, 10.0))
        ax.axhline(OBSERVABLE, color=GREY, lw=0.9)
        ax.set_xlim(-0.4, count - 0.25 if count <= _MOST_NAMED else count - 0.6)
        style(ax, "", "singular value")
        ax.set_title(title, fontsize=TITLE, loc="left")
        every = -(-count // _MOST_TICKS)
        shown = range(0, count, every)
        labels = [_segment_label(point_set.segments[k].segment) for k in shown]
        ax.set_xticks(list(shown), labels, fontsize=SMALL)
        if count > _MOST_NAMED:
            ax.tick_params(axis="x", rotation=90)
        if i == 0:
            ax.tick_params(labelbottom=False)
    handles = [
        *(Line2D([], [], ls="", marker="o", color=colours[k], label=k) for k in kinds),
        Line2D([], [], ls="", marker="o", color=GREY, mfc="none", label="spurious, from noise"),
        Line2D([], [], ls="", marker="v", color=GREY, label=f"below {_FLOOR:g}"),
        Line2D([], [], color=GREY, lw=0.9, label="prior σ halved"),
    ]
    figure.legend(
        handles=handles, loc="upper left", ncols=len(handles), fontsize=NORMAL, frameon=False
    )
    figure.text(0.992, 0.012, _wrapped(point_set.scaling), ha="right", fontsize=SMALL, color=GREY)
    return figure


def _draw_stack(
    ax: Axes, x: int, stack: SingularValues, colours: dict[str, str], *, named: bool
) -> None:
    placed = np.inf
    for i, value in enumerate(stack.values):
        names = stack.dominant(i)
        colour = colours[_kind(names[0])]
        shown = max(float(value), _FLOOR)
        real = float(stack.spurious[i]) < SPURIOUS
        ax.plot(
            x,
            shown,
            "o" if value > _FLOOR else "v",
            color=colour,
            mfc=colour if real else "none",
            ms=5,
        )
        # Labels of values that nearly coincide would lie on top of one another.
        if named and shown < 0.62 * placed:
            text = ", ".join(_short(n) for n in names[:2]) + ("…" if len(names) > 2 else "")
            ax.annotate(
                text,
                (x, shown),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontsize=6.5,
                color=DARK,
                bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.5},
            )
            placed = shown


def history_figure(history: InformationHistory, segments: Sequence[Segment]) -> Figure:
    """Draw σ of every constant along the trial, on log axes, over the manoeuvres."""
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(history.names):
        groups.setdefault(_stem(name), []).append(i)
    rows = -(-len(groups) // 2)
    columns = min(len(groups), 2)
    figure = new_figure(11.5, 1.25 + 2.05 * rows)
    grid = new_grid(figure, rows, columns, bottom=0.5, top=0.78, gap=(0.5, 0.75), left=0.65)
    start, label = clock(history.time)
    std = history.std
    for k, (stem, members) in enumerate(groups.items()):
        ax = figure.add_subplot(grid[k // columns, k % columns])
        _shade(ax, segments, start)
        for at, i in enumerate(members):
            own = readable(history.names[i])[0].removeprefix(stem).strip() or "σ"
            colour, dashes = _line(own, at)
            ax.plot(history.time - start, std[:, i], color=colour, ls=dashes, lw=1.3, label=own)
        log_axis(ax, "y", float(std[:, members].min()), float(std[:, members].max()))
        _, unit = readable(history.names[members[0]])
        last_row = k // columns == rows - 1 or k + columns >= len(groups)
        style(ax, label if last_row else "", "")
        ax.set_axisbelow(False)
        ax.grid(color=GREY, lw=0.4, alpha=0.35)
        ax.margins(x=0.0)
        ax.set_title(f"{stem}, {unit}" if unit else stem, fontsize=NORMAL, loc="left")
        entries = len(members) if len(members) <= _MOST_IN_A_LINE else -(-len(members) // 2)
        ax.legend(fontsize=SMALL, frameon=False, ncols=entries, loc="upper right")
    _shade_legend(figure, segments, "σ given all data up to a time")
    return figure


def _line(component: str, place: int) -> tuple[str, str]:
    """Return colour and dashes of a component; those of one beam have one colour."""
    if not component[0].isdigit():
        return _LINES[place % len(_LINES)]
    beam = int(component.rstrip("xy")) - 1
    return _BEAM_COLOURS[beam % len(_BEAM_COLOURS)], "--" if component.endswith("y") else "-"


def _shade(ax: Axes, segments: Sequence[Segment], start: float) -> None:
    for s in segments:
        ax.axvspan(s.start - start, s.end - start, color=_SHADES[_motion(s)], lw=0, zorder=0)


def _shade_legend(figure: Figure, segments: Sequence[Segment], title: str) -> None:
    kinds = [k for k in _SHADES if any(_motion(s) == k for s in segments)]
    figure.legend(
        handles=[Patch(facecolor=_SHADES[k], edgecolor=GREY, lw=0.4, label=k) for k in kinds],
        loc="upper left",
        ncols=max(len(kinds), 1),
        fontsize=NORMAL,
        frameon=False,
        title=title,
        title_fontsize=TITLE,
        alignment="left",
    )


def direction_figure(marginals: Marginals) -> Figure:
    """Draw what is left of the prior's σ in every direction, the weakest first."""
    directions = marginals.directions
    figure = new_figure(11.0, 1.15 + 0.3 * len(directions))
    grid = new_grid(figure, 1, 1, left=4.3, right=0.5, top=0.42, bottom=0.5)
    ax = figure.add_subplot(grid[0, 0])
    ratio = np.array([d.ratio for d in directions])
    y = np.arange(len(directions))
    floor = 10.0 ** np.floor(np.log10(max(float(ratio.min()), 1e-12)) - 0.2)
    colour = [GREY if r >= OPEN else ACCENT for r in ratio]
    ax.barh(y, ratio - floor, left=floor, color=colour, height=0.62)
    for k, r in enumerate(ratio):
        ax.text(
            r * 1.12,
            k,
            f"{min(r, 1.0):.2g}",
            va="center",
            fontsize=SMALL,
            color=DARK,
            # Above the line of a halved σ.
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )
    log_axis(ax, "x", floor, 1.3)
    ax.set_xlim(left=floor)
    ax.axvline(OPEN, color=GREY, lw=0.9)
    labels = [_combination(d.names, d.vector, marginals.names) for d in directions]
    ax.set_yticks(y, labels, fontsize=SMALL)
    ax.invert_yaxis()
    style(ax, "posterior σ / prior σ along the direction (line: halved)", "")
    ax.grid(axis="y", visible=False)
    ax.set_title("Directions, the weakest first", fontsize=TITLE, loc="left")
    return figure


def _combination(names: Sequence[str], vector: Array, order: Sequence[str]) -> str:
    """Write a direction as a sum, in units of the priors' σ."""
    parts: list[str] = []
    for name in names[:3]:
        weight = float(vector[order.index(name)])
        sign = "−" if weight < 0.0 else "+" if parts else ""
        # Directions and scale errors with a number are those of beams.
        short = re.sub(r"^beam (?=.* \d)", "", readable(name)[0])
        parts.append(f"{sign} {abs(weight):.2f} {short}".strip())
    return " ".join(parts) + (" …" if len(names) > 3 else "")


def share_figure(shares: Shares, segments: Sequence[Segment]) -> Figure:
    """Draw from which kind of motion the information on each component came."""
    n = len(shares.names)
    figure = new_figure(11.0, 1.25 + 0.3 * n)
    grid = new_grid(figure, 1, 1, left=1.75, right=0.3, top=0.72, bottom=0.5)
    ax = figure.add_subplot(grid[0, 0])
    y = np.arange(n)
    at = np.maximum(shares.prior, 0.0)
    ax.barh(y, at, color=LIGHT, height=0.66, edgecolor="white", lw=0.5)
    for segment, part in zip(segments, shares.segments, strict=True):
        colour = _SHARE_COLOURS[_motion(segment)]
        ax.barh(y, part, left=at, color=colour, height=0.66, edgecolor="white", lw=0.5)
        at = at + part
    ax.set_yticks(y, [readable(name)[0] for name in shares.names], fontsize=SMALL)
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.0)
    style(ax, "share, one piece for each segment in its order", "")
    ax.grid(axis="y", visible=False)
    kinds = [k for k in _SHARE_COLOURS if any(_motion(s) == k for s in segments)]
    figure.legend(
        handles=[
            Patch(facecolor=LIGHT, label="prior"),
            *(Patch(facecolor=_SHARE_COLOURS[k], label=k) for k in kinds),
        ],
        loc="upper left",
        ncols=len(kinds) + 1,
        fontsize=NORMAL,
        frameon=False,
        title="Where the information on each component came from",
        title_fontsize=TITLE,
        alignment="left",
    )
    return figure


def _motion(segment: Segment) -> str:
    """Return the kind of motion that colours a segment."""
    last = segment.label.split(" and ")[-1]
    return last if last in _SHADES else "other"


def _segment_label(segment: Segment) -> str:
    return f"{segment.label}\nto {segment.end:.0f} s".replace(" and ", ",\n")


def _stem(component: str) -> str:
    name, _ = readable(component)
    head, _, tail = name.rpartition(" ")
    # Components are single letters; those of beams are numbered.
    return head if head and (len(tail) == 1 or tail[0].isdigit()) else name


def _kind(component: str) -> str:
    return _stem(component)


def _short(component: str) -> str:
    name = readable(component)[0].replace("beam direction ", "d").replace("beam scale error ", "k")
    return name.replace("misalignment", "α").replace("scale error", "δK").replace("lever arm", "l")


def _wrapped(text: str) -> str:
    return text if len(text) < 170 else text.replace(", rows", ",\nrows", 1)
