"""The calibration at a minimum, as it is reported."""

from __future__ import annotations

import numpy as np
import solved
from problems import problem_of, walking

from factorgraph_dvl.geometry.units import DEG_PER_HOUR, MICRO_G
from factorgraph_dvl.graph import keys
from factorgraph_dvl.solvers.calibration import (
    calibration,
    prior_along,
    reported,
    spread_of_fixed,
)


def test_standard_deviations_are_those_of_the_joint_covariance():
    trial, found = solved.turning()
    estimates, covariance = calibration(found)
    std = np.concatenate([e.std for e in estimates])
    np.testing.assert_allclose(std**2, np.diag(covariance), rtol=1e-12)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    names = [e.name for e in estimates]
    # The DVL's, then the IMU's, with the units of files.
    assert names[:3] == ["misalignment_deg", "scale_error", "lever_arm_m"]
    assert names.index("lever_arm_m") < names.index("gyro_bias_deg_h")
    for name, truth in trial.calibration_truth.items():
        for e in estimates:
            if e.name == name:
                assert np.all(np.abs(e.value - truth) < 5.0 * e.std + 1e-9), name


def test_a_walking_bias_is_reported_as_its_mean():
    problem, values = problem_of(walking())
    evaluation = problem.evaluate(values)
    rows = {
        p.name: (value, derivatives) for p, value, derivatives in reported(problem, evaluation)
    }
    duration = problem.chain.segments.duration
    # Nodes at equal steps: the trapezoidal rule.
    for name, unit, bias, part in (
        ("gyro_bias_deg_h", DEG_PER_HOUR, evaluation.states.gyro_bias, slice(3, 6)),
        ("accel_bias_ug", MICRO_G, evaluation.states.accel_bias, slice(0, 3)),
    ):
        value, derivatives = rows[name]
        mean = duration @ (0.5 * (bias[1:] + bias[:-1])) / duration.sum()
        np.testing.assert_allclose(value, mean / unit, rtol=1e-9)
        total = sum(derivatives[keys.bias(k)][:, part] for k in range(bias.shape[0]))
        np.testing.assert_allclose(total, np.eye(3) / unit, rtol=1e-9)


def test_along_a_fixed_component_the_spread_is_its_priors():
    trial, found = solved.turning()
    problem = found.problem
    rows = reported(problem, found.minimum.evaluation)
    functionals = [derivatives for _, _, derivatives in rows if derivatives is not None]
    fixed = np.zeros((sum(p.mean.size for p in problem.parameters), 1))
    fixed[problem.columns["lever_arm_m"].start + 2] = 1.0
    root = prior_along(problem, fixed, functionals, {})
    std = dict(zip((p.name for p, _, d in rows if d is not None), functionals, strict=True))
    at = 0
    for name, derivatives in std.items():
        size = next(iter(derivatives.values())).shape[0]
        expected = [0.0, 0.0, trial.dvl.settings.lever_arm_std_m[2]]
        part = root[at : at + size, 0]
        np.testing.assert_allclose(part, expected if name == "lever_arm_m" else 0.0, atol=1e-12)
        at += size


def test_nothing_fixed_adds_nothing():
    _, found = solved.turning()
    assert spread_of_fixed(found).size == 0
