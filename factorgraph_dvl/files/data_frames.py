"""Solutions as pandas DataFrames and xarray Datasets, in the units of files."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal

import numpy as np

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.residual_table import residual_columns
from factorgraph_dvl.files.solution_folder import trajectory_columns
from factorgraph_dvl.solution import Solution

FrameTable = Literal["calibration", "trajectory", "residuals"]
_TABLES: tuple[FrameTable, ...] = ("calibration", "trajectory", "residuals")


def to_dataframe(solution: Solution, table: FrameTable = "calibration") -> Any:
    """Return a part of a solution as a pandas DataFrame, in the units of files.

    Parameters
    ----------
    solution : Solution
        What a solver found.
    table : {'calibration', 'trajectory', 'residuals'}, optional
        A row for each component, each epoch, or each component of each measurement.

    Raises
    ------
    ConfigError
        If there is no such table, or pandas is not installed (extra `notebook`).

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> fd.to_dataframe(solution).loc["scale_error", "grade"]
    'green'
    """
    if table not in _TABLES:
        raise ConfigError(f"table is {table!r}", expected=f"one of {', '.join(_TABLES)}")
    pandas = _library("pandas")
    if table == "calibration":
        frame = pandas.DataFrame(_calibration_columns(solution), index=list(solution.order))
        frame.index.name = "component"
        return frame
    if table == "trajectory":
        return pandas.DataFrame(trajectory_columns(solution.trajectory)).set_index("time_s")
    columns = residual_columns(solution.residuals) if solution.residuals else {}
    return pandas.DataFrame(columns)


def to_xarray(solution: Solution) -> Any:
    """Return calibration, joint covariance and trajectory as an xarray Dataset.

    Dimensions are `component` (`other_component` for the columns of the covariance) and
    `time_s`; units are those of files and stand in the names.

    Parameters
    ----------
    solution : Solution
        What a solver found.

    Raises
    ------
    ConfigError
        If xarray is not installed (extra `notebook`).

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> solution = fd.solve(fd.simulate("examples/short.yaml", seed=1))
    >>> fd.to_xarray(solution).sizes["component"] == len(solution.order)
    True
    """
    xarray = _library("xarray")
    order = list(solution.order)
    calibration = {
        name: (("component",), values) for name, values in _calibration_columns(solution).items()
    }
    motion = trajectory_columns(solution.trajectory)
    time = motion.pop("time_s")
    return xarray.Dataset(
        {
            **calibration,
            "covariance": (("component", "other_component"), solution.covariance),
            **{name: (("time_s",), values) for name, values in motion.items()},
        },
        coords={"component": order, "other_component": order, "time_s": time},
        attrs={
            "trial": solution.trial,
            "solver": solution.solver,
            "verdict": str(solution.verdict),
            "body_axes": solution.body_axes,
        },
    )


def _calibration_columns(solution: Solution) -> dict[str, Any]:
    """Return the calibration as columns, a row for each component."""
    estimates = solution.estimates
    grades = solution.grades
    columns = {
        name: np.concatenate([np.empty(0), *(getattr(e, name) for e in estimates)])
        for name in ("value", "std", "prior_value", "prior_std")
    }
    return columns | {
        "observable": np.concatenate([np.empty(0, bool), *(e.observable for e in estimates)]),
        "grade": np.array([grade for e in estimates for grade in grades[e.name]], dtype=str),
    }


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"{name} is not installed",
            expected="the extra `notebook`: pip install 'factorgraph-dvl[notebook]'",
        ) from error
