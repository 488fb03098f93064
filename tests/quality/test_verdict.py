"""Grades of components, and the verdict that findings and grades amount to."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from builders import build_solution

from factorgraph_dvl.estimates import Noise, NoiseBySpeed, Residuals
from factorgraph_dvl.files.trial_yaml import LimitSettings
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import consistency_findings
from factorgraph_dvl.quality.verdict import DEFAULT_LIMITS, grades, verdict_of


def test_grades_compare_with_the_limit():
    std = np.array([0.1, 0.2, 0.21, 0.01, np.nan])
    seen = np.array([True, True, True, False, True])
    assert grades(std, seen, 0.1) == ("green", "orange", "red", "grey", "grey")
    assert grades(std[:1] * 1e6, seen[:1]) == ("green",)


def test_every_limit_is_a_key_of_a_trial():
    assert set(DEFAULT_LIMITS) == {f.name for f in msgspec.structs.fields(LimitSettings)}
    assert DEFAULT_LIMITS["misalignment_deg"] == 0.1
    assert DEFAULT_LIMITS["scale_error"] == 1e-3
    assert DEFAULT_LIMITS["lever_arm_m"] == 0.1


def test_the_worst_reason_comes_first_and_causes_before_symptoms():
    fits = Finding(Code.DOES_NOT_FIT, "a symptom")
    large = Finding(Code.LARGE_RESIDUALS, "less")
    sign = Finding(Code.DVL_SIGN, "a cause")
    axes = Finding(Code.BODY_AXES, "a worse cause")
    note = Finding(Code.GAPS, "nothing")
    checked = Finding(Code.FORCE_UNIT, "right", severity="ok")
    assert verdict_of([large, fits, note, sign, axes, checked]).reasons == (
        *(axes, fits, sign, large),
    )
    assert verdict_of([note, checked]).grade == "good"
    assert verdict_of([large, sign]).grade == "doubtful"
    assert verdict_of([large, axes]).grade == "do not use"


def known(**changes):
    """A solution whose misalignment is known to 0.05 deg, with changes of that estimate."""
    solution = build_solution()
    first = replace(solution.estimates[0], **{"std": np.full(3, 0.05), **changes})
    return replace(solution, estimates=(first, solution.estimates[1]))


def test_what_the_trial_cannot_tell_is_a_reason_only_where_nobody_knows_it():
    unseen = np.array([True, True, False])
    assert known().verdict.grade == "good"
    assert known(observable=unseen).verdict.grade == "good"
    unknown = known(observable=unseen, std=np.array([0.05, 0.05, 0.15]))
    assert unknown.verdict.grade == "doubtful"
    assert unknown.verdict.reasons[0].text.startswith("misalignment_z_deg (±0.15) above")
    assert known(observable=np.ones(3, bool), std=np.full(3, 0.15)).verdict.grade == "good"
    assert known(observable=np.ones(3, bool), std=np.full(3, 0.25)).verdict.grade == "doubtful"


def test_limits_decide():
    strict = replace(known(), limits={"misalignment_deg": 0.02})
    assert strict.verdict.grade == "doubtful"
    assert strict.grades["scale_error"] == ("green",)


@pytest.mark.parametrize("findings", [(), (Finding(Code.DOES_NOT_FIT, "by far"),)])
def test_without_convergence_nothing_is_to_be_used(findings):
    verdict = replace(known(), converged=False, findings=findings).verdict
    assert verdict.grade == "do not use"
    assert verdict.reasons[0].code == (Code.DOES_NOT_FIT if findings else Code.NOT_CONVERGED)


def test_one_message_says_which_noise_to_enter_where_it_is_larger_and_smaller_than_stated():
    # 0.1 m/s are stated. Residuals are 0.4 m/s along x and 0.2 along y, of which 0.031 m/s and
    # 0.02 m/s are new in each measurement.
    factor = np.array([0.31, 0.2])
    residuals = Residuals(
        *("GNSS velocity", "m/s", ("east", "north"), np.arange(50.0)),
        residual=np.tile([0.4, -0.2], (50, 1)),
        sigma=np.full((50, 2), 0.1) * factor,
    )
    (found,) = consistency_findings([], [residuals], [Noise("gnss_velocity", factor)])
    assert found.code == Code.LARGE_RESIDUALS
    # sqrt((16 + 4) / 2) = 3.2.
    assert "3.2 times" in found.text
    assert "0.2 times as large" in found.text
    assert "enter 0.4, 0.2 m/s (east, north)" in found.text


def test_noise_of_one_axis_alone_is_told_by_axis():
    factor = np.array([1.0, 6.8])
    residuals = Residuals(
        *("DVL velocity", "m/s", ("x", "y"), np.arange(50.0)),
        residual=np.tile([0.1, -0.68], (50, 1)),
        sigma=np.full((50, 2), 0.1) * factor,
    )
    noise = Noise("dvl_velocity", factor, by_speed=NoiseBySpeed(0.3, 0.006, 0.1, 0.002))
    (found,) = consistency_findings([], [residuals], [noise])
    assert found.code == Code.LARGE_RESIDUALS
    assert "1, 6.8 times as large as stated (x, y)" in found.text
    assert "enter" not in found.text


@pytest.mark.parametrize(
    ("size", "factor", "found"),
    [
        (1.0, (1.0, 1.0), []),
        (1.6, (1.5, 1.7), [(Code.LARGE_RESIDUALS, "note")]),
        (1.6, None, [(Code.LARGE_RESIDUALS, "warning")]),
        (2.0, (1.5, 2.2), [(Code.LARGE_RESIDUALS, "warning")]),
        (0.5, (0.4, 0.6), [(Code.SMALL_RESIDUALS, "warning")]),
        (11.0, None, [(Code.DOES_NOT_FIT, "error")]),
    ],
)
def test_noise_is_a_reason_where_it_is_far_from_what_is_stated(size, factor, found):
    scale = 1.0 if factor is None else np.array(factor)
    residuals = Residuals(
        *("DVL velocity", "m/s", ("x", "y"), np.arange(50.0)),
        residual=np.full((50, 2), size),
        sigma=np.ones((50, 2)) * scale,
    )
    noise = [] if factor is None else [Noise("dvl_velocity", np.array(factor))]
    findings = consistency_findings([], [residuals], noise)
    assert [(f.code, f.severity) for f in findings] == found


@pytest.mark.parametrize(
    ("factor", "severity"),
    # Two independent values exceed a mean square of f² with a probability of exp(-f²): that is
    # 0.002 of 2.5, and 0.0007 of 2.7. White noise has 50.
    [((2.5, 1.0), "note"), ((2.7, 1.0), "warning"), ((1.0, 2.5), "warning")],
)
def test_few_values_of_what_persists_may_be_large_by_chance(factor, severity):
    scale = np.array(factor)
    residuals = Residuals(
        *("GNSS position", "m", ("east", "north"), np.arange(50.0)),
        residual=np.full((50, 2), 2.0),
        sigma=np.ones((50, 2)) * scale,
    )
    noise = Noise("gnss_position", scale, correlation_time=np.array([24.5, np.nan]))
    (found,) = consistency_findings([], [residuals], [noise])
    assert (found.code, found.severity) == (Code.LARGE_RESIDUALS, severity)
