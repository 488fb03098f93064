"""A cross-check as JSON and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.analysis.comparison.calibration_difference import AGREE_SIGMAS, Component
from factorgraph_dvl.analysis.comparison.crosscheck import AgainstTruth, CrossCheck
from factorgraph_dvl.analysis.comparison.motion_difference import (
    COMPONENTS,
    MotionDifference,
    Spread,
    error_spreads,
    mean_nees,
)
from factorgraph_dvl.analysis.error_statistics import (
    CalibrationErrors,
    TrajectoryErrors,
    nees_band,
)
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.report.figure_files import figure_files
from factorgraph_dvl.solution import Solution

# Files of a cross-check; the first makes the folder valid.
OWNED = (
    *("crosscheck.json", "crosscheck.csv", "differences.csv"),
    *figure_files("parameters", "differences", "errors"),
)
_COLUMNS = (
    *("parameter", "name", "a", "b", "difference", "std_a", "std_b"),
    *("std", "std_kind", "std_upper_bound", "std_hausman", "in_sigmas", "verdict", "reason"),
)


def to_json(check: CrossCheck, names: Mapping[str, str]) -> bytes:
    """Return `crosscheck.json`: strict JSON, with null for unknown values.

    Parameters
    ----------
    check : CrossCheck
        Cross-check to write.
    names : mapping of str to str
        Names of the files of A and B.
    """
    content = {
        "format": 1,
        "a": _result(check.a, names["A"]),
        "b": _result(check.b, names["B"]),
        "efficient": check.efficient,
        "agree_within_sigmas": AGREE_SIGMAS,
        "components": [_component(c) for c in check.components],
        "angles_deg": check.angles,
        "joint": None
        if check.joint is None
        else {
            "names": check.joint.names,
            "chi_square": check.joint.statistic,
            "degrees_of_freedom": len(check.joint.names),
            "limit": check.joint.limit,
            "probability": check.joint.probability,
            "std_kind": "upper bound",
            "correlations_known": check.joint.correlations,
            "verdict": check.joint.verdict,
        },
        "trajectory": None if check.motion is None else _motion(check.motion),
        "truth": {"a": _truth(check.truth_a), "b": _truth(check.truth_b)}
        if check.has_truth
        else None,
        "explanation": check.explanation,
        "notes": check.notes,
    }
    # msgspec writes nan and infinity as null.
    return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"


def to_csv(check: CrossCheck) -> str:
    """Return `crosscheck.csv`: a row for each calibration component; empty = unknown."""
    out = io.StringIO()
    writer = csv.DictWriter(out, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    for component in check.components:
        row = _component(component)
        writer.writerow({k: "" if v != v else v for k, v in row.items()})
    return out.getvalue()


def difference_columns(motion: MotionDifference) -> dict[str, Array]:
    """Return the columns of `differences.csv`: A − B and its standard deviation over time."""
    columns = {"time_s": motion.time}
    columns |= {f"diff_{name}": motion.difference[:, i] for i, name in enumerate(COMPONENTS)}
    columns |= {f"std_{name}": motion.std[:, i] for i, name in enumerate(COMPONENTS)}
    return columns


def _result(solution: Solution, name: str) -> dict[str, Any]:
    return {
        "file": name,
        "trial": solution.trial,
        "solver": solution.solver,
        "converged": bool(solution.converged),
    }


def _component(c: Component) -> dict[str, Any]:
    values = (c.parameter, c.name, c.a, c.b, c.difference, c.std_a, c.std_b)
    judged = (c.std, c.kind, c.std_upper, c.std_hausman, c.in_sigmas, c.verdict, c.reason)
    return dict(zip(_COLUMNS, values + judged, strict=True))


def _motion(motion: MotionDifference) -> dict[str, Any]:
    return {
        "epochs": motion.time.size,
        "from_s": float(motion.time[0]),
        "to_s": float(motion.time[-1]),
        "components": {
            s.name: _spread(s) | {"std_kind": kind}
            for s, kind in zip(motion.spreads, motion.kinds, strict=True)
        },
    }


def _spread(s: Spread) -> dict[str, float]:
    return {
        "rms": s.rms,
        "largest": s.largest,
        "time_of_largest_s": s.time_of_largest,
        "rms_in_sigmas": s.rms_sigmas,
        "largest_in_sigmas": s.largest_sigmas,
        "within_2_sigma": s.within_2_sigma,
    }


def _truth(against: AgainstTruth) -> dict[str, Any]:
    return {
        "calibration": None
        if against.calibration is None
        else _calibration_errors(against.calibration),
        "trajectory": None
        if against.trajectory is None
        else _trajectory_errors(against.trajectory),
    }


def _calibration_errors(errors: CalibrationErrors) -> dict[str, Any]:
    tested = errors.dof > 0
    inside = np.abs(errors.normalised[errors.tested]) <= 2.0
    return {
        "names": errors.names,
        "truth": errors.truth.tolist(),
        "error": errors.error.tolist(),
        "error_in_sigmas": errors.normalised.tolist(),
        "tested": errors.tested.tolist(),
        "nees": errors.nees if tested else None,
        "degrees_of_freedom": errors.dof,
        "nees_95": nees_band(errors.dof, 1) if tested else None,
        "within_2_sigma": float(inside.mean()) if tested else None,
    }


def _trajectory_errors(errors: TrajectoryErrors) -> dict[str, Any]:
    groups = ("position", "velocity", "attitude")
    return {
        "epochs": errors.time.size,
        "components": {s.name: _spread(s) for s in error_spreads(errors)},
        "mean_nees": dict(zip(groups, mean_nees(errors).tolist(), strict=True)),
    }
