"""The true calibration of a simulated trial: truth.json."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import numpy as np

from factorgraph_dvl.errors import DataError, printable
from factorgraph_dvl.files.calibration_file import check_values
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.convert import from_json
from factorgraph_dvl.settings.files import MEGABYTE, read_bytes


class _TruthValue(msgspec.Struct):
    value: list[float | list[float]]


class _Truth(msgspec.Struct):
    parameters: dict[str, _TruthValue]


def read_truth(path: Path) -> dict[str, Array]:
    """Return the true calibration of a truth.json; empty if there is no such file."""
    if not os.path.lexists(path):
        return {}
    expected = '{"parameters": {name: {"value": [numbers]}}}'
    content = read_bytes(path, limit=MEGABYTE, expected=expected)
    try:
        truth = from_json(content, _Truth)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DataError(f"cannot be read ({error})", where=path.name, expected=expected) from None
    out = {}
    for name, item in truth.parameters.items():
        try:
            out[printable(name)] = np.array(item.value, dtype=float)
        except ValueError:
            raise DataError(
                f"{name}: the vectors differ in size", where=path.name, expected=expected
            ) from None
        check_values(name, out[printable(name)], path.name)
    return out


def truth_json(truth: dict[str, Array]) -> bytes:
    """Return the text of truth.json."""
    values = {
        name: _TruthValue(np.atleast_1d(np.asarray(value, dtype=float)).tolist())
        for name, value in truth.items()
    }
    return msgspec.json.format(msgspec.json.encode(_Truth(values)), indent=2) + b"\n"
