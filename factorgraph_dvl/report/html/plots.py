"""Plots over time: data for uPlot, a text that describes each, and a table of its values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgraph_dvl.analysis.information.manoeuvres import Segment
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.texts import chinese
from factorgraph_dvl.report.html.envelope import Envelope, envelope, packed, packed_times
from factorgraph_dvl.report.html.markup import (
    Cell,
    Html,
    both,
    element,
    folded,
    joined,
    labels,
    table,
)

# Okabe and Ito's colours, which colour-blind readers distinguish; dashes for those who see none.
_COLOURS = ("#0072b2", "#b34700", "#00694b", "#8a2f6b", "#555555", "#7a5c00")
_DASHES: tuple[list[int], ...] = ([], [8, 4], [2, 3], [10, 3, 2, 3], [4, 8], [1, 5])
# Heights of plots, pixels. Chosen: residuals need less, and have a plot for each component.
_HIGH, _LOW = 230, 150
# Rows of the table below a plot. Chosen: what fits on a screen.
_ROWS = 11


@dataclass(frozen=True)
class Plot:
    """Values over time.

    Parameters
    ----------
    key : str
        Identifier in the page.
    title : str
        What is shown, as `words` lists it.
    unit : str
        Unit of the values; empty if they have none.
    names : sequence of str
        Names of the d components.
    time : ndarray, shape (M,), s
        Times in order.
    values : ndarray, shape (M, d)
        Values; nan where there are none.
    segments : sequence of Segment, optional
        Manoeuvres to shade.
    limit : float, optional
        Values beyond ± this are arrows at the edge, with their number; nan = none.
    band : float, optional
        Draw lines at ± this; nan = none.
    about : str, optional
        What it is about, before the title: a measurement or a parameter.
    log : bool, default False
        Draw on a logarithmic axis; values that are not above 0 are left out.
    cycle : float, optional
        Values that differ by this are the same, such as angles; nan = none. The values are
        unwrapped, and shown in a range in which they rarely pass from end to end.
    axis : str, optional
        Title of the vertical axis, as `words` lists it; by default `title`.
    """

    key: str
    title: str
    unit: str
    names: Sequence[str]
    time: Array
    values: Array
    segments: Sequence[Segment] = field(default_factory=tuple)
    limit: float = np.nan
    band: float = np.nan
    about: str = ""
    log: bool = False
    cycle: float = np.nan
    axis: str = ""

    def data(self, start: float) -> dict[str, Any]:
        """Return what the script draws, with times from `start`, s."""
        found = self._wrapped(envelope(self.time - start, self._drawn()))
        limited = np.isfinite(self.limit)
        clip = self.limit if limited else np.inf
        series = []
        for i in range(self.values.shape[1]):
            low, high = found.low[:, i], found.high[:, i]
            outside = (low < -clip) | (high > clip)
            packed_series = packed(np.clip(low, -clip, clip), np.clip(high, -clip, clip))
            series.append(
                packed_series
                | {
                    "name": self.names[i],
                    "name_zh": chinese(self.names[i]),
                    "colour": _COLOURS[i % len(_COLOURS)],
                    "dash": _DASHES[i % len(_DASHES)],
                    "outside": np.flatnonzero(outside).tolist() if limited else [],
                }
            )
        return {
            "key": self.key,
            "height": _LOW if limited else _HIGH,
            "unit": self.unit,
            "label": self._label(self.axis or self.title),
            "label_zh": self._label(chinese(self.axis or self.title)),
            "log": self.log,
            "time": packed_times(found.time),
            "series": series,
            "limit": float(self.limit) if limited else None,
            "band": float(self.band) if np.isfinite(self.band) else None,
            "shade": [
                [s.start - start, s.end - start, s.label]
                for s in self.segments
                if s.label not in ("steady", "other")
            ],
        }

    def _label(self, title: str) -> str:
        return f"{title}, {self.unit}" if self.unit else title

    def _wrapped(self, found: Envelope) -> Envelope:
        """Return an envelope in one cycle, with a gap where it passes from end to end."""
        if not np.isfinite(self.cycle):
            return found
        candidates = []
        for least in (0.0, -0.5 * self.cycle):
            turn = np.floor((found.low - least) / self.cycle)
            passes = np.floor((found.high - least) / self.cycle) != turn
            down = np.where(passes, np.nan, self.cycle * turn)
            # Where the next interval is in another cycle, no line must lead there. The gap is
            # wider than a pixel.
            jump = np.flatnonzero(np.any(np.diff(turn, axis=0) != 0.0, axis=1))
            for near in (-1, 0, 1):
                down[np.clip(jump + near, 0, len(down) - 1)] = np.nan
            candidates.append((passes.sum() + jump.size, down))
        down = min(candidates, key=lambda c: c[0])[1]
        return Envelope(found.time, found.low - down, found.high - down)

    def _drawn(self) -> Array:
        """Return what is drawn; the logarithms of base 10 on a logarithmic axis."""
        if not self.log:
            return self.values
        return np.log10(np.where(self.values > 0.0, self.values, np.nan))

    def html(self, start: float) -> Html:
        """Return the place of the plot in the page, its legend, and a table of its values."""
        english, own = self._label(self.title), self._label(chinese(self.title))
        if self.about:
            english, own = f"{self.about}: {english}", f"{chinese(self.about)}：{own}"
        title = both(english, own)
        legend = [
            element(
                "li",
                element("span", class_="line", style=_line(i), aria_hidden="true"),
                both(name),
                *self._outside(i),
            )
            for i, name in enumerate(self.names)
        ]
        canvas = element(
            "div",
            class_="canvas",
            id_=self.key,
            role="img",
            tabindex="0",
            **labels_of(english, own),
        )
        return element(
            "figure",
            element("figcaption", title),
            element("ul", *legend, class_="legend"),
            canvas,
            element("p", Html("&nbsp;"), class_="readout", aria_live="polite"),
            folded("Table", self._table(start)),
        )

    def _outside(self, i: int) -> list[Cell]:
        """Return how many values of a component lie beyond the limit."""
        if not np.isfinite(self.limit):
            return []
        size = np.abs(self.values[:, i])
        count = int((size > self.limit).sum())
        if not count:
            return []
        largest = float(np.nanmax(size))
        return [
            both(
                f": {count} beyond the panel, up to {largest:.0f}",
                f"：{count} 个超出图幅，最大 {largest:.0f}",
            )
        ]

    def _table(self, start: float) -> Html:
        rows = np.unique(np.linspace(0, self.time.size - 1, _ROWS).astype(int))
        values = np.mod(self.values, self.cycle) if np.isfinite(self.cycle) else self.values
        cells = [[f"{self.time[k] - start:.1f}", *(_number(v) for v in values[k])] for k in rows]
        known = [bool(np.isfinite(column).any()) for column in values.T]
        for name, reduce in (("least", np.nanmin), ("largest", np.nanmax)):
            found = [
                _number(float(reduce(values[:, i]))) if known[i] else "–"
                for i in range(len(known))
            ]
            cells.append([name, *found])
        body = [[both(row[0]) if row[0] in ("least", "largest") else row[0], *row[1:]]
                for row in cells]  # fmt: skip
        return table(
            [both("time, s"), *(both(name) for name in self.names)],
            body,
            label=self.title,
            numeric=range(1, len(self.names) + 1),
        )


def labels_of(english: str, own: str) -> dict[str, str]:
    """Return the attributes of `markup.labels` for a composed text."""
    return labels(english) | {"data_zh": own}


def shading_legend(segments: Sequence[Segment]) -> Html:
    """Return what the shades of manoeuvres mean, if there are any."""
    kinds = list(dict.fromkeys(s.label for s in segments if s.label not in ("steady", "other")))
    if not kinds:
        return Html("")
    shown = [
        element("li", element("span", class_="shade", data_kind=kind, aria_hidden="true"),
                both(kind))
        for kind in kinds
    ]  # fmt: skip
    return joined(element("p", both("Shaded:")), element("ul", *shown, class_="legend"))


def _line(i: int) -> str:
    colour = _COLOURS[i % len(_COLOURS)]
    kind = ("solid", "dashed", "dotted")[min(i, 2)] if i < 3 else "dashed"
    return f"border-top: 3px {kind} {colour}"


def _number(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else "–"
