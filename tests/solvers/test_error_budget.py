"""Error budgets add up to the covariance."""

from __future__ import annotations

import numpy as np
import pytest
import solved
from truth import TURNING, scenario

from factorgraph_dvl.files.calibration_file import encode_calibration, load_calibration
from factorgraph_dvl.report.figures.calibration import error_budget_figure
from factorgraph_dvl.report.tables import error_budget_table
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve, solved_problems
from factorgraph_dvl.solvers.calibration import calibration, reported
from factorgraph_dvl.solvers.error_budget import causes, error_budget
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.rows import rows_by_source

SCENE = scenario(noise=True, manoeuvres=TURNING[:3], imu={"rate_hz": 50})


@pytest.fixture(scope="module")
def solution():
    return solve(simulate(SCENE, 0), rate_hz=1.0)


def test_sources_add_up_to_the_covariance():
    found = solved_problems(simulate(SCENE, 0))[0]
    problem, evaluation = found.problem, found.minimum.evaluation
    gaussian = problem.linearize(evaluation)
    sizes = evaluation.values.dims()
    information = eliminated(gaussian, problem.ordering(), sizes)
    functionals = [f for _, _, f in reported(problem, evaluation) if f is not None]
    parts = error_budget(rows_by_source(problem, evaluation), information, functionals)
    P = information.covariance_of(functionals)
    scale = np.sqrt(np.diag(P))
    difference = (sum(parts.values()) - P) / np.outer(scale, scale)
    assert np.abs(difference).max() < 1e-9
    assert {
        "gyro noise",
        "accelerometer noise",
        "DVL velocity",
        "prior of accel_bias_ug",
    } <= parts.keys()


def test_causes_add_up_to_the_reported_variances(solution):
    total = np.sum([c.adds**2 for c in solution.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(solution.covariance), rtol=1e-3)
    by_name = {c.cause: c for c in solution.error_budget}
    assert by_name["noise of GNSS position"].assumed == "0.5, 0.5, 1 m"
    assert by_name["prior of gyro_bias_deg_h"].assumed == "0.05 deg/h"
    assert by_name["gyro noise"].assumed == "0.0005 deg/√h"
    assert by_name["accelerometer noise"].assumed == "25 µg/√Hz"


@pytest.mark.slow
def test_directions_that_are_fixed_have_their_share():
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 30}], sway={}, imu={"rate_hz": 50})
    solution = solve(simulate(scene, 0), rate_hz=1.0)
    (fixed,) = (c for c in solution.error_budget if c.cause.startswith("directions"))
    assert fixed.adds.max() > 0.0
    total = np.sum([c.adds**2 for c in solution.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(solution.covariance), rtol=1e-3)


def test_a_budget_comes_back_from_its_file(solution, tmp_path):
    file = tmp_path / "calibration.json"
    file.write_bytes(encode_calibration(solution))
    loaded = load_calibration(file)
    for ours, theirs in zip(solution.error_budget, loaded.error_budget, strict=True):
        assert (ours.cause, ours.assumed) == (theirs.cause, theirs.assumed)
        np.testing.assert_array_equal(ours.adds, theirs.adds)
    for ours, theirs in zip(solution.noise, loaded.noise, strict=True):
        assert ours.name == theirs.name
        np.testing.assert_array_equal(ours.factor, theirs.factor)


def test_budgets_are_shown(solution):
    table = error_budget_table(solution)
    assert len(table.ends) == np.count_nonzero(np.diag(solution.covariance))
    (ax,) = error_budget_figure(solution).axes
    assert len(ax.get_yticklabels()) == len(table.ends)


@pytest.mark.parametrize("kind", ["turning", "straight"])
def test_the_squares_of_all_causes_are_the_variances(kind):
    _, found = getattr(solved, kind)()
    parts = causes(found)
    std = np.concatenate([e.std for e in calibration(found)[0]])
    total = np.sqrt(np.sum([c.adds**2 for c in parts], axis=0))
    np.testing.assert_allclose(total, std, rtol=0.01)
    # The largest first, each with what is assumed of it.
    share = [float(np.max(c.adds**2 / np.maximum(std**2, 1e-300))) for c in parts]
    assert share == sorted(share, reverse=True)
    assumed = {c.cause: c.assumed for c in parts}
    assert assumed["noise of DVL velocity"].endswith("m/s")
    assert ("directions that the data do not determine" in assumed) == (kind == "straight")
