"""A page of results for a publication: the table of its entries, then tables and figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from factorgraph_dvl.report.figures.drawing import save_figures
from factorgraph_dvl.reproduce.entry import Entry, Paper, Result, counted, table


def selected(paper: Paper, *, figure: int | None, table: int | None) -> tuple[Entry, ...]:
    """Return the entries of one figure or table, all by default; none if it has no such."""
    wanted = {f"figure {figure}", f"table {table}"}
    if figure is None and table is None:
        return paper.entries
    return tuple(e for e in paper.entries if wanted & {label_of(x) for x in e.label.split(", ")})


def label_of(label: str) -> str:
    """Return a label without what is in brackets behind it."""
    return label.partition(" (")[0]


def summary_lines(results: Sequence[tuple[Entry, Result]]) -> tuple[str, ...]:
    """Return the table of entries in Markdown."""
    rows = [[e.label, e.says, e.where, r.measured, r.verdict] for e, r in results]
    return table(["item", "as printed", "where it is", "measured", "verdict"], rows)


def write_page(
    paper: Paper,
    results: Sequence[tuple[Entry, Result]],
    seeds: int,
    folder: Path,
    *,
    kind: str = "png",
) -> None:
    """Write `PAPER.md`, and a PNG file for each figure.

    Parameters
    ----------
    paper : Paper
        The publication.
    results : sequence of tuple of (Entry, Result)
        Its entries with what was measured.
    seeds : int
        Number of seeds.
    folder : path-like
        Where the files go.
    kind : {'png', 'svg', 'pdf'}, optional
        Format of further files beside the PNG files.
    """
    lines = [f"# {paper.reference}", "", f"Over {counted(seeds)}.", ""]
    lines += summary_lines(results)
    for entry, result in results:
        name = re.sub(r"[^a-z0-9]+", "-", entry.label).strip("-")
        if result.details or result.figure is not None:
            lines += ["", f"## {entry.label[0].upper()}{entry.label[1:]}", "", *result.details]
        if result.figure is not None:
            save_figures({name: result.figure}, folder, name=paper.name, kind=kind)
            lines += ["", f"![{entry.says}]({name}.png)"]
    (folder / f"{paper.name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
