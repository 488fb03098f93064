"""Covariances of fits that have none of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kalman_trials import LEVER_ARM, MISALIGNMENT, SCALE, exact_points

from factorgraph_dvl.baselines.navigation import NavigationMotion
from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.baselines.point_sets import residuals
from factorgraph_dvl.baselines.residual_covariance import (
    by_residuals,
    neglected_by,
    point_weights,
)
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3

PARAMETERS = (MISALIGNMENT, SCALE, LEVER_ARM)
NOTHING = np.zeros(7)
TURN, ARM = np.array([0.3, -0.8, 1.2]), np.array([1.0, -0.5, 2.0])
VALUES = (exp_so3(TURN), np.array([0.02]), ARM)


def test_a_weight_is_that_of_one_variance_for_three_axes():
    # 0.01 m/s of the DVL, 0.01 m/s of the reference.
    np.testing.assert_allclose(point_weights(exact_points(3)), 1.0 / 2e-4)


def test_least_squares_of_noisy_points_scatter_as_it_says():
    points = exact_points(misalignment=TURN, scale=0.02, arm=ARM)
    rng = np.random.default_rng(0)
    dRb, scale, arm = VALUES
    noise = 0.05
    whole = by_residuals(
        replace(points, v_d=points.v_d + rng.normal(0.0, noise, points.v_d.shape)),
        PARAMETERS,
        VALUES,
        np.zeros(3),
    )

    def predicted(x):
        v = points.v_b + np.cross(points.omega_b, arm + x[4:])
        return ((1.0 + scale + x[3]) * v @ (dRb @ exp_so3(x[:3])).T).ravel()

    J = np.stack([(predicted(h) - predicted(-h)) / 2e-6 for h in 1e-6 * np.eye(7)], axis=1)
    found = np.array(
        [np.linalg.lstsq(J, rng.normal(0.0, noise, J.shape[0]), rcond=None)[0] for _ in range(400)]
    )
    ratio = found.std(axis=0) / np.sqrt(whole.covariance.diagonal())
    assert np.all((ratio > 0.85) & (ratio < 1.15))
    assert np.linalg.norm(log_so3(whole.values[0].T @ dRb)) == 0.0


def test_an_attitude_error_that_lasts_scatters_what_was_found_as_it_says():
    points = exact_points(200, misalignment=TURN, scale=0.02, arm=ARM)
    rng = np.random.default_rng(0)
    nRb = exp_so3(rng.normal(0.0, 1.0, (len(points), 3)))
    v_n = np.einsum("mij,mj->mi", nRb, points.v_b)
    # Most of all about the vertical.
    root = np.diag([3e-4, 6e-4, 3e-3])
    covariance = np.zeros((len(points), 9, 9))
    covariance[:, 6:, 6:] = root @ root
    motion = NavigationMotion(
        points.time, v_n, v_n, nRb, covariance, points.omega_b, points.omega_sigma, v_n[:, 0] > -99
    )

    def residual(turn, x=NOTHING):
        v_b = np.einsum("mji,mj->mi", exp_so3(turn) @ nRb, v_n)
        values = (VALUES[0] @ exp_so3(x[:3]), VALUES[1] + x[3], VALUES[2] + x[4:])
        there = Estimated(PARAMETERS, values, np.eye(7))
        return residuals(replace(points, v_b=v_b), there, np.zeros(3))[0].ravel()

    steps = 1e-6 * np.eye(7)
    still = np.zeros(3)
    J = np.stack([(residual(still, h) - residual(still, -h)) / 2e-6 for h in steps], axis=1)
    R = points.covariance_d(VALUES[0], ARM)
    weight = np.kron(np.eye(len(points)), np.eye(3)) / R[0, 0, 0]
    np.testing.assert_allclose(
        R, R[0, 0, 0] * np.eye(3) * np.ones((len(points), 1, 1)), atol=1e-12
    )
    P = np.linalg.inv(J.T @ weight @ J)
    gain = P @ J.T @ weight
    turns = rng.normal(size=(500, 3)) @ root
    found = np.array([gain @ residual(turn) for turn in turns])
    expected = np.sqrt(1.0 + found.var(axis=0) / P.diagonal())
    factors = neglected_by(points, motion, Estimated(PARAMETERS, VALUES, P), np.zeros(3))
    np.testing.assert_allclose(factors, expected, rtol=0.1)
    assert factors[2] > 3.0


def test_an_attitude_error_by_hand():
    """A straight run along x with the heading wrong by s: all of it is in the misalignment."""
    points = replace(
        exact_points(100),
        v_b=np.tile([2.0, 0.0, 0.0], (100, 1)),
        v_b_covariance=np.zeros((100, 3, 3)),
        omega_b=np.zeros((100, 3)),
        omega_sigma=np.zeros((100, 3)),
        sigma_d=np.full((100, 3), 0.1),
    )
    covariance = np.zeros((100, 9, 9))
    covariance[:, 8, 8] = 0.02**2
    level = np.broadcast_to(np.eye(3), (100, 3, 3))
    motion = NavigationMotion(
        points.time,
        points.v_b,
        points.v_b,
        level,
        covariance,
        points.omega_b,
        points.omega_sigma,
        points.time > -1.0,
    )
    # The angle about z is known to 0.1 / (2 sqrt(100)) = 0.005.
    P = 0.005**2 * np.eye(3)
    found = neglected_by(points, motion, Estimated((MISALIGNMENT,), (np.eye(3),), P), np.zeros(3))
    np.testing.assert_allclose(found, [1.0, 1.0, np.sqrt(1.0 + (0.02 / 0.005) ** 2)])
