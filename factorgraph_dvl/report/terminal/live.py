"""The present estimate of a replay, for a live display in the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.quality.notation import at_precision, split_unit
from factorgraph_dvl.quality.verdict import Verdict
from factorgraph_dvl.report.tables import VERDICT_COLOURS


def live_view(
    trial: str,
    time: float,
    estimates: Sequence[Estimate],
    state: Trajectory,
    *,
    latency: float,
    speed: float,
    inconsistent: Sequence[str],
    short_of_limits: Sequence[str] = (),
    good_since: float | None = None,
    verdict: Verdict | None = None,
) -> Group:
    """Return verdict, position, latency, speed and calibration.

    The most important lines come first, because a small terminal cuts off the end.

    Parameters
    ----------
    trial : str
        Name of the trial.
    time : float
        Time since the start of the trial, s.
    estimates : sequence of Estimate
        Estimates of the calibration.
    state : Trajectory
        Trajectory of one epoch.
    latency : float
        Latency of the last update, s.
    speed : float
        Relative to real time.
    inconsistent : sequence of str
        Kinds of measurements that disagree with the prediction.
    short_of_limits : sequence of str, optional
        Components whose standard deviations exceed their limits.
    good_since : float, optional
        Time from which no standard deviation exceeds its limit, s; None = some do.
    verdict : Verdict, optional
        Verdict on what is known now.
    """
    table = Table()
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
    if good_since is not None:
        first = Text(f"{trial}: {time:.1f} s, good enough since {good_since:.0f} s", "green")
    else:
        why = ", ".join(split_unit(component)[0] for component in short_of_limits)
        why = why or "measurements contradict the estimate"
        first = Text(f"{trial}: {time:.1f} s, not good enough yet: {why}")
    lines = [
        f"position {np.degrees(lat):.7f} {np.degrees(lon):.7f} deg, {height:.2f} m "
        f"(σ {_three(state.position_std[0])} m)",
        f"velocity {_three(state.velocity[0])} m/s (σ {_three(state.velocity_std[0])})",
        f"roll, pitch, heading {_three(rph)} deg (σ {_three(np.degrees(state.rph_std[0]))})",
        f"latency {1e3 * latency:.1f} ms, {speed:.1f} times real time",
    ]
    parts: list[Table | Text] = [first]
    if verdict is not None:
        parts.append(Text(str(verdict), VERDICT_COLOURS[verdict.grade]))
    if inconsistent:
        parts.append(Text(f"contradictory: {', '.join(inconsistent)}", "red"))
    parts += [Text(line) for line in lines]
    return Group(*parts, table)


def _three(values: np.ndarray) -> str:
    return " ".join(f"{value:.3f}" for value in values)
