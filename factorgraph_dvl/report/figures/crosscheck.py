"""Figures of a cross-check, as PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from factorgraph_dvl.analysis.comparison.calibration_difference import AGREE_SIGMAS, Component
from factorgraph_dvl.analysis.comparison.crosscheck import CrossCheck
from factorgraph_dvl.analysis.comparison.motion_difference import (
    COMPONENTS,
    MotionDifference,
    joined_errors,
)
from factorgraph_dvl.quality.notation import split_unit, with_std
from factorgraph_dvl.report.figures.calibration import readable
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    LIGHT,
    NORMAL,
    SMALL,
    TITLE,
    clock,
    draw_band,
    draw_line,
    envelope,
    new_figure,
    new_grid,
    save_figures,
    style,
    typeset,
    verdict_label,
)
from factorgraph_dvl.solution import Solution

_RED = "#c0392b"
_COLORS = {"agree": ACCENT, "differ": _RED, "not comparable": GREY}
# Further out, how far is only a number.
_EDGE = 8.0
# Margin for the names of components, and from the panel to the verdicts, inches. Chosen: the
# longest names and differences fit.
_LEFT, _TO_VERDICT = 1.6, 2.0
_GROUPS = ("Position", "Velocity", "Attitude")


def write_crosscheck_figures(check: CrossCheck, folder: Path, *, kind: str = "png") -> list[Path]:
    """Draw a cross-check; figures for which there is nothing to draw are left out.

    Parameters
    ----------
    check : CrossCheck
        What to draw.
    folder : path-like
        Where the PNG files go; created if needed.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside them.

    Returns
    -------
    list of Path
        The files: `parameters.png`, `differences.png`, `errors.png`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {}
    if any(np.isfinite(c.difference) for c in check.components):
        figures["parameters"] = _parameters(check)
    if check.motion is not None:
        figures["differences"] = _differences(check.motion)
    if check.truth_a.trajectory is not None or check.truth_b.trajectory is not None:
        figures["errors"] = _errors(check)
    sides = [_side(name, side) for name, side in (("A", check.a), ("B", check.b))]
    trial = check.a.trial or check.b.trial
    return save_figures(figures, folder, name=trial, note="   ".join(sides), kind=kind)


def _side(name: str, solution: Solution) -> str:
    """Return what a figure says of a result: its solver, its grade and the reasons."""
    return f"{name}: {solution.solver or 'external'}, {verdict_label(solution.verdict)}"


def _parameters(check: CrossCheck) -> Figure:
    """Draw A − B of every component that both have, over its standard deviation."""
    rows = [c for c in check.components if np.isfinite(c.difference)]
    right = _TO_VERDICT + 0.3 + 0.062 * max(len(_verdict(c)) for c in rows)
    # The margins take at most half of a figure.
    figure = new_figure(max(6.2 + right, 2.0 * (_LEFT + right)), 1.2 + 0.3 * len(rows))
    grid = new_grid(figure, 1, 1, left=_LEFT, right=right, top=0.65)
    ax = figure.add_subplot(grid[0, 0])
    ax.axvspan(-AGREE_SIGMAS, AGREE_SIGMAS, color=LIGHT, lw=0, zorder=0)
    ax.axvline(0.0, color=GREY, lw=0.8, zorder=1)
    for y, c in enumerate(rows):
        _draw_component(ax, y, c)
    ax.set_xlim(-_EDGE - 0.6, _EDGE + 0.6)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    style(ax, "(A − B) / σ of A − B", "")
    ax.grid(visible=False, axis="y")
    ax.set_xticks([-6, -3, 0, 3, 6], ["−6", "−3", "0", "3", "6"])
    ax.set_yticks(range(len(rows)), [readable(c.name)[0] for c in rows], fontsize=NORMAL)
    ax.tick_params(axis="y", length=0)
    ax.spines["left"].set_visible(False)
    shown = dict.fromkeys(c.kind for c in rows)
    band = f"agree: inside ±{AGREE_SIGMAS:g}σ"
    sigma = "σ: " + (" or ".join(k for k in shown if k != "none") or "none")
    legend = [
        *ax.plot([], [], "o", color=ACCENT, ms=5, label="agree"),
        *ax.plot([], [], "o", color=_RED, ms=5, label="differ"),
        *ax.plot([], [], "o", color=GREY, ms=5, mfc="white", label="not comparable"),
        *ax.plot([], [], color=ACCENT, lw=1.6, label="±1σ"),
        *ax.plot([], [], color=LIGHT, lw=9, label=band),
    ]
    figure.legend(
        handles=legend,
        loc="upper left",
        borderaxespad=0.3,
        ncols=len(legend),
        fontsize=NORMAL,
        frameon=False,
        title=f"Calibration, A − B; {sigma}",
        title_fontsize=TITLE,
        alignment="left",
    )
    return figure


def _draw_component(ax: Axes, y: int, c: Component) -> None:
    color = _COLORS[c.verdict]
    z = c.in_sigmas
    face = "white" if c.verdict == "not comparable" else color
    if abs(z) > _EDGE:
        side = float(np.sign(z))
        ax.plot(side * _EDGE, y, ">" if side > 0 else "<", color=color, ms=7, mfc=face)
    elif np.isfinite(z):
        ax.plot([z - 1.0, z + 1.0], [y, y], color=color, lw=1.6, zorder=2)
        ax.plot(z, y, "o", color=color, ms=5, mfc=face, zorder=3)
    unit = split_unit(c.name)[1]
    known = np.isfinite(c.std) and c.std > 0.0
    difference = with_std(c.difference, c.std) if known else f"{c.difference:.4g}"
    kind = "" if c.kind in ("none", "upper bound") else f"({c.kind})"
    difference = typeset(" ".join(part for part in (difference, unit, kind) if part))
    for inches, text, text_color in (
        (0.1, difference, DARK),
        (_TO_VERDICT, _verdict(c), color),
    ):
        ax.annotate(
            text,
            (1.0, y),
            xycoords=ax.get_yaxis_transform(),
            xytext=(72.0 * inches, 0.0),
            textcoords="offset points",
            va="center",
            fontsize=SMALL,
            color=text_color,
        )


def _verdict(c: Component) -> str:
    return f"{c.verdict}: {c.reason}" if c.reason else c.verdict


def _differences(motion: MotionDifference) -> Figure:
    """Draw A − B over time within ±3σ of what is shown."""
    figure = new_figure(12.0, 6.2)
    axes = new_grid(figure, 3, 3, top=0.5).subplots(sharex=True, squeeze=False)
    start, time_label = clock(motion.time)
    time = motion.time - start
    for i, name in enumerate(COMPONENTS):
        ax = axes[i % 3, i // 3]
        if np.isfinite(motion.std[:, i]).all():
            draw_band(ax, time, 3.0 * motion.std[:, i])
        draw_line(ax, time, motion.difference[:, i])
        ax.axhline(0.0, color=GREY, lw=0.5)
        _label(ax, i, name, time_label)
        if i % 3 == 0:
            kinds = dict.fromkeys(k for k in motion.kinds[i : i + 3] if k != "none")
            band = f", ±3σ ({', '.join(kinds)})" if kinds else ""
            ax.set_title(f"{_GROUPS[i // 3]}, A − B{band}", fontsize=TITLE, loc="left")
    return figure


def _errors(check: CrossCheck) -> Figure:
    """Draw the errors of both against the reference, each within its ±3σ."""
    sides = [("A", check.truth_a.trajectory, ACCENT), ("B", check.truth_b.trajectory, DARK)]
    present = [(side, errors, color) for side, errors, color in sides if errors is not None]
    figure = new_figure(12.0, 6.2)
    axes = new_grid(figure, 3, 3, top=0.6).subplots(sharex=True, squeeze=False)
    start, time_label = clock(np.concatenate([errors.time for _, errors, _ in present]))
    # The smaller error would vanish behind the larger.
    present.sort(key=lambda item: -float(np.mean(joined_errors(item[1])[0][:, 3:6] ** 2)))
    for side, errors, color in present:
        error, std = joined_errors(errors)
        time = errors.time - start
        for i in range(len(COMPONENTS)):
            ax = axes[i % 3, i // 3]
            for sign in (-3.0, 3.0):
                bucket_time, _, high = envelope(time, std[:, i])
                ax.plot(bucket_time, sign * high, color=color, lw=0.7, dashes=(4, 3))
            bucket_time, low, high = envelope(time, error[:, i])
            ax.fill_between(
                bucket_time, low, high, color=color, alpha=0.5, lw=0.8, label=f"error of {side}"
            )
    for i, name in enumerate(COMPONENTS):
        ax = axes[i % 3, i // 3]
        _label(ax, i, name, time_label)
        if i % 3 == 0:
            ax.set_title(f"{_GROUPS[i // 3]}: error", fontsize=TITLE, loc="left")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    handles = [handle for _, handle in sorted(zip(labels, handles, strict=True), key=_label_of)]
    handles += axes[0, 0].plot([], [], color=GREY, lw=0.8, dashes=(4, 3), label="±3σ of each")
    figure.legend(
        handles=handles,
        loc="upper left",
        ncols=3,
        fontsize=NORMAL,
        frameon=False,
        borderaxespad=0.2,
    )
    return figure


def _label_of(item: tuple[object, object]) -> str:
    return str(item[0])


def _label(ax: Axes, i: int, name: str, time_label: str) -> None:
    words, unit = split_unit(name)
    axis = {"e": "east", "n": "north", "u": "up"}
    last = words.split("_")[-1]
    style(ax, time_label if i % 3 == 2 else "", f"{axis.get(last, last)}, {unit}")
