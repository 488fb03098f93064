"""Solution folders, format 1: calibration, trajectory, residuals, and what solvers add."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from factorgraph_dvl.estimates import Hypothesis, Trajectory
from factorgraph_dvl.files.calibration_file import (
    CALIBRATION_FILE,
    encode_calibration,
    load_calibration,
)
from factorgraph_dvl.files.folders import new_folder
from factorgraph_dvl.files.motion_table import (
    STD_COLUMNS,
    as_trajectory,
    motion_columns,
    read_motion,
)
from factorgraph_dvl.files.residual_table import (
    read_residuals,
    rejected_columns,
    residual_columns,
)
from factorgraph_dvl.files.run_file import RUN_FILE
from factorgraph_dvl.files.tables import read_header, read_table, release_memory, write_table
from factorgraph_dvl.geometry.rotations import FRD_NAMES
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution

TRAJECTORY_FILE = "trajectory.csv"
HISTORY_FILE = "history.csv"
HYPOTHESES_FILE = "hypotheses.json"
HYPOTHESES_FOLDER = "hypotheses"
REJECTED_FILE = "rejected.csv"
# Parquet: a third of the bytes of a CSV table, and read ten times as fast.
RESIDUALS_FILE = "residuals.parquet"
LATENCY_FILE = "latency.csv"
CONVERGENCE_FILE = "convergence.csv"
INSTRUMENT_FILE = "instrument.yaml"
BEAMS_FILE = "beams.csv"
BEAM_ANGLES_FILE = "beam_angles.csv"
HALVES_FILE = "halves.csv"
CHECK_FILE = "check.json"
CHECK_TABLE = "check.parquet"
# Residuals of the DVL, and errors of dead reckoning, before and after calibration.
CHECK_COLUMNS = (
    "time_s",
    *(f"residual_{axis}_{when}_m_s" for when in ("before", "after") for axis in FRD_NAMES),
)
CHECK_ERRORS = ("track_error_before_m", "track_error_after_m")
REPORT_FILE = "report.html"
PDF_FILE = "report.pdf"
# Of trajectories that were exported, before the name of their format.
EXPORT_STEM = "trajectory"
FIGURES_FOLDER = "figures"
# What is written with a solution; the first is in every one.
OWNED = (
    *(CALIBRATION_FILE, TRAJECTORY_FILE, HISTORY_FILE, LATENCY_FILE, CONVERGENCE_FILE),
    *(HYPOTHESES_FILE, f"{HYPOTHESES_FOLDER}/[0-9]*.csv", REJECTED_FILE, RESIDUALS_FILE),
    *(INSTRUMENT_FILE, BEAMS_FILE, BEAM_ANGLES_FILE, HALVES_FILE, CHECK_FILE, CHECK_TABLE),
    *(RUN_FILE, REPORT_FILE, PDF_FILE),
    *(
        f"{EXPORT_STEM}.{name}"
        for name in (
            *("tum", "kml", "geojson", "netcdf", "parquet", "sbet", "smrmsg", "nmea", "matlab"),
        )
    ),
    *(
        f"{FIGURES_FOLDER}/{name}.{kind}"
        for kind in ("png", "svg", "pdf")
        for name in (
            *("track", "motion", "calibration", "correlation", "error_budget"),
            *("*_residuals", "beam_quality", "convergence", "latency"),
        )
    ),
)


class _Hypothesis(msgspec.Struct):
    weight: float
    found_s: float
    died_s: float | None
    trajectory: str
    history_s: list[float]
    history_weight: list[float]


class _Hypotheses(msgspec.Struct):
    format: Literal[1]
    hypotheses: list[_Hypothesis]


def save_solution(
    solution: Solution,
    path: Path | str,
    *,
    force: bool = False,
    extra: Callable[[Path], object] | None = None,
    smoothed: Trajectory | None = None,
) -> None:
    """Write a solution folder, complete or not at all.

    Parameters
    ----------
    solution : Solution
        Solution to write.
    path : path-like
        Path of the folder.
    force : bool, default False
        Replace the solution that is there.
    extra : callable, optional
        Called with the folder before it appears under `path`, to add files.
    smoothed : Trajectory, optional
        What later data made of states of the trajectory; more columns of it.

    Raises
    ------
    DataError
        If the folder exists, is not empty, and `force` is not set; if it contains a trial.

    Examples
    --------
    >>> import tempfile
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fd.save_solution(solution, f"{folder}/out")
    ...     fd.load_solution(f"{folder}/out").verdict.grade
    'good'
    """
    with new_folder(Path(path), force=force, owned=OWNED) as folder:
        # What the solver has freed is not needed while figures are drawn.
        release_memory()
        columns = trajectory_columns(solution.trajectory)
        if smoothed is not None:
            columns |= _smoothed_columns(solution.trajectory, smoothed)
        write_table(folder / TRAJECTORY_FILE, columns)
        del columns
        if solution.residuals:
            write_table(folder / RESIDUALS_FILE, residual_columns(solution.residuals))
        if solution.hypotheses:
            _write_hypotheses(folder, solution.hypotheses)
        if solution.rejected:
            write_table(folder / REJECTED_FILE, rejected_columns(solution.rejected))
        if extra is not None:
            extra(folder)
        (folder / CALIBRATION_FILE).write_bytes(encode_calibration(solution))


def _write_hypotheses(folder: Path, hypotheses: Sequence[Hypothesis]) -> None:
    """Write what is known of each hypothesis, and its trajectory."""
    (folder / HYPOTHESES_FOLDER).mkdir()
    items = []
    for i, h in enumerate(hypotheses, 1):
        name = f"{HYPOTHESES_FOLDER}/{i}.csv"
        write_table(folder / name, trajectory_columns(h.trajectory))
        time, weight = h.history.T.tolist()
        items.append(_Hypothesis(h.weight, h.born, h.died, name, time, weight))
    text = msgspec.json.format(msgspec.json.encode(_Hypotheses(1, items)), indent=2) + b"\n"
    (folder / HYPOTHESES_FILE).write_bytes(text)


def write_history(
    folder: Path,
    time: Array,
    names: Sequence[str],
    std: Array,
    values: Array | None = None,
    latency: Array | None = None,
) -> None:
    """Write how the calibration became known along the trial, as history.csv.

    Parameters
    ----------
    folder : path-like
        Folder to write into.
    time : ndarray, shape (H,), s
        Times of the updates.
    names : sequence of str
        Names of the n components, as in `covariance.order`.
    std : ndarray, shape (H, n)
        Standard deviations, in reported units.
    values : ndarray, shape (H, n), optional
        What a recursive solver knew then, in reported units.
    latency : ndarray, shape (H,), optional
        Time that each update took, s, if it was measured.
    """
    columns = {"time_s": time}
    if latency is not None:
        columns["latency_ms"] = 1e3 * latency
    for i, name in enumerate(names):
        if values is not None:
            columns[name] = values[:, i]
        columns[f"{name}_std"] = std[:, i]
    write_table(folder / HISTORY_FILE, columns)


def write_latency(folder: Path, time: Array, latency: Array, solved: np.ndarray) -> None:
    """Write how long each update took, as latency.csv.

    Parameters
    ----------
    folder : path-like
        Folder to write into.
    time, latency : ndarray, shape (H,), s
        When the updates came, and how long each took.
    solved : ndarray, shape (H,)
        Updates that include a batch solution of what was collected.
    """
    columns = {"time_s": time, "latency_ms": 1e3 * latency, "batch": solved.astype(float)}
    write_table(folder / LATENCY_FILE, columns)


def load_solution(path: Path | str) -> Solution:
    """Read a solution folder.

    The files contain the diagonals of the trajectory's covariances: what is loaded has zeros
    elsewhere. Residuals are those of `residuals.parquet` and `rejected.csv`, where they exist.

    Parameters
    ----------
    path : path-like
        Path of the folder.

    Raises
    ------
    DataError
        If a file is missing or does not contain what it should.

    Examples
    --------
    >>> import tempfile
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fd.save_solution(solution, f"{folder}/out")
    ...     [r.label for r in fd.load_solution(f"{folder}/out").residuals]
    ['GNSS position', 'GNSS velocity', 'DVL velocity']
    """
    folder = Path(path)
    calibration = load_calibration(folder / CALIBRATION_FILE)
    fields = {name: getattr(calibration, name) for name in calibration.__dataclass_fields__}
    # A solution has that of its trajectory.
    del fields["span"]
    file = folder / TRAJECTORY_FILE
    trajectory = as_trajectory(read_motion(file, str(file), STD_COLUMNS))
    return Solution(
        **fields,
        trajectory=trajectory,
        residuals=read_residuals(folder / RESIDUALS_FILE),
        rejected=read_residuals(folder / REJECTED_FILE),
    )


def read_history(path: Path) -> tuple[Array, tuple[str, ...], Array] | None:
    """Return times (H,), names, and standard deviations (H, n) of history.csv.

    None where there is no such file.

    Raises
    ------
    DataError
        If it does not contain what it should.
    """
    file = path / HISTORY_FILE
    if not os.path.lexists(file):
        return None
    names = tuple(name.removesuffix("_std") for name in read_header(file) if name.endswith("_std"))
    columns = read_table(file, ("time_s", *(f"{name}_std" for name in names)), source=str(file))
    std = np.column_stack([columns[f"{name}_std"] for name in names] or [columns["time_s"]])
    return columns["time_s"], names, std


def read_halves(path: Path) -> dict[str, Any]:
    """Return the columns of halves.csv; nothing where there is no such file.

    Raises
    ------
    DataError
        If it does not contain what it should.
    """
    file = path / HALVES_FILE
    return read_table(file, read_header(file), source=str(file)) if os.path.lexists(file) else {}


def read_check(path: Path) -> dict[str, Any]:
    """Return the columns of check.parquet; nothing where there is no such file.

    Raises
    ------
    DataError
        If it does not contain what it should.
    """
    file = path / CHECK_TABLE
    if not os.path.lexists(file):
        return {}
    return read_table(file, CHECK_COLUMNS, [CHECK_ERRORS], source=str(file))


def trajectory_columns(trajectory: Trajectory) -> dict[str, Array]:
    """Return motion and standard deviations as the columns of trajectory.csv."""
    std = np.column_stack(
        [trajectory.position_std, trajectory.velocity_std, trajectory.rph_std / DEG]
    )
    return motion_columns(trajectory) | dict(zip(STD_COLUMNS, std.T, strict=True))


def _smoothed_columns(trajectory: Trajectory, smoothed: Trajectory) -> dict[str, Array]:
    """Return columns `smoothed_...` in the rows of the trajectory, nan where there is none."""
    row = np.searchsorted(trajectory.time, smoothed.time)
    out = {}
    for name, values in trajectory_columns(smoothed).items():
        if name != "time_s":
            column = np.full(trajectory.time.size, np.nan)
            column[row] = values
            out[f"smoothed_{name}"] = column
    return out
