"""Tables of results: described once, and rendered for the terminal and for HTML."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

from factorgraph_dvl.quality.notation import split_unit


class Component(NamedTuple):
    """A cell that names a component, such as `lever_arm_x_m`."""

    name: str


class Mark(NamedTuple):
    """A cell that is a word with a colour, such as a grade."""

    text: str
    colour: str


Cell = str | Component | Mark


class Column(NamedTuple):
    """Header of a column; `detail` is left out where there is little room."""

    header: str
    numeric: bool = False
    detail: bool = False


@dataclass
class Table:
    """A table: columns, and rows of cells.

    Parameters
    ----------
    title : str, optional
        What it shows.
    caption : str, optional
        What follows from it.
    columns : list of Column, optional
        Numbers are aligned to the right.
    rows : list of tuple of Cell, optional
        A cell for each column.
    ends : set of int, optional
        Rows after which a section ends.
    """

    title: str = ""
    caption: str = ""
    columns: list[Column] = field(default_factory=list)
    rows: list[tuple[Cell, ...]] = field(default_factory=list)
    ends: set[int] = field(default_factory=set)

    def column(self, header: str, *, numeric: bool = False, detail: bool = False) -> None:
        """Add a column."""
        self.columns.append(Column(header, numeric, detail))

    def row(self, *cells: Cell, end_section: bool = False) -> None:
        """Add a row; a section may end with it."""
        self.rows.append(cells)
        if end_section:
            self.end_section()

    def end_section(self) -> None:
        """End a section with the last row."""
        self.ends.add(len(self.rows) - 1)

    def without(self, *headers: str) -> Table:
        """Return the table without some columns."""
        kept = [i for i, column in enumerate(self.columns) if column.header not in headers]
        rows = [tuple(row[i] for i in kept) for row in self.rows]
        return replace(self, columns=[self.columns[i] for i in kept], rows=rows)

    def brief(self) -> Table:
        """Return the table without details, and with units behind the names of components."""
        rows: list[tuple[Cell, ...]] = [
            tuple(named_with_unit(cell) if isinstance(cell, Component) else cell for cell in row)
            for row in self.rows
        ]
        details = [column.header for column in self.columns if column.detail]
        named = any(isinstance(cell, Component) for row in self.rows for cell in row)
        units = ["unit"] if named else []
        return replace(self, rows=rows).without(*units, *details)


def named_with_unit(component: Component) -> str:
    """Return the name of a component, and its unit if it has one."""
    name, unit = split_unit(component.name)
    return f"{name}, {unit}" if unit else name


def unit_of(component: str) -> str:
    """Return the unit of a component."""
    return split_unit(component)[1]


def plain(cell: Cell) -> str:
    """Return a cell as plain text."""
    if isinstance(cell, Component):
        return split_unit(cell.name)[0]
    return cell.text if isinstance(cell, Mark) else cell
