"""The two point sets: residuals, covariances, starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jacobians import differentiate
from kalman_trials import LEVER_ARM, MISALIGNMENT, SCALE, exact_points
from scipy.spatial.transform import Rotation

from factorgraph_dvl.baselines.outcome import Estimated
from factorgraph_dvl.baselines.point_sets import derivatives, misfit, residuals, rotation_starts
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG


def test_no_residual_at_the_truth():
    turn, arm = np.array([0.1, -0.3, 1.0]), np.array([1.0, 2.0, -0.5])
    points = exact_points(misalignment=turn, scale=0.02, arm=arm)
    true = (exp_so3(turn), np.array([0.02]), arm)
    parameters = (MISALIGNMENT, SCALE, LEVER_ARM)
    residual, sigma = residuals(points, Estimated(parameters, true, np.eye(7)), np.zeros(3))
    assert np.abs(residual).max() < 1e-12
    # 1 cm/s of the DVL and 1 cm/s of the body.
    np.testing.assert_allclose(sigma, np.sqrt(2e-4))
    elsewhere = (true[0], true[1] + 0.01, arm)
    assert misfit(points, Estimated(parameters, elsewhere, np.eye(7)), arm) > 1.0
    assert misfit(points.take(slice(0)), Estimated(parameters, true, np.eye(7)), arm) == 0.0


def test_derivatives_are_those_of_residuals():
    turn, arm = np.array([0.1, -0.3, 1.0]), np.array([1.0, 2.0, -0.5])
    points = exact_points(misalignment=turn, scale=0.02, arm=arm)
    parameters = (MISALIGNMENT, SCALE, LEVER_ARM)

    def there(x):
        values = (exp_so3(turn) @ exp_so3(x[:3]), np.array([0.02 + x[3]]), arm + x[4:])
        return Estimated(parameters, values, np.eye(7))

    numeric = differentiate(lambda x: residuals(points, there(x), np.zeros(3))[0], 7)
    found = derivatives(points, there(np.zeros(7)), np.zeros(3))
    np.testing.assert_allclose(found, numeric, atol=1e-7)


def test_the_rate_shakes_the_lever_arm_across_it():
    no_noise = np.zeros((1, 3))
    still = np.zeros((1, 3, 3))
    points = replace(
        exact_points(1),
        v_b_covariance=still,
        sigma_d=no_noise,
        omega_sigma=np.array([[0.1, 0.2, 0.3]]),
    )
    # By hand: 1/2 (0.1² + 0.2²) 2².
    found = points.covariance_d(np.eye(3), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(found, 0.1 * np.eye(3)[None])


def test_no_rotation_is_further_than_63_degrees_from_a_start():
    starts = np.array(rotation_starts(MISALIGNMENT))
    assert len(starts) == 25
    for R in Rotation.random(200, random_state=0).as_matrix():
        apart = np.linalg.norm(log_so3(R.T @ starts), axis=1)
        assert apart.min() < 63.0 * DEG
    assert len(rotation_starts(replace(MISALIGNMENT, sigma=np.full(3, 0.1)))) == 1
