"""Covariances of fits that have none of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kalman_trials import LEVER_ARM, MISALIGNMENT, SCALE, exact_points

from factorgraph_dvl.baselines.residual_covariance import by_residuals, point_weights
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3

PARAMETERS = (MISALIGNMENT, SCALE, LEVER_ARM)
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
