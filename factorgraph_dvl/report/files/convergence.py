"""The convergence of a calibration as a table."""

from __future__ import annotations

import csv
import io
import math

from factorgraph_dvl.analysis.convergence import Convergence

_COLUMNS = ("component", "good_std", "std_since_s", "good_error", "error_since_s")


def to_csv(found: Convergence) -> str:
    """Return a row for each component, and one named `all`; empty = never, or unknown."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for c in found.components:
        numbers = (c.good_std, c.std_since, c.good_error, c.error_since)
        writer.writerow([c.name, *map(_cell, numbers)])
    writer.writerow(["all", "", _cell(found.good_since), "", ""])
    return out.getvalue()


def _cell(value: float) -> str:
    return f"{value:.10g}" if math.isfinite(value) else ""
