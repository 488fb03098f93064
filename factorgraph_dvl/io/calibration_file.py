"""Calibration files: calibration.json, format 1."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from factorgraph_dvl.conventions import Array, BodyAxes
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.solution import Calibration, Estimate, Solution

CALIBRATION_FILE = "calibration.json"

# JSON knows no nan: null stands for it.
_Numbers = list[float | None]


class _Parameter(msgspec.Struct):
    value: _Numbers
    std: _Numbers
    observable: list[bool]
    prior_value: _Numbers = []
    prior_std: _Numbers = []


class _Covariance(msgspec.Struct):
    order: list[str]
    matrix: list[_Numbers]


class _File(msgspec.Struct):
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


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Parameters
    ----------
    path : of the file, or of the solution folder that holds it.

    Raises
    ------
    DataError
        If the file is missing or does not hold what it should.
    """
    path = Path(path)
    file = _decode(path / CALIBRATION_FILE if path.is_dir() else path)
    names = iter(file.covariance.order)
    return Calibration(
        trial=file.trial,
        solver=file.solver,
        body_axes=file.body_axes,
        converged=file.converged,
        iterations=file.iterations,
        cost=np.nan if file.cost is None else file.cost,
        estimates=tuple(
            _estimate(name, parameter, names) for name, parameter in file.parameters.items()
        ),
        covariance=_covariance(file),
        warnings=tuple(file.warnings),
    )


def check_usable(calibration: Calibration, body_axes: BodyAxes, source: str) -> None:
    """Raise DataError unless a calibration converged and is in these body axes."""
    if not calibration.converged:
        raise DataError(
            "the calibration did not converge, its numbers are not to be used", where=source,
            expected="`converged` true",
        )  # fmt: skip
    if calibration.body_axes != body_axes:
        raise DataError(
            f"the calibration is in {calibration.body_axes} axes", where=source,
            expected=f"{body_axes}, as the trial has them",
        )  # fmt: skip


def encode_calibration(solution: Solution | Calibration) -> bytes:
    """Return the content of calibration.json."""
    calibration = _File(
        format=1,
        trial=solution.trial,
        solver=solution.solver,
        converged=bool(solution.converged),
        iterations=int(solution.iterations),
        parameters={
            e.name: _Parameter(
                value=_numbers(e.value),
                std=_numbers(e.std),
                observable=np.asarray(e.observable, dtype=bool).tolist(),
                prior_value=_numbers(e.prior_value),
                prior_std=_numbers(e.prior_std),
            )
            for e in solution.estimates
        },
        covariance=_Covariance(
            list(solution.order), [_numbers(row) for row in np.asarray(solution.covariance)]
        ),
        cost=float(solution.cost),
        body_axes=solution.body_axes,
        warnings=list(solution.warnings),
    )
    # msgspec writes nan and infinity as null, and every float with the digits it takes.
    return msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n"


def _decode(file: Path) -> _File:
    try:
        calibration = msgspec.json.decode(file.read_bytes(), type=_File)
    except FileNotFoundError:
        raise DataError(
            "the file does not exist", where=str(file), expected="a solution folder"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise DataError(f"cannot be read ({error})", where=str(file)) from None
    size = sum(len(parameter.value) for parameter in calibration.parameters.values())
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
    size = len(parameter.value)
    unknown: Sequence[float | None] = [None] * size
    return Estimate(
        name,
        tuple(islice(names, size)),
        _array(parameter.value),
        _array(parameter.std),
        _array(parameter.prior_value or unknown),
        _array(parameter.prior_std or unknown),
        np.array(parameter.observable, dtype=bool),
    )


def _covariance(calibration: _File) -> Array:
    size = len(calibration.covariance.order)
    return np.array(calibration.covariance.matrix, dtype=float).reshape(size, size)


def _numbers(values: Any) -> _Numbers:
    return list(np.atleast_1d(np.asarray(values, dtype=float)).tolist())


def _array(values: Sequence[float | None]) -> Array:
    return np.array(values, dtype=float)
