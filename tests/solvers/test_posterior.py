"""Covariances: against dense algebra, and of what is reported against Monte Carlo."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from problems import SHORT, dense_covariance, problem_of, walking
from truth import scenario

from factorgraph_dvl.geometry.rotations import (
    exp_so3,
    inverse_right_jacobian,
    log_so3,
    reported_rotation_vector,
    right_jacobian,
    rotation_from_rph,
    rph_from_rotation,
    rph_jacobian,
)
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.graph import keys
from factorgraph_dvl.solvers.levenberg_marquardt import eliminate
from factorgraph_dvl.solvers.posterior import SquareRootInformation


@pytest.fixture(scope="module", params=["constant", "walking"])
def system(request):
    """A linearised trial with navigation-grade gyros, and its dense Jacobian."""
    scene = scenario(manoeuvres=SHORT) if request.param == "constant" else walking()
    problem, values = problem_of(scene)
    problem.weigh(problem.evaluate(values))
    gaussian = problem.linearize(problem.evaluate(values))
    ordering = problem.ordering(gaussian)
    sizes = values.dims()
    information = SquareRootInformation(eliminate(gaussian, ordering), sizes)
    order = sorted(sizes)
    place, at = {}, 0
    for key in order:
        place[key] = slice(at, at + sizes[key])
        at += sizes[key]
    rows = []
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        A, _ = factor.jacobian()
        wide, column = np.zeros((A.shape[0], at)), 0
        for key in list(factor.keys()):
            wide[:, place[key]] = A[:, column : column + sizes[key]]
            column += sizes[key]
        rows.append(wide)
    return problem, information, place, np.concatenate(rows)


def worst_relative(found, expected):
    """Largest difference in units of the standard deviations."""
    std = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / np.outer(std, std)).max())


def test_marginals_equal_the_dense_inverse(system):
    _, information, place, A = system
    P = dense_covariance(A)
    found = information.marginals(list(place))
    assert set(found) == set(place)
    for key, where in place.items():
        assert worst_relative(found[key], P[where, where]) < 1e-6


def test_joint_covariance_of_functionals_equals_the_dense_inverse(system):
    problem, information, place, A = system
    P = dense_covariance(A)
    rng = np.random.default_rng(0)
    n = problem.chain.segments.node_time.size
    functionals = [{problem.key(p.name): np.eye(p.mean.size)} for p in problem.parameters]
    functionals.append({keys.node(k): rng.normal(size=(2, 9)) for k in range(0, n, 2)})
    functionals.append({problem.chain.bias_key(k): rng.normal(size=(6, 6)) / n for k in range(n)})
    W = np.zeros((sum(next(iter(f.values())).shape[0] for f in functionals), A.shape[1]))
    row = 0
    for functional in functionals:
        height = next(iter(functional.values())).shape[0]
        for key, matrix in functional.items():
            W[row : row + height, place[key]] += matrix
        row += height
    assert worst_relative(information.covariance_of(functionals), W @ P @ W.T) < 1e-6


def test_the_normal_equations_would_have_few_digits_left(system):
    _, _, _, A = system
    information = A.T @ A
    # Why everything stays with the square root: 1 / epsilon is 4.5e15, and this is a trial
    # of eight seconds.
    assert np.linalg.cond(information) > 1e13


def test_a_conflicting_pair_of_measurements_by_hand():
    # x1 and x2 of one component, sigma 1 and 2, and x2 - x1 known to 1: information
    # [[1 + 1, -1], [-1, 1/4 + 1]], determinant 3/2, inverse [[5/6, 2/3], [2/3, 4/3]].
    graph = gtsam.GaussianFactorGraph()
    unit, one, zero = gtsam.noiseModel.Unit.Create(1), np.eye(1), np.zeros(1)
    graph.add(1, one, zero, unit)
    graph.add(2, one / 2.0, zero, unit)
    graph.add(1, -one, 2, one, zero, unit)
    ordering = gtsam.Ordering()
    ordering.push_back(1)
    ordering.push_back(2)
    information = SquareRootInformation(eliminate(graph, ordering), {1: 1, 2: 1})
    joint = information.covariance_of([{1: one}, {2: one}])
    np.testing.assert_allclose(joint, [[5 / 6, 2 / 3], [2 / 3, 4 / 3]])
    np.testing.assert_allclose(information.marginals([1])[1], [[5 / 6]])
    np.testing.assert_allclose(information.covariance_of([{1: one, 2: one}]), [[21 / 6]])


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 170.0])
@pytest.mark.parametrize("axis", [[0, 0, 1], [1, -2, 2]], ids=str)
def test_covariance_of_the_rotation_vector_by_monte_carlo(axis, angle):
    phi = angle * DEG * np.array(axis) / np.linalg.norm(axis)
    tangent = np.diag([0.05, 0.2, 0.1]) * DEG
    rng = np.random.default_rng(0)
    n = 20_000
    draws = rng.normal(size=(n, 3)) @ tangent
    found = log_so3(exp_so3(phi) @ exp_so3(draws)) - phi
    derivative = inverse_right_jacobian(phi)
    stated = derivative @ tangent @ tangent.T @ derivative.T
    # Standard deviations of 20000 draws scatter by 0.5 %, correlations by 0.7 %.
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(stated)), rtol=0.025)
    assert worst_relative(np.cov(found.T), stated) < 0.04
    if angle >= 30.0:
        # Without the transport it would be wrong.
        assert worst_relative(np.cov(found.T), tangent @ tangent.T) > 0.1


def test_rotation_vectors_near_half_a_turn_stay_in_one_branch():
    rng = np.random.default_rng(0)
    phi = np.array([0.0, 0.0, 180.0]) * DEG
    found = np.array(
        [
            reported_rotation_vector(exp_so3(phi) @ exp_so3(d), near=phi)
            for d in rng.normal(0.0, 0.5 * DEG, (500, 3))
        ]
    )
    assert np.abs(found - phi).max() < 4.0 * DEG
    # Half a turn halves what lies across its axis: theta / 2 / tan(theta / 2) = 0 leaves
    # the cross product alone, pi / 2 times the tangent.
    derivative = inverse_right_jacobian(phi)
    expected = np.sqrt(np.diag(derivative @ derivative.T)) * 0.5 * DEG
    np.testing.assert_allclose(found.std(axis=0), expected, rtol=0.1)
    np.testing.assert_allclose(expected / (0.5 * DEG), [np.pi / 2, np.pi / 2, 1.0])


def test_right_jacobian_and_its_inverse():
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-5, 1e-4, 0.1, 1.0, 3.0, 4.5):
        phi = rng.normal(size=3)
        phi *= scale / np.linalg.norm(phi)
        step = 1e-6
        columns = [
            log_so3(exp_so3(phi - h).T @ exp_so3(phi + h)) / (2.0 * step) for h in np.eye(3) * step
        ]
        np.testing.assert_allclose(right_jacobian(phi), np.stack(columns, axis=1), atol=1e-8)
        product = right_jacobian(phi) @ inverse_right_jacobian(phi)
        np.testing.assert_allclose(product, np.eye(3), atol=1e-11)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("rph", [[0, 0, 0], [10, -20, 137], [-40, 60, 300]], ids=str)
def test_covariance_of_roll_pitch_heading_by_monte_carlo(body_axes, rph):
    rph = np.array(rph) * DEG
    nRb = rotation_from_rph(rph, body_axes)
    rng = np.random.default_rng(0)
    theta = rng.normal(size=(20_000, 3)) @ (np.diag([0.02, 0.08, 0.05]) * DEG)
    theta = theta @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    error = rph_from_rotation(nRb @ exp_so3(theta), body_axes) - rph
    error = (error + np.pi) % (2.0 * np.pi) - np.pi
    derivative = rph_jacobian(rph, body_axes)
    assert worst_relative(np.cov(error.T), derivative @ np.cov(theta.T) @ derivative.T) < 0.01
