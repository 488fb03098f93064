from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from builders import build_solution

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Residuals
from factorgraph_dvl.files.solution_folder import load_solution, save_solution

NAN = np.nan


def measured(label: str, time: list[float], rows: list[list[float]], reason: str) -> Residuals:
    residual = np.array(rows)
    sigma = np.where(np.isnan(residual), NAN, 0.02 + 0.01 * np.arange(3))
    return Residuals(
        label, "m/s", ("east", "north", "up"), np.array(time), residual, sigma, reason
    )


USED = (
    # The first lacks its first component, and two have one time.
    measured("GNSS velocity", [1.0, 2.0, 2.0], [[NAN, 0.2, 0.3], [1, 2, 3], [4, 5, 6]], "echo"),
    measured("DVL velocity", [0.5, 1.5], [[0.1, 0.2, 0.3], [NAN, NAN, 1 / 3]], "echo"),
)
REJECTED = (
    measured("DVL velocity", [3.0, 9.0], [[7, 8, 9], [1, 1, 1]], "outlier"),
    measured("DVL velocity", [4.0, 5.0], [[2, 2, 2], [7, NAN, 9]], "window"),
)


def test_residuals_come_back_from_a_solution_folder(tmp_path: Path) -> None:
    save_solution(build_solution(residuals=USED, rejected=REJECTED), tmp_path / "s")
    found = load_solution(tmp_path / "s")
    for read, written in ((found.residuals, USED), (found.rejected, REJECTED)):
        assert len(read) == len(written)
        for a, b in zip(read, written, strict=True):
            assert (a.label, a.unit, a.components, a.reason) == (
                b.label,
                b.unit,
                b.components,
                b.reason,
            )
            np.testing.assert_array_equal(a.time, b.time)
            np.testing.assert_array_equal(a.residual, b.residual)
            np.testing.assert_array_equal(a.sigma, b.sigma)


def test_only_what_was_rejected_has_a_reason(tmp_path: Path) -> None:
    save_solution(build_solution(residuals=USED, rejected=REJECTED), tmp_path / "s")
    used = pyarrow.parquet.read_schema(tmp_path / "s" / "residuals.parquet").names
    rejected = (tmp_path / "s" / "rejected.csv").read_text().partition("\n")[0].split(",")
    assert used == ["time_s", "sensor", "component", "residual", "std", "unit"]
    assert rejected == ["time_s", "sensor", "component", "reason", "residual", "std", "unit"]


def test_a_folder_without_residuals_has_none(tmp_path: Path) -> None:
    save_solution(build_solution(), tmp_path / "s")
    found = load_solution(tmp_path / "s")
    assert found.residuals == found.rejected == ()


def test_a_damaged_table_names_its_file(tmp_path: Path) -> None:
    save_solution(build_solution(residuals=USED), tmp_path / "s")
    (tmp_path / "s" / "residuals.parquet").write_bytes(b"not a table")
    with pytest.raises(DataError, match=r"residuals\.parquet"):
        load_solution(tmp_path / "s")
