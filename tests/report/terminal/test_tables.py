from __future__ import annotations

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from builders import build_solution, build_trial
from rich.console import Console

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Cause
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.notation import at_precision, fixed, sentence, split_unit, with_std
from factorgraph_dvl.report.table import Table
from factorgraph_dvl.report.tables import (
    calibration_table,
    error_budget_table,
    known_errors,
    sensor_table,
)
from factorgraph_dvl.report.terminal.tables import least_width_of, rendered, width_of

TRUTH = {"misalignment_deg": [1.0, 2.0, 3.0], "scale_error": [0.005]}


def printed(table: Table, width: int) -> str:
    file = StringIO()
    shown = rendered(table, width)
    Console(file=file, width=max(width, width_of(shown))).print(shown)
    return file.getvalue()


@pytest.mark.parametrize("width", [160, 80, 60, 20])
@pytest.mark.parametrize("known", [True, False])
def test_no_name_and_no_number_is_cut(width: int, known: bool) -> None:
    solution = build_solution()
    errors = calibration_errors(solution, TRUTH) if known else None
    text = printed(calibration_table(solution, known_errors(errors)), width)
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
    table = calibration_table(solution, known_errors(errors))
    assert width_of(rendered(table, 80)) <= 80
    assert width_of(rendered(calibration_table(solution), 60)) <= 60
    assert "before the trial" in printed(table, 160)
    assert "before the trial" not in printed(table, 80)


def test_columns_are_left_out_until_a_table_fits() -> None:
    table = Table(title="Title", caption="caption")
    for header in ("name", "first", "second"):
        table.column(header)
    table.row("a", "1" * 20, "2" * 20, end_section=True)
    table.row("b", "3", "4")
    assert len(rendered(table, 80, ("first", "second")).columns) == 3
    narrow = rendered(table, 40, ("second", "first"))
    assert [column.header for column in narrow.columns] == ["name", "first"]
    assert [list(map(str, column.cells)) for column in narrow.columns] == [
        ["a", "b"],
        ["1" * 20, "3"],
    ]
    assert [row.end_section for row in narrow.rows] == [True, False]
    assert (str(narrow.title), narrow.caption) == ("Title", "caption")
    # What is left may be too wide.
    assert width_of(rendered(table, 5, ("second",))) > 5


def test_long_names_continue_on_the_next_line() -> None:
    table = Table()
    name = "position of the beacon that the harbour master calls the second from the east"
    table.column("parameter")
    for header in ("value", "std", "truth"):
        table.column(header, numeric=True)
    table.row(name, "123456.789 ± 0.012", "0.012", "123456.791")
    narrow = rendered(table, 80)
    assert least_width_of(narrow) <= 80
    file = StringIO()
    Console(file=file, width=80).print(narrow)
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "123456.789 ± 0.012" in file.getvalue()
    cells = [line.split("│")[1].strip() for line in lines if line.startswith("│")]
    assert " ".join(cells).split() == name.split()
    assert least_width_of(rendered(table)) > 80


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
    text = printed(calibration_table(solution, known_errors(errors)), 160)
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
    causes = ("prior of beacon_sound_speed_error", "noise of DVL velocity", "gyro noise")
    budget = tuple(Cause(name, "", adds / 2.0) for name in causes)
    solution = replace(solution, error_budget=budget)
    table = error_budget_table(solution)
    assert width_of(rendered(table, 80)) <= 80
    shown = printed(table, 80)
    assert all(name in shown for name in causes)


def test_a_question_has_no_full_stop() -> None:
    assert sentence("is it in m/s?") == "is it in m/s?"
    assert sentence("it is in m/s") == "it is in m/s."
    error = DataError("is it in m/s?", hint="Check the units.")
    assert str(error) == "is it in m/s? Check the units."
