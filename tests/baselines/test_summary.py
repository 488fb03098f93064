"""From smoothed motion and a calibration to a solution."""

from __future__ import annotations

import numpy as np
from truth import scenario

from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.simulation import simulate


def test_walking_biases_are_reported_as_their_mean():
    walk = {"gyro_bias_walk_deg_h_sqrt_h": 0.1, "accel_bias_walk_ug_sqrt_h": 50}
    solution = kalman(simulate(scenario(noise=True, imu=walk), 1))
    assert np.all(np.isfinite(solution.covariance))
    assert solution.estimate("gyro_bias_deg_h").prior_std[0] > 0.05
