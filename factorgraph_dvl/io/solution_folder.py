"""Solution folders, format 1: calibration.json, trajectory.csv, history.csv."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from factorgraph_dvl.conventions import DEG, GEODETIC_SI, Array, BodyAxes
from factorgraph_dvl.directions import turns_to
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.io.folders import new_folder
from factorgraph_dvl.io.motion_table import COLUMNS as MOTION_COLUMNS
from factorgraph_dvl.io.motion_table import motion_columns
from factorgraph_dvl.io.tables import read_table, write_table
from factorgraph_dvl.sensors.protocol import stack
from factorgraph_dvl.solution import Estimate, Solution, Trajectory

CALIBRATION_FILE = "calibration.json"
TRAJECTORY_FILE = "trajectory.csv"
HISTORY_FILE = "history.csv"
BEAMS_FILE = "beams.csv"
FIGURES_FOLDER = "figures"
STD_COLUMNS = (
    *("std_e_m", "std_n_m", "std_u_m"),
    *("vel_std_e_m_s", "vel_std_n_m_s", "vel_std_u_m_s"),
    *("roll_std_deg", "pitch_std_deg", "heading_std_deg"),
)

# JSON knows no nan: null stands for it.
_Numbers = list[float | None]
_Rows = list[float | _Numbers | None]


class _Parameter(msgspec.Struct):
    """One entry for each component; of directions, value a vector and the others a pair."""

    value: _Rows
    std: _Rows
    observable: list[bool | list[bool]]
    prior_value: _Rows = []
    prior_std: _Rows = []


class _Covariance(msgspec.Struct):
    order: list[str]
    matrix: list[_Numbers]


class _Calibration(msgspec.Struct):
    format: Literal[1]
    trial: str
    solver: str
    converged: bool
    iterations: int
    parameters: dict[str, _Parameter]
    covariance: _Covariance
    cost: float | None = None
    body_axes: BodyAxes = "RFU"
    warnings: list[str] = []


def save_solution(
    solution: Solution,
    path: Path | str,
    *,
    force: bool = False,
    extra: Callable[[Path], object] | None = None,
) -> None:
    """Write a solution folder, complete or not at all.

    Parameters
    ----------
    solution : to write.
    path : of the folder.
    force : replace the solution that is there.
    extra : called with the folder before it appears under `path`, to add files.

    Raises
    ------
    DataError
        If the folder exists, is not empty, and `force` is not set.
    """
    owned = (CALIBRATION_FILE, TRAJECTORY_FILE, HISTORY_FILE, BEAMS_FILE, FIGURES_FOLDER)
    with new_folder(Path(path), force=force, owned=owned) as folder:
        write_table(folder / TRAJECTORY_FILE, _trajectory_columns(solution.trajectory))
        if extra is not None:
            extra(folder)
        (folder / CALIBRATION_FILE).write_bytes(_encode(solution))


def write_history(
    folder: Path, time: Array, names: Sequence[str], values: Array, std: Array
) -> None:
    """Write how a recursive solver converged, as history.csv.

    Parameters
    ----------
    folder : to write into.
    time : (H,) s.
    names : of the n components, as in `covariance.order`.
    values, std : (H, n) in reported units.
    """
    columns = {"time_s": time}
    for i, name in enumerate(names):
        columns |= {name: values[:, i], f"{name}_std": std[:, i]}
    write_table(folder / HISTORY_FILE, columns)


def load_solution(path: Path | str) -> Solution:
    """Read a solution folder.

    The files hold the diagonals of the trajectory's covariances and no residuals: what
    is loaded has zeros elsewhere, and none.

    Parameters
    ----------
    path : of the folder.

    Raises
    ------
    DataError
        If a file is missing or does not hold what it should.
    """
    folder = Path(path)
    calibration = _decode(folder / CALIBRATION_FILE)
    names = iter(calibration.covariance.order)
    return Solution(
        trial=calibration.trial,
        solver=calibration.solver,
        body_axes=calibration.body_axes,
        converged=calibration.converged,
        iterations=calibration.iterations,
        cost=np.nan if calibration.cost is None else calibration.cost,
        estimates=tuple(
            _estimate(name, parameter, names) for name, parameter in calibration.parameters.items()
        ),
        covariance=_covariance(calibration),
        trajectory=_read_trajectory(folder / TRAJECTORY_FILE),
        warnings=tuple(calibration.warnings),
    )


def _encode(solution: Solution) -> bytes:
    calibration = _Calibration(
        format=1,
        trial=solution.trial,
        solver=solution.solver,
        converged=bool(solution.converged),
        iterations=int(solution.iterations),
        parameters={e.name: _parameter(e) for e in solution.estimates},
        covariance=_Covariance(
            list(solution.order), [_numbers(row) for row in np.asarray(solution.covariance)]
        ),
        cost=float(solution.cost),
        body_axes=solution.body_axes,
        warnings=list(solution.warnings),
    )
    # msgspec writes nan and infinity as null, and every float with the digits it takes.
    return msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n"


def _parameter(e: Estimate) -> _Parameter:
    value, prior_value, shape = e.value, e.prior_value, np.shape(e.std)
    if e.nominal is not None:
        value, prior_value, shape = e.directions, e.nominal, (-1, 2)
    rows: list[Any] = [
        np.reshape(x, shape).tolist()
        for x in (e.std, np.asarray(e.observable, dtype=bool), e.prior_std)
    ]
    return _Parameter(
        value=np.asarray(value).tolist(),
        std=rows[0],
        observable=rows[1],
        prior_value=np.asarray(prior_value).tolist(),
        prior_std=rows[2],
    )


def _decode(file: Path) -> _Calibration:
    try:
        calibration = msgspec.json.decode(file.read_bytes(), type=_Calibration)
    except FileNotFoundError:
        raise DataError(
            "the file does not exist", where=str(file), expected="a solution folder"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(f"cannot be read ({error})", where=str(file)) from None
    try:
        size = sum(np.size(_array(p.std)) for p in calibration.parameters.values())
    except ValueError:
        raise DataError(
            "a parameter has rows of different lengths",
            where=str(file),
            expected="numbers, or pairs for directions",
        ) from None
    shape = {len(calibration.covariance.order), len(calibration.covariance.matrix)}
    shape |= {len(row) for row in calibration.covariance.matrix}
    if shape != {size}:
        raise DataError(
            "the covariance does not fit the parameters",
            where=str(file),
            expected=f"{size} names in `order`, and a {size} x {size} matrix",
        )
    return calibration


def _estimate(name: str, parameter: _Parameter, names: Iterator[str]) -> Estimate:
    if parameter.value and isinstance(parameter.value[0], list):
        return _directions(name, parameter, names)
    size = len(parameter.value)
    unknown: _Rows = [None] * size
    return Estimate(
        name,
        tuple(islice(names, size)),
        _array(parameter.value),
        _array(parameter.std),
        _array(parameter.prior_value or unknown),
        _array(parameter.prior_std or unknown),
        np.array(parameter.observable, dtype=bool),
    )


def _directions(name: str, parameter: _Parameter, names: Iterator[str]) -> Estimate:
    try:
        nominal = _array(parameter.prior_value).reshape(-1, 3)
        value = turns_to(nominal, _array(parameter.value)) / DEG
        prior_std = _array(parameter.prior_std).reshape(value.shape)
        observable = np.array(parameter.observable, dtype=bool).reshape(value.shape)
        std = _array(parameter.std).reshape(value.shape)
    except ValueError:
        raise DataError(
            f"parameter {name} does not hold directions",
            where=CALIBRATION_FILE,
            expected="as many unit vectors in `value` and `prior_value` as pairs in `std`, "
            "`prior_std` and `observable`",
        ) from None
    return Estimate(
        name,
        tuple(islice(names, value.size)),
        value.ravel(),
        std.ravel(),
        np.zeros(value.size),
        prior_std.ravel(),
        observable.ravel(),
        nominal,
    )


def _covariance(calibration: _Calibration) -> Array:
    size = len(calibration.covariance.order)
    return np.array(calibration.covariance.matrix, dtype=float).reshape(size, size)


def _trajectory_columns(trajectory: Trajectory) -> dict[str, Array]:
    std = np.column_stack(
        [trajectory.position_std, trajectory.velocity_std, trajectory.rph_std / DEG]
    )
    return motion_columns(trajectory) | dict(zip(STD_COLUMNS, std.T, strict=True))


def _read_trajectory(file: Path) -> Trajectory:
    columns = read_table(file, (*MOTION_COLUMNS, *STD_COLUMNS), source=str(file))
    return Trajectory(
        time=columns["time_s"],
        geodetic=stack(columns, MOTION_COLUMNS[1:4]) * GEODETIC_SI,
        velocity=stack(columns, MOTION_COLUMNS[4:7]),
        rph=stack(columns, MOTION_COLUMNS[7:10]) * DEG,
        position_cov=_diagonal(stack(columns, STD_COLUMNS[0:3])),
        velocity_cov=_diagonal(stack(columns, STD_COLUMNS[3:6])),
        rph_cov=_diagonal(stack(columns, STD_COLUMNS[6:9]) * DEG),
    )


def _diagonal(std: Array) -> Array:
    return (std**2)[:, :, None] * np.eye(3)


def _numbers(values: Any) -> _Numbers:
    return list(np.atleast_1d(np.asarray(values, dtype=float)).tolist())


def _array(values: Sequence[float | _Numbers | None]) -> Array:
    return np.array(values, dtype=float)
