"""Motions and helpers for the tests of the Kalman methods."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.baselines.point_sets import Points
from factorgraph_dvl.baselines.strapdown import prepare
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec

STILL = {"manoeuvres": [{"straight_s": 40}], "sway": {}}


NO_ARM = {"lever_arm_m": [0, 0, 0]}


# Speeds from 2 to 5 m/s, and enough of a swell to turn the velocity in the body.
VARIED = [
    {"straight_s": 20},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"straight_s": 20},
    {"turn_deg_s": 6, "duration_s": 20, "ramp_s": 4},
    {"accelerate_m_s2": 0.2, "to_m_s": 5},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 20},
]


def angle_between(solution, truth_deg):
    found = exp_so3(solution.estimate("misalignment_deg").value * DEG)
    return float(np.linalg.norm(log_so3(found.T @ exp_so3(np.array(truth_deg) * DEG)))) / DEG


def samples_of(trial):
    return prepare(increments(trial.imu)[0], trial.imu.settings)


def parameter(stem, mean, sigma, **options):
    spec = ParameterSpec(stem, **options)
    return Parameter(spec, np.array(mean, float), np.array(sigma, float))


def exact_points(count=200, *, misalignment=(0.0, 0.0, 0.0), scale=0.0, arm=(0, 0, 0), bias=0.0):
    """Return point sets without noise for a known calibration."""
    rng = np.random.default_rng(3)
    v, omega = rng.normal(0.0, 3.0, (count, 3)), rng.normal(0.0, 0.2, (count, 3))
    at_dvl = v + np.cross(omega, arm)
    v_d = (1.0 + np.asarray(scale)) * (at_dvl @ exp_so3(np.array(misalignment)).T) + bias
    P = np.broadcast_to(1e-4 * np.eye(3), (count, 3, 3))
    sigma = np.full((count, 3), 0.01)
    return Points(np.arange(float(count)), v, P, omega, np.zeros((count, 3)), v_d, sigma)


MISALIGNMENT = parameter("misalignment", np.zeros(3), np.full(3, 3.0), kind="rotation")
SCALE = parameter("scale_error", [0.0], [0.1], labels=("",))
LEVER_ARM = parameter("lever_arm", np.zeros(3), np.full(3, 10.0))
