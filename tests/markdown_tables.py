"""Tables of Markdown as GitHub renders them."""

from __future__ import annotations

import re


def faults(text: str) -> list[str]:
    """Return what keeps tables of a page from rendering, a line each."""
    out: list[str] = []
    rows: list[tuple[int, str]] = []
    fenced = False
    before = ""
    for number, line in enumerate([*text.splitlines(), ""], start=1):
        if line.startswith("```"):
            fenced = not fenced
        if line.startswith("|") and not fenced:
            if not rows and before.strip():
                out.append(f"line {number}: no blank line before")
            rows.append((number, line))
        elif rows:
            out += _table(rows)
            if line.strip():
                out.append(f"line {number}: text in a table")
            rows = []
        before = line
    return out


def _table(rows: list[tuple[int, str]]) -> list[str]:
    if len(rows) < 2 or not re.fullmatch(r"\|(\s*:?-+:?\s*\|)+", rows[1][1].strip()):
        return [f"line {rows[0][0]}: no header"]
    wanted = _cells(rows[0][1])
    return [
        f"line {number}: {_cells(row)} cells, not {wanted}"
        for number, row in rows[1:]
        if _cells(row) != wanted
    ]


def _cells(row: str) -> int:
    # A pipe ends a cell even between backticks, but not after a backslash.
    return len(re.findall(r"(?<!\\)\|", row.strip())) - 1
