"""Tables for the terminal: uncut, and without some columns if there is no room for them."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from factorgraph_dvl.report.table import Cell, Mark, Table, plain

# Chosen: wider than any table, in columns.
_UNLIMITED = 10_000
# Chosen: a column of names is at least so wide, in columns.
_LEAST_NAME = 12


def rendered(table: Table, width: int = _UNLIMITED, leave_out: Sequence[str] = ()) -> RichTable:
    """Return a table for a terminal of some width.

    Without room it is brief, then without the first of some columns; names that are still too
    long continue on the next line. Numbers are never cut.

    Parameters
    ----------
    table : Table
        What to show.
    width : int, optional
        Columns of the terminal.
    leave_out : sequence of str, optional
        Headers of columns, the least important first.
    """
    if width_of(_rich(table)) > width:
        table = table.brief()
    for header in leave_out:
        if width_of(_rich(table)) <= width:
            break
        table = table.without(header)
    whole = _rich(table)
    return whole if width_of(whole) <= width else _rich(table, fold=True)


def width_of(table: RichTable) -> int:
    """Return the width of an uncut table, columns."""
    return Console(width=_UNLIMITED).measure(table).maximum


def least_width_of(table: RichTable) -> int:
    """Return the width, columns, below which numbers would be cut, or names hard to read."""
    widths = [
        max(map(_width, (column.header, *column.cells)))
        if column.no_wrap
        else max(_width(column.header), _LEAST_NAME)
        for column in table.columns
    ]
    return sum(widths) + 3 * len(widths) + 1


def _width(cell: object) -> int:
    text = cell.plain if isinstance(cell, Text) else str(cell)
    return max(map(cell_len, text.split("\n")))


def _rich(table: Table, *, fold: bool = False) -> RichTable:
    """Return a table as Rich has them; with `fold`, long names continue on the next line."""
    out = RichTable(
        title=Text(table.title) if table.title else None, caption=table.caption or None
    )
    for column in table.columns:
        out.add_column(
            column.header,
            justify="right" if column.numeric else "left",
            no_wrap=column.numeric or not fold,
            overflow="fold",
        )
    for i, row in enumerate(table.rows):
        out.add_row(*map(_text, row), end_section=i in table.ends)
    return out


def _text(cell: Cell) -> Text:
    return Text(cell.text, cell.colour) if isinstance(cell, Mark) else Text(plain(cell))
