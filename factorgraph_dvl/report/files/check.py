"""What a calibration does to residuals and dead reckoning, as JSON and as a table."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.analysis.dead_reckoning.check import Check
from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.files.dead_reckoning import track_errors


def check_json(check: Check) -> bytes:
    """Return `check.json`: strict JSON, with null for unknown values."""
    tracks = check.tracks
    content = {
        "format": 1,
        "data": check.data,
        "from_s": float(check.time[0]),
        "to_s": float(check.time[-1]),
        "positions": tracks.scored_by,
        "residual_rms_m_s": {
            "axes": FRD_NAMES, "before": _rms(check.before), "after": _rms(check.after),
        },
        "dead_reckoning": {
            **track_errors(tracks.calibrated), "uncalibrated": track_errors(tracks.uncalibrated),
        },
    }  # fmt: skip
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def check_columns(check: Check) -> dict[str, Array]:
    """Return residuals at the pings, and errors of both tracks there, as columns of a table."""
    columns = {"time_s": check.time}
    for when, residual in (("before", check.before), ("after", check.after)):
        columns |= {
            f"residual_{axis}_{when}_m_s": values
            for axis, values in zip(FRD_NAMES, residual.T, strict=True)
        }
    for when, run in (("before", check.tracks.uncalibrated), ("after", check.tracks.calibrated)):
        if run.score is not None:
            columns[f"track_error_{when}_m"] = np.interp(
                check.time, run.score.time, run.score.horizontal, left=np.nan, right=np.nan
            )
    return columns


def _rms(residual: Array) -> list[Any]:
    return (
        np.sqrt(np.mean(residual**2, axis=0)).tolist()
        if residual.size
        else [None] * len(FRD_NAMES)
    )
