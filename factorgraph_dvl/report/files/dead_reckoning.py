"""Dead reckoning as JSON, and as a table for the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.analysis.dead_reckoning.before_after import BeforeAfter, Run
from factorgraph_dvl.analysis.dead_reckoning.track_error import Score, Stretches
from factorgraph_dvl.quality.notation import fixed
from factorgraph_dvl.report.figure_files import figure_files
from factorgraph_dvl.report.table import Table

RESULT_FILE = "deadreckon.json"
TRACK_FILE = "track.csv"
UNCALIBRATED_FILE = "track-uncalibrated.csv"
# Files of `deadreckon`; the first makes the folder valid.
OWNED = (
    *(RESULT_FILE, TRACK_FILE, UNCALIBRATED_FILE),
    *figure_files("tracks", "errors", "lever_arm"),
)


def to_json(result: BeforeAfter, about: Mapping[str, Any]) -> bytes:
    """Return `deadreckon.json`: strict JSON, with null for unknown values.

    Parameters
    ----------
    result : BeforeAfter
        Result to write.
    about : mapping of str to object
        Names of trial and calibration, source of the attitude, and the like.
    """
    content = {
        "format": 1,
        **about,
        "scored_by": result.scored_by,
        "start_s": float(result.calibrated.track.time[0]),
        "duration_s": float(np.ptp(result.calibrated.track.time)),
        "bridged_s": result.calibrated.track.bridged,
        **track_errors(result.calibrated),
        "uncalibrated": track_errors(result.uncalibrated),
        "without_lever_arm": track_errors(result.without_lever_arm),
        "lever_arm": {
            "largest_effect_m": result.lever_arm.largest,
            "closed_form_disagreement_m": result.lever_arm.disagreement,
        },
    }
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def track_errors(run: Run) -> dict[str, Any]:
    """Return the errors of a track as JSON has them; nothing if they are not known."""
    s = run.score
    if s is None:
        return {}
    at = int(np.argmax(s.horizontal))
    end, largest = float(s.horizontal[-1]), float(s.horizontal[at])
    return {
        "scored_from_s": float(s.time[0]),
        "scored_until_s": float(s.time[-1]),
        "distance_m": s.path.total,
        "end_point_error_m": end,
        "end_point_percent": s.percent(end),
        "global_error_m": largest,
        "global_percent": s.percent(largest),
        "global_error_time_s": float(s.time[at]),
        "rms_error_m": _rms(s.horizontal),
        "end_point_along_m": float(s.along[-1]),
        "end_point_across_m": float(s.across[-1]),
        "largest_along_m": float(np.abs(s.along).max()),
        "largest_across_m": float(np.abs(s.across).max()),
        "rms_along_m": _rms(s.along),
        "rms_across_m": _rms(s.across),
        "end_point_up_m": float(s.error[-1, 2]),
        "rms_up_m": _rms(s.error[:, 2]),
        "straight": [_stretches(x) for x in s.stretches],
    }


def _stretches(stretches: Stretches) -> dict[str, Any]:
    return {
        "length_m": stretches.length,
        "count": stretches.count,
        "median_percent": stretches.median,
        "largest_percent": stretches.largest,
        "mean_along_percent": stretches.along,
        "mean_across_percent": stretches.across,
    }


def error_table(result: BeforeAfter) -> Table:
    """Return a table of the errors before and after calibration."""
    table = Table(title="Dead reckoning")
    table.column("error")
    scores = [r.score for r in (result.uncalibrated, result.calibrated)]
    before, after = scores
    if before is None or after is None:
        return table
    for header in ("uncalibrated", "calibrated"):
        table.column(f"{header}, m", numeric=True)
        table.column("%", numeric=True)

    def metres(name: str, of: Callable[[Score], float]) -> None:
        cells = []
        for s in (before, after):
            cells += [_number(of(s)), _number(s.percent(of(s)))]
        table.row(name, *cells)

    metres("end point", lambda s: float(s.horizontal[-1]))
    metres("largest", lambda s: float(s.horizontal.max()))
    metres("RMS", lambda s: _rms(s.horizontal))
    metres("end point, along track", lambda s: float(s.along[-1]))
    metres("end point, across track", lambda s: float(s.across[-1]))
    metres("RMS, along track", lambda s: _rms(s.along))
    metres("RMS, across track", lambda s: _rms(s.across))
    table.end_section()
    for b, a in zip(before.stretches, after.stretches, strict=True):
        name = f"straight {a.length / 1e3:g} km"
        if a.count == 0:
            table.row(f"{name}: none", "", "", "", "")
            continue
        for kind in ("median", "largest"):
            cells = []
            for s in (b, a):
                percent = getattr(s, kind)
                cells += [_number(percent * s.length / 100.0), _number(percent)]
            table.row(f"{name}, {kind} of {a.count}", *cells)
    return table


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _number(value: float) -> str:
    """Write a number to three significant digits, without an exponent."""
    if not math.isfinite(value) or value == 0.0:
        return "–" if not math.isfinite(value) else "0"
    return fixed(value, max(2 - math.floor(math.log10(abs(value))), 0))
