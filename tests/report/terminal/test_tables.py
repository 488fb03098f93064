from __future__ import annotations

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from builders import build_solution, build_trial
from rich.console import Console
from rich.table import Table

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.estimates import Cause
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.notation import at_precision, fixed, split_unit, with_std
from factorgraph_dvl.report.terminal.error_budget import error_budget_table
from factorgraph_dvl.report.terminal.tables import (
    add_column,
    calibration_table,
    fitted,
    least_width_of,
    sensor_table,
    width_of,
)

TRUTH = {"misalignment_deg": [1.0, 2.0, 3.0], "scale_error": [0.005]}


def printed(table: Table, width: int) -> str:
    file = StringIO()
    Console(file=file, width=max(width, width_of(table))).print(table)
    return file.getvalue()


@pytest.mark.parametrize("width", [160, 80, 60, 20])
@pytest.mark.parametrize("known", [True, False])
def test_no_name_and_no_number_is_cut(width: int, known: bool) -> None:
    solution = build_solution()
    errors = calibration_errors(solution, TRUTH) if known else None
    text = printed(calibration_table(solution, errors, width=width), width)
    assert "…" not in text
    rows = {line.split()[1].rstrip(","): line for line in text.splitlines() if " ± " in line[20:]}
    assert "0.005123 ± 0.000033" in rows["scale_error"]
    assert "deg" in rows["misalignment_x"]
    assert "grey" in rows["misalignment_z"]
    if known:
        assert "0.005000" in rows["scale_error"]
        assert "+3.70" in rows["scale_error"]


def test_what_a_narrow_terminal_leaves_out() -> None:
    solution = build_solution()
    errors = calibration_errors(solution, TRUTH)
    assert width_of(calibration_table(solution, errors, width=80)) <= 80
    assert width_of(calibration_table(solution, width=60)) <= 60
    assert "prior std" in printed(calibration_table(solution, errors), 160)
    assert "prior std" not in printed(calibration_table(solution, errors, width=80), 80)


def test_columns_are_left_out_until_a_table_fits() -> None:
    table = Table(title="Title", caption="caption")
    for header in ("name", "first", "second"):
        table.add_column(header, no_wrap=True)
    table.add_row("a", "1" * 20, "2" * 20, end_section=True)
    table.add_row("b", "3", "4")
    assert fitted(table, 80, ("first", "second")) is table
    narrow = fitted(table, 40, ("second", "first"))
    assert [column.header for column in narrow.columns] == ["name", "first"]
    assert [list(column.cells) for column in narrow.columns] == [["a", "b"], ["1" * 20, "3"]]
    assert [row.end_section for row in narrow.rows] == [True, False]
    assert (narrow.title, narrow.caption) == ("Title", "caption")
    # What is left may be too wide.
    assert width_of(fitted(table, 5, ("second",))) > 5


def test_long_names_continue_on_the_next_line() -> None:
    table = Table()
    name = "position of the beacon that the harbour master calls the second from the east"
    add_column(table, "parameter")
    for header in ("value", "std", "truth"):
        add_column(table, header, numeric=True)
    table.add_row(name, "123456.789 ± 0.012", "0.012", "123456.791")
    narrow = fitted(table, 80)
    assert least_width_of(narrow) <= 80
    file = StringIO()
    Console(file=file, width=80).print(narrow)
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "123456.789 ± 0.012" in file.getvalue()
    cells = [line.split("│")[1].strip() for line in lines if line.startswith("│")]
    assert " ".join(cells).split() == name.split()
    assert least_width_of(table) > 80


def test_records_with_large_clock_readings_are_not_cut() -> None:
    trial = build_trial(name="[of] Unix time")
    trial = replace(trial, imu=replace(trial.imu, time=trial.imu.time + 1.7e9))
    text = printed(sensor_table(survey(trial)), 60)
    assert "1700000060" in text
    assert "[of] Unix time" in text
    assert "…" not in text


def test_zeros_have_no_sign() -> None:
    assert with_std(-0.3, 180.0) == "0 ± 180"
    assert with_std(-0.0, 0.0) == "0 ± 0"
    assert at_precision(-0.0004, 0.1) == "0.00"
    assert fixed(-0.001, 2, signed=True) == "+0.00"
    assert fixed(-0.01, 2, signed=True) == "-0.01"
    first, *rest = build_solution().estimates
    estimate = replace(first, value=np.array([-0.3, -0.001, -0.0]), std=np.array([180.0, 0.1, 0]))
    solution = build_solution(estimates=(estimate, *rest))
    errors = calibration_errors(solution, {"misalignment_deg": np.zeros(3)})
    text = printed(calibration_table(solution, errors), 160)
    assert "-0 " not in text
    assert "-0.00 " not in text


def test_precision_and_units() -> None:
    assert with_std(29.99321, 0.0050) == "29.9932 ± 0.0050"
    assert with_std(1234.5, 0.0) == "1234.5 ± 0"
    assert at_precision(float("nan"), 1.0) == "nan"
    assert split_unit("gyro_bias_x_deg_h") == ("gyro_bias_x", "deg/h")
    assert split_unit("scale_error") == ("scale_error", "")


def test_an_error_budget_fits_80_columns() -> None:
    solution = build_solution()
    adds = np.concatenate([e.std for e in solution.estimates])
    causes = ("prior of beacon_sound_speed_error", "noise of DVL velocity", "IMU noise")
    budget = tuple(Cause(name, "", adds / 2.0) for name in causes)
    solution = replace(solution, error_budget=budget)
    assert width_of(error_budget_table(solution)) > 80
    brief = error_budget_table(solution, width=80)
    assert width_of(brief) <= 80
    shown = printed(brief, 80)
    assert all(name in shown for name in causes)
