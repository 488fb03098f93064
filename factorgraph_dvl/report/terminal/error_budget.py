"""The error budget of a calibration for the terminal."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from factorgraph_dvl.report.terminal.tables import add_column
from factorgraph_dvl.report.text import split_unit
from factorgraph_dvl.solution import Solution

# Causes that are shown of each component. Chosen: they make up nearly all of it.
_SHOWN = 3


def error_budget_table(solution: Solution) -> Table:
    """Return a table of the largest causes of the standard deviation of each component."""
    table = Table(title="Error budget: what the largest causes add to each standard deviation")
    add_column(table, "parameter")
    add_column(table, "unit")
    add_column(table, "std", numeric=True)
    for _ in range(_SHOWN):
        add_column(table, "adds", numeric=True)
        add_column(table, "cause")
    std = np.concatenate([e.std for e in solution.estimates])
    for i, component in enumerate(solution.order):
        if std[i] <= 0.0:
            continue
        name, unit = split_unit(component)
        row = [name, unit, f"{std[i]:.2g}"]
        for cause in sorted(solution.error_budget, key=lambda c: -float(c.adds[i]))[:_SHOWN]:
            row += [f"{cause.adds[i]:.2g}", cause.cause]
        table.add_row(*row)
    return table
