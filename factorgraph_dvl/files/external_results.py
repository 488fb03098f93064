"""Results from elsewhere: a table of motion, or calibration values in JSON or YAML."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Union, cast

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from factorgraph_dvl.errors import ConfigError, DataError, printable
from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.files.calibration_file import (
    CALIBRATION_FILE,
    check_usable,
    check_values,
    load_calibration,
    read_calibration_bytes,
)
from factorgraph_dvl.files.folders import SETTINGS_FILE
from factorgraph_dvl.files.motion_table import (
    COLUMNS,
    STD_COLUMNS,
    as_trajectory,
    read_motion,
    read_reference,
)
from factorgraph_dvl.files.solution_folder import TRAJECTORY_FILE, load_solution
from factorgraph_dvl.files.trial_folder import TRUTH_FILE, load_reference
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beacon import ANY_BEACON
from factorgraph_dvl.sensors.catalogue import BEACON_OFFSET, every_spec, specs_of
from factorgraph_dvl.sensors.dvl_beams import DIRECTION, direction_spec
from factorgraph_dvl.sensors.records import check_finite, check_range
from factorgraph_dvl.settings.ranges import out_of_range
from factorgraph_dvl.settings.sections import Section
from factorgraph_dvl.settings.yaml_file import parse_yaml, read_text
from factorgraph_dvl.solution import Calibration, Solution
from factorgraph_dvl.trial import Reference

# How far the length of a direction may be off 1. Chosen: three digits.
_UNIT = 1e-3
_TABLES = (".csv", ".parquet", ".pq")
_TEXTS = (".json", ".yaml", ".yml")
_STD_GROUPS = {"m": STD_COLUMNS[0:3], "m/s": STD_COLUMNS[3:6], "deg": STD_COLUMNS[6:9]}
# Names of parameters that a file may hold; those of beacons are in its text.
_KNOWN = tuple(dict.fromkeys(s.name for s in every_spec() if s.kind != "directions"))

_Numbers = float | list[float | None]
_Vectors = list[tuple[float, float, float]]
_Pairs = list[tuple[float | None, float | None]]


class _Value(Section, frozen=True, kw_only=True):
    """Values with standard deviations; null stands for a number that is not known."""

    value: _Numbers
    std: _Numbers | UnsetType = UNSET
    observable: bool | list[bool] | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(std < 0.0 for std in _array(self.std)):
            raise ValueError("`std` must be 0 or more")


_Given = _Numbers | _Value | UnsetType


class _Directions(Section, frozen=True, kw_only=True):
    """Unit vectors, with standard deviations across them, and flags, in pairs."""

    value: _Vectors
    std: _Pairs | UnsetType = UNSET
    observable: list[tuple[bool, bool]] | UnsetType = UNSET

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.value)
        if n == 0 or np.any(np.abs(np.linalg.norm(self.value, axis=1) - 1.0) > _UNIT):
            raise ValueError("`value` must contain unit vectors")
        if self.std is not UNSET and len(self.std) != n:
            raise ValueError(f"`std` must have a pair for each of the {n} vectors in `value`")
        if self.observable is not UNSET and len(self.observable) != n:
            raise ValueError(f"`observable` must have a pair for each of the {n} vectors")


class _Parameters(Section, frozen=True, kw_only=True):
    """Parameters by name; `_file_type` adds a field for each."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, given in self.given().items():
            if name != DIRECTION:
                _check_sizes(name, given, list(specs_of(name)))
                numbers = _array(given.value)
                if wrong := out_of_range(name, numbers[~np.isnan(numbers)].tolist()):
                    raise ValueError(wrong)

    def given(self) -> dict[str, _Value | _Directions]:
        """Return what is there, by name."""
        found = {name: getattr(self, name, UNSET) for name in self.__struct_fields__}
        return {
            name: _as_value(given)
            for name, given in found.items()
            if given is not UNSET and name not in _ABOUT
        }


_ABOUT = ("trial", "solver", "body_axes", "trajectory", "parameters")


class _File(_Parameters, frozen=True, kw_only=True):
    trial: str = ""
    solver: str = ""
    body_axes: BodyAxes | UnsetType = UNSET
    trajectory: str = ""
    parameters: _Parameters | UnsetType = UNSET


def _file_type(text: str) -> type[_File]:
    """Return the type of a file that may contain all parameters, and those of its beacons."""
    names = [name for name in _KNOWN if ANY_BEACON not in name]
    names += sorted({m[0] for m in BEACON_OFFSET.finditer(text)})
    fields: list[Any] = [(name, _Given, UNSET) for name in names]
    fields.append((DIRECTION, _Directions | UnsetType, UNSET))
    options: dict[str, Any] = {"frozen": True, "kw_only": True}
    nested = msgspec.defstruct("_Parameters", fields, bases=(_Parameters,), **options)
    whole = [*fields, ("parameters", Union[nested, UnsetType], UNSET)]  # noqa: UP007
    return cast("type[_File]", msgspec.defstruct("_File", whole, bases=(_File,), **options))


def load_results(path_a: Path | str, path_b: Path | str) -> tuple[Solution, Solution]:
    """Read two results, each of this program or of another.

    Parameters
    ----------
    path_a, path_b : path-like
        Each of a solution folder; of a CSV or Parquet table with the columns of `reference` and,
        optionally, those of the standard deviations; or of a JSON or YAML file of calibration
        values.

    Returns
    -------
    a : Solution
        One from elsewhere has nan for what the file does not say, no epochs without a table, no
        estimates without calibration values, no correlations, and the body axes of the other
        result unless the file says which.
    b : Solution
        The other.

    Raises
    ------
    ConfigError, DataError
        If there is no such result, or it does not contain what it should.
    """
    (a, a_says), (b, b_says) = _load(Path(path_a)), _load(Path(path_b))
    if not a_says:
        a = replace(a, body_axes=b.body_axes)
    if not b_says:
        b = replace(b, body_axes=a.body_axes)
    return a, b


def _load(path: Path) -> tuple[Solution, bool]:
    """Return a result, and whether it says in which body axes it is."""
    if path.name == CALIBRATION_FILE and (path.parent / TRAJECTORY_FILE).exists():
        path = path.parent
    if path.is_dir():
        if not (path / CALIBRATION_FILE).exists() and (path / SETTINGS_FILE).exists():
            raise DataError(
                "is a trial folder",
                where=str(path),
                expected="a solution folder, or a file of results from elsewhere",
                hint=f"Solve it first: factorgraph-dvl solve {path} --out DIR",
            )
        return load_solution(path), True
    suffix = path.suffix.lower()
    if not path.exists():
        raise DataError(
            "the result does not exist",
            where=str(path),
            expected="a solution folder, or a file of results from elsewhere",
        )
    if suffix in _TABLES:
        return _elsewhere(_File(), _read_trajectory(path)), False
    if suffix in _TEXTS:
        file = _read_calibration(path)
        table = path.parent / file.trajectory
        motion = _read_trajectory(table) if file.trajectory else _no_trajectory()
        return _elsewhere(file, motion), file.body_axes is not UNSET
    raise DataError(
        f"the suffix `{suffix}` says nothing" if suffix else "has no suffix",
        where=str(path),
        expected=f"{', '.join(_TABLES)} for a trajectory, {', '.join(_TEXTS)} for a calibration",
    )


def load_truth(
    reference: Path | str | None, truth: Path | str | None
) -> tuple[Reference | None, dict[str, Array]]:
    """Read what two results are to be compared with.

    Parameters
    ----------
    reference : path-like or None
        A trial folder, for its reference and its true calibration, or a table with the columns of
        `reference`.
    truth : path-like or None
        A file of true calibration values, which win over those of the trial folder.

    Returns
    -------
    reference : Reference or None
        The true trajectory.
    truth : dict of str to ndarray
        The true calibration by reported name.

    Raises
    ------
    ConfigError, DataError
        If a file does not contain what it should, or the trial folder has neither.
    """
    motion: Reference | None = None
    values: dict[str, Array] = {}
    if reference is not None:
        path = Path(reference)
        if path.suffix.lower() in _TABLES:
            motion = read_reference(path)
        else:
            motion, values = load_reference(path)
        if motion is None and not values:
            raise DataError(
                "the trial has no truth", where=str(path), expected=f"a reference or {TRUTH_FILE}"
            )
    if truth is not None:
        values = values | read_truth(truth)
    return motion, values


def read_truth(path: Path | str) -> dict[str, Array]:
    """Read true calibration values, in the format of calibration values from elsewhere.

    Parameters
    ----------
    path : path-like
        Path of a JSON or YAML file, such as the `truth.json` of a trial folder.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        Values by name, in reported units. Standard deviations are ignored.

    Raises
    ------
    ConfigError, DataError
        If the file does not contain such values.
    """
    path = Path(path)
    if path.suffix.lower() not in _TEXTS:
        raise DataError(
            "is not a file of calibration values",
            where=str(path),
            expected=f"JSON or YAML, such as {TRUTH_FILE}",
        )
    return {name: _array(value.value) for name, value in _given(_read_calibration(path)).items()}


def read_calibration_values(
    path: Path | str, body_axes: BodyAxes, *, anyway: bool = False
) -> dict[str, Array]:
    """Read the values of a calibration, of this program or typed in by hand.

    Parameters
    ----------
    path : path-like
        Path of a calibration.json, of the solution folder with it, or of a JSON or YAML file
        of calibration values.
    body_axes : BodyAxes
        Body axes that the values must be in.
    anyway : bool, default False
        Read them also if they are graded `do not use`.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        Values by name, in reported units; of directions (N, 3) vectors.

    Raises
    ------
    ConfigError, DataError
        If there are no such values, they are in other axes, or not to be used.
    """
    path = Path(path)
    calibration = own_calibration(path, body_axes)
    if calibration is not None:
        check_usable(calibration, body_axes, str(path), anyway=anyway)
        values = calibration.values
    else:
        values = read_truth(path)
        says = _read_calibration(path).body_axes
        if says not in (UNSET, body_axes):
            raise DataError(f"is in {says} axes", where=str(path), expected=body_axes)
    for name, value in values.items():
        check_values(name, value, str(path))
    return values


def own_calibration(path: Path, body_axes: BodyAxes) -> Calibration | None:
    """Read a calibration of this program; None if a file contains values typed in by hand.

    Parameters
    ----------
    path : path-like
        Path as for `read_calibration_values`.
    body_axes : BodyAxes
        Body axes of a file that does not state them.
    """
    whole = path.is_dir() or (
        path.suffix.lower() == ".json" and b'"covariance"' in read_calibration_bytes(path)
    )
    return load_calibration(path, body_axes=body_axes) if whole else None


def _read_calibration(path: Path) -> _File:
    text = read_text(path)
    if path.suffix.lower() == ".json":
        text = _checked_json(text, path.name)
    file = parse_yaml(text, _file_type(text), source=path.name)
    top, nested = file.given(), file.parameters is not UNSET
    if top and nested:
        raise ConfigError(
            f"there is `parameters` and `{next(iter(top))}` beside it",
            where=path.name,
            expected="all values in `parameters`, or none",
        )
    if not _given(file):
        raise ConfigError(
            "there are no calibration values", where=path.name, expected=", ".join(_KNOWN)
        )
    return file


def _checked_json(text: str, source: str) -> str:
    """Return JSON as YAML can read it; raise ConfigError if it is not JSON."""
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigError(
            f"not valid JSON: {error.msg}", where=f"{source} line {error.lineno}"
        ) from None
    except RecursionError:
        raise ConfigError("nested too deeply", where=source) from None
    # YAML forbids tabs between tokens; within the strings of JSON there can be none.
    return text.replace("\t", " ")


def _given(file: _File) -> dict[str, _Value | _Directions]:
    return file.given() if isinstance(file.parameters, UnsetType) else file.parameters.given()


def _elsewhere(file: _File, trajectory: Trajectory) -> Solution:
    estimates = tuple(_estimate(name, value) for name, value in _given(file).items())
    std = np.concatenate([np.zeros(0), *(e.std for e in estimates)])
    return Solution(
        trial=printable(file.trial),
        solver=printable(file.solver),
        body_axes="RFU" if isinstance(file.body_axes, UnsetType) else file.body_axes,
        converged=True,
        iterations=0,
        cost=float("nan"),
        estimates=estimates,
        covariance=np.diag(std**2),
        trajectory=trajectory,
    )


def _estimate(name: str, given: _Value | _Directions) -> Estimate:
    if isinstance(given, _Directions):
        return _direction_estimate(name, given)
    value, std = _array(given.value), _array(given.std)
    unknown = np.full(value.size, np.nan)
    observable = True if isinstance(given.observable, UnsetType) else given.observable
    return Estimate(
        name,
        specs_of(name)[value.size].component_names,
        value,
        std if std.size else unknown,
        unknown,
        unknown,
        np.asarray(observable, dtype=bool) & np.isfinite(value),
    )


def _direction_estimate(name: str, given: _Directions) -> Estimate:
    nominal = np.array(given.value)
    nominal = nominal / np.linalg.norm(nominal, axis=1, keepdims=True)
    n = len(nominal)
    unknown = np.full(2 * n, np.nan)
    observable = True if isinstance(given.observable, UnsetType) else given.observable
    return Estimate(
        name,
        direction_spec(n).component_names,
        np.zeros(2 * n),
        unknown if isinstance(given.std, UnsetType) else _array(given.std).ravel(),
        unknown,
        unknown,
        np.broadcast_to(np.array(observable, dtype=bool), (n, 2)).ravel(),
        nominal,
    )


def _read_trajectory(path: Path) -> Trajectory:
    columns = read_motion(path, optional=tuple(_STD_GROUPS.values()))
    check_finite({name: columns[name] for name in COLUMNS}, path.name)
    for unit, group in _STD_GROUPS.items():
        check_range({name: columns[name] for name in group}, 1e-12, 1e6, unit, path.name)
    return as_trajectory(columns)


def _no_trajectory() -> Trajectory:
    none, square = np.zeros((0, 3)), np.zeros((0, 3, 3))
    return Trajectory(np.zeros(0), none, none, none, square, square, square)


def _check_sizes(name: str, value: _Value | _Directions, sizes: list[int]) -> None:
    expected = " or ".join(map(str, sizes)) if len(sizes) < 4 else f"{sizes[0]} to {sizes[-1]}"
    n = _array(value.value).size
    if n not in sizes:
        raise ValueError(f"`{name}` must have {expected} numbers, not {n}")
    if value.std is not UNSET and _array(value.std).size != n:
        raise ValueError(f"`{name}` must have as many numbers in `std` as in `value`, {n}")
    if isinstance(value.observable, list) and len(value.observable) != n:
        raise ValueError(f"`{name}` must have {n} entries in `observable`")


def _as_value(given: _Numbers | _Value | _Directions) -> _Value | _Directions:
    return given if isinstance(given, (_Value, _Directions)) else _Value(value=given)


def _array(numbers: _Numbers | _Vectors | _Pairs | UnsetType) -> Array:
    if isinstance(numbers, UnsetType):
        return np.zeros(0)
    return np.atleast_1d(np.array(numbers, dtype=float))
