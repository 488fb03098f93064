"""What is known at one moment, for a terminal that shows it as it changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from factorgraph_dvl.report.text import at_precision, split_unit
from factorgraph_dvl.solution import Estimate, Trajectory


def live_view(
    trial: str,
    time: float,
    estimates: Sequence[Estimate],
    state: Trajectory,
    *,
    latency: float,
    speed: float,
    doubted: Sequence[str],
) -> Group:
    """Render calibration, position, latency and speed.

    Parameters
    ----------
    trial : name.
    time : since its start, s.
    estimates : of the calibration.
    state : of one epoch.
    latency : of the last update, s.
    speed : relative to real time.
    doubted : kinds of measurements that disagree with the prediction.
    """
    table = Table(title=Text(f"{trial}: {time:.1f} s"))
    table.add_column("parameter")
    for header in ("value", "σ", "unit"):
        table.add_column(header, justify="right")
    for e in estimates:
        for i, component in enumerate(e.component_names):
            name, unit = split_unit(component)
            value, std = float(e.value[i]), float(e.std[i])
            table.add_row(
                name,
                at_precision(value, std),
                at_precision(std, std),
                unit,
                style="" if e.observable[i] else "dim",
                end_section=i == len(e.component_names) - 1,
            )
    lat, lon, height = state.geodetic[0]
    rph = np.degrees(state.rph[0])
    lines = [
        f"position {np.degrees(lat):.7f} {np.degrees(lon):.7f} deg, {height:.2f} m "
        f"(σ {_three(state.position_std[0])} m)",
        f"velocity {_three(state.velocity[0])} m/s (σ {_three(state.velocity_std[0])})",
        f"roll, pitch, heading {_three(rph)} deg (σ {_three(np.degrees(state.rph_std[0]))})",
        f"latency {1e3 * latency:.1f} ms, {speed:.1f} times real time",
    ]
    parts: list[Table | Text] = [table, *(Text(line) for line in lines)]
    if doubted:
        parts.append(Text(f"in doubt: {', '.join(doubted)}", "red"))
    return Group(*parts)


def _three(values: np.ndarray) -> str:
    return " ".join(f"{value:.3f}" for value in values)
