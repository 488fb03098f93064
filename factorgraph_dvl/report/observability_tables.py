"""Observability as tables for the terminal."""

from __future__ import annotations

import math

import numpy as np

from factorgraph_dvl.analysis.information.marginals import Marginals
from factorgraph_dvl.analysis.information.observability import Observability
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.notation import fixed, split_unit
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.report.table import Table
from factorgraph_dvl.report.tables import posterior_table

# Chosen: more rows do not fit on a screen.
_MAX_SEGMENTS = 16
# Chosen: smaller shares are not listed, so that the sources fit in a column.
_MIN_SHARE = 0.1


def segment_table(view: Observability) -> Table:
    """Return a table of the segments: motion and determined directions of the DVL."""
    table = Table(title="Segments")
    table.column("motion")
    for header in ("from s", "to s", "m/s", "turn deg", "rms rate deg/s"):
        table.column(header, numeric=True)
    point_set = view.point_set
    if point_set is not None:
        table.column("determined")
        table.column("strongest")
        table.column("weakest")
        table.column("up to its end")
    shown = view.segments[:_MAX_SEGMENTS]
    for k, m in enumerate(shown):
        row = [
            m.segment.label,
            f"{m.segment.start:.1f}",
            f"{m.segment.end:.1f}",
            _number(m.speed, 2),
            _number(m.turn / DEG, 0),
            " ".join(_number(r / DEG, 2) for r in m.rates.tolist()),
        ]
        if point_set is not None:
            stack, total = point_set.segments[k], point_set.cumulative[k]
            n = len(point_set.states)
            observed = np.flatnonzero(stack.observed)
            row += [
                f"{observed.size} of {n}",
                _named(stack.values, stack.dominant(int(observed[0])), int(observed[0]))
                if observed.size
                else "–",
                _named(stack.values, stack.dominant(int(observed[-1])), int(observed[-1]))
                if observed.size
                else "–",
                f"{int(np.sum(total.observed))} of {n}",
            ]
        table.row(*row)
    omitted = len(view.segments) - len(shown)
    if omitted:
        table.caption = f"and {omitted} more, in observability.json"
    return table


def marginal_table(view: Observability) -> Table:
    """Return a table of posterior against prior, and of the sources of the information."""
    assert view.marginals is not None
    table = posterior_table(view.marginals)
    if view.shares is not None:
        table.column("information from")
        table.rows = [
            (*row, _sources(view, name))
            for row, name in zip(table.rows, view.marginals.names, strict=True)
        ]
    return table


def direction_lines(marginals: Marginals) -> list[str]:
    """Return a line for each weak direction."""
    if not marginals.sentences:
        return ["All directions are observable: the data at least halve the prior's σ of each."]
    return [f"- {text_of(sentence)}." for sentence in marginals.sentences]


def _sources(view: Observability, component: str) -> str:
    shares = view.shares
    assert shares is not None
    if component not in shares.names:
        return "–"
    k = shares.names.index(component)
    found: dict[str, float] = {"prior": float(shares.prior[k])}
    for m, part in zip(view.segments, shares.segments[:, k], strict=True):
        found[m.segment.label] = found.get(m.segment.label, 0.0) + float(part)
    large = sorted(((v, name) for name, v in found.items() if v >= _MIN_SHARE), reverse=True)
    return ", ".join(f"{name} {100.0 * v:.0f} %" for v, name in large)


def _named(values: np.ndarray, names: tuple[str, ...], i: int) -> str:
    short = [split_unit(name)[0] for name in names[:2]]
    return f"{values[i]:.3g} {', '.join(short)}" + ("…" if len(names) > 2 else "")


def _number(value: float, decimals: int) -> str:
    return fixed(value, decimals) if math.isfinite(value) else "–"
