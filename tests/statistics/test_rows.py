"""Rows by source, and leverages, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from dense_rows import dense, place_of, width_of
from exactness import worst_relative
from kinds import TRIALS
from problems import SHORT, dense_covariance, problem_of, walking
from truth import scenario

from factorgraph_dvl.solvers.batch import solve_with_problem
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.leverage import leverage
from factorgraph_dvl.statistics.rows import (
    add_transposed_product,
    product,
    rows_by_source,
    rows_with_times,
)


@pytest.fixture(scope="module", params=["constant", "walking"])
def system(request):
    scene = walking()
    if request.param == "constant":
        scene = scenario(manoeuvres=SHORT, imu={"gaps_s": [[3.0, 5.0]]})
    problem, values = problem_of(scene)
    problem.weigh(problem.evaluate(values))
    evaluation = problem.evaluate(values)
    rows = list(rows_by_source(problem, evaluation))
    return problem, evaluation, rows


def test_rows_are_those_of_the_graph(system):
    problem, evaluation, rows = system
    assert sum(0.5 * np.sum(r.vector**2) for r in rows) == pytest.approx(evaluation.cost, rel=1e-9)
    place = place_of(evaluation)
    A = np.concatenate([dense(r, place).reshape(-1, width_of(place)) for r in rows])
    gaussian = problem.linearize(evaluation)
    hessian, gradient = gaussian.hessian()
    assert worst_relative(A.T @ A, hessian) < 1e-9
    b = np.concatenate([r.vector.ravel() for r in rows])
    np.testing.assert_allclose(-A.T @ b, gradient, rtol=1e-6, atol=1e-6)


def test_sources_have_names(system):
    problem, _, rows = system
    found = {r.source for r in rows}
    assert {
        "gyro noise",
        "accelerometer noise",
        "prior of the first state",
        "prior of gyro_bias_deg_h",
    } <= found
    assert {"prior of misalignment_deg", "DVL velocity", "GNSS position"} <= found
    assert ("random walk of accel_bias_ug" in found) == problem.chain.walking
    assert ("motion while the IMU is silent" in found) == (not problem.chain.walking)


def test_products_are_those_of_dense_matrices(system):
    _, evaluation, rows = system
    place = place_of(evaluation)
    rng = np.random.default_rng(0)
    columns = {key: rng.normal(size=(w.stop - w.start, 3)) for key, w in place.items()}
    stacked = np.concatenate([columns[key] for key in place])
    for each in rows:
        J = dense(each, place)
        np.testing.assert_allclose(product(each, columns), J @ stacked, rtol=1e-9, atol=1e-9)
        factors = rng.normal(size=(*each.vector.shape, 2))
        sums = {}
        add_transposed_product(each, factors, sums)
        expected = np.einsum("mdn,mdw->nw", factors, J)
        for key, where in place.items():
            got = sums.get(key, np.zeros((2, where.stop - where.start)))
            np.testing.assert_allclose(got, expected[:, where], rtol=1e-9, atol=1e-6)


def test_sums_of_leverages_are_those_of_the_dense_hat_matrix(system):
    problem, evaluation, rows = system
    gaussian = problem.linearize(evaluation)
    sizes = evaluation.values.dims()
    information = eliminated(gaussian, problem.ordering(), sizes)
    place = place_of(evaluation)
    matrices = [dense(r, place) for r in rows]
    P = dense_covariance(np.concatenate([J.reshape(-1, width_of(place)) for J in matrices]))
    count = sum(r.vector.size for r in rows)
    found_by_rows = leverage(lambda: rows, count, information)
    for J, (_, found) in zip(matrices, found_by_rows, strict=True):
        exact = np.einsum("mdi,ij,mdj->d", J, P, J)
        # Three standard deviations of 32 probes.
        assert np.all(np.abs(found.sum(axis=0) - exact) < 3.0 * np.sqrt(exact / 16.0) + 1e-6)
    total = sum(np.einsum("mdi,ij,mdj->", J, P, J) for J in matrices)
    assert total == pytest.approx(width_of(place), rel=1e-6)


@pytest.mark.parametrize("kind", ["imu", "ship", "beacon"])
def test_all_rows_but_priors_have_times(kind):
    _, found = solve_with_problem(TRIALS[kind](), rate_hz=1.0)
    evaluation = found.minimum.evaluation
    observed = {o.label for o in found.problem.observations}
    every = list(rows_by_source(found.problem, evaluation))
    timed = [rows for rows, _ in rows_with_times(found.problem, every)]
    left_out = [r for r in every if not any(r is each for each in timed)]
    assert len(left_out) < len(every)
    assert all(r.keys.shape[1] == 1 and r.source not in observed for r in left_out)
