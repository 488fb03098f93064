"""Square-root information: marginal covariances of states, against those of the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest
from problems import problem_of
from truth import scenario

from factorgraph_dvl.graph import keys
from factorgraph_dvl.solvers.levenberg_marquardt import factorized


@pytest.mark.slow
@pytest.mark.parametrize("walk", [1.0, 1e5])
def test_marginals_are_those_of_the_whole_matrix_however_far_biases_walk(walk):
    imu = {"gyro_bias_walk_deg_h_sqrt_h": walk, "accel_bias_walk_ug_sqrt_h": 0.0}
    legs = [{"straight_s": 90}, {"turn_deg_s": 6, "duration_s": 30, "ramp_s": 4}]
    problem, at = problem_of(scenario(manoeuvres=legs, imu={"rate_hz": 50}, trial={"imu": imu}))
    evaluation = problem.evaluate(at)
    information = factorized(problem, evaluation)[0]
    nodes = [keys.node(k) for k in range(problem.chain.segments.node_time.size)]
    found = information.marginals(nodes)
    order, sizes = problem.ordering(), evaluation.values.dims()
    jacobian, _ = problem.linearize(evaluation).jacobian(order)
    scale = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(jacobian / scale)[1]) / scale[:, None]
    first = 0
    for key in (order.at(i) for i in range(order.size())):
        own = inverse[first : first + sizes[key]]
        first += sizes[key]
        if key in found:
            std = np.linalg.norm(own, axis=1)
            error = (found[key] - own @ own.T) / np.outer(std, std)
            np.testing.assert_allclose(error, 0.0, atol=1e-5)
