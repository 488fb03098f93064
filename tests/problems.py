"""Problems at their minimum or near it."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from truth import exact_states, scenario

from factorgraph_dvl.geometry.rotations import (
    exp_so3,
)
from factorgraph_dvl.graph.inertial_chain import inertial_chain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.sensors.protocol import observed
from factorgraph_dvl.simulation import simulate

SHORT = [{"straight_s": 3}, {"turn_deg_s": 8, "duration_s": 5, "ramp_s": 1}]


ALL_FREE = {
    "dvl": {
        "velocity_std_m_s": 0.001,
        "misalignment_deg": [0, 10, 25],
        "misalignment_std_deg": [5, 10, 20],
        "scale_error_std": [0.1, 0.1, 0.1],
        "bias_std_m_s": [0.1, 0.1, 0.1],
        "time_offset_std_s": 0.1,
        "reference": "water",
    },
    "gnss": {"lever_arm_std_m": [0.1, 0.1, 0.1]},
}
# Errors of an IMU that grow with rate and force.
IMU_ERRORS = {
    "gyro_scale_std_ppm": 300,
    "gyro_misalignment_std_deg": 0.02,
    "gyro_g_sensitivity_std_deg_h_g": 10,
    "accel_scale_std_ppm": 300,
    "accel_misalignment_std_deg": 0.02,
}


def problem_of(scene, trial=None):
    """Return a problem, and values near the truth but not at it."""
    trial = trial or simulate(scene)
    frame = trial.frame()
    inc, _ = increments(trial.imu)
    seg = segments(inc, 1.0)
    states = exact_states(scene, frame, seg.node_time)
    chain = inertial_chain(trial, frame, seg, states)
    observations, parameters = observed(trial.aids, frame, trial.body_axes)
    parameters = (*parameters, *trial.imu.error_parameters())
    prior = Problem(chain, observations, parameters)
    rng = np.random.default_rng(0)
    n = seg.node_time.size
    walk = np.cumsum(rng.normal(0.0, 1e-7, (n, 3)), axis=0) * chain.walking
    states = replace(
        states,
        nRb=states.nRb @ exp_so3(rng.normal(0.0, 0.01, (n, 3))),
        p_n=states.p_n + rng.normal(0.0, 1.0, (n, 3)),
        v_n=states.v_n + rng.normal(0.0, 0.1, (n, 3)),
        gyro_bias=states.gyro_bias + 1e-6 + walk,
        accel_bias=states.accel_bias + 1e-3,
    )
    values = prior.prior_values()
    for p in prior.parameters:
        step = rng.normal(0.0, 0.2, p.mean.size) * p.sigma
        values[p.name] = values[p.name] @ exp_so3(step) if p.rotation else values[p.name] + step
    # Bound where the offset is found, as the solver does it.
    problem = Problem(chain, observations, parameters, start=values)
    return problem, problem.values(states, values)


def walking(scene_changes=None):
    changes = {
        "manoeuvres": SHORT,
        "imu": {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "accel_bias_walk_ug_sqrt_h": 100.0},
        "trial": ALL_FREE,
    }
    return scenario(**changes | (scene_changes or {}))


def prior_cost(problem, name, value):
    """Return the cost of a parameter's prior alone."""
    one = gtsam.Values()
    one.insert(problem.key(name), gtsam.Rot3(value) if value.ndim == 2 else value)
    (factor,) = [
        problem.graph.at(i)
        for i in range(problem.graph.size())
        if list(problem.graph.at(i).keys()) == [problem.key(name)]
    ]
    return factor.error(one)


def dense_covariance(A):
    # QR of scaled columns; the normal equations would have the condition number squared.
    scale = np.linalg.norm(A, axis=0)
    R = np.linalg.qr(A / scale, mode="r")
    inverse = np.linalg.inv(R) / scale[:, None]
    return inverse @ inverse.T
