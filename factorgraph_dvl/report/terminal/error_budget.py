"""The error budget of a calibration for the terminal."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from factorgraph_dvl.quality.notation import split_unit
from factorgraph_dvl.report.terminal.tables import add_column, width_of
from factorgraph_dvl.solution import Solution

# Causes that are shown of each component. Chosen: they make up nearly all of it.
_SHOWN = 3


# Chosen: wider than any table, in columns.
_UNLIMITED = 10_000


def error_budget_table(solution: Solution, *, width: int = _UNLIMITED) -> Table:
    """Return a table of the largest causes of the standard deviation of each component.

    Parameters
    ----------
    solution : Solution
        Solution with an error budget.
    width : int, optional
        Columns of the terminal. If they are too few, causes are lines in one column, and the unit
        joins the name.
    """
    table = _error_budget_table(solution, brief=False)
    return table if width_of(table) <= width else _error_budget_table(solution, brief=True)


def _error_budget_table(solution: Solution, *, brief: bool) -> Table:
    table = Table(title="Error budget: what the largest causes add to each standard deviation")
    add_column(table, "parameter")
    if not brief:
        add_column(table, "unit")
    add_column(table, "std", numeric=True)
    for _ in range(1 if brief else _SHOWN):
        add_column(table, "adds", numeric=True)
        add_column(table, "cause")
    std = np.concatenate([e.std for e in solution.estimates])
    for i, component in enumerate(solution.order):
        if std[i] <= 0.0:
            continue
        name, unit = split_unit(component)
        row = [f"{name}, {unit}" if unit else name] if brief else [name, unit]
        row.append(f"{std[i]:.2g}")
        largest = sorted(solution.error_budget, key=lambda c: -float(c.adds[i]))[:_SHOWN]
        cells = [[f"{cause.adds[i]:.2g}", cause.cause] for cause in largest]
        if brief:
            cells = [["\n".join(column) for column in zip(*cells, strict=True)]]
        table.add_row(*row, *(text for pair in cells for text in pair), end_section=brief)
    return table
