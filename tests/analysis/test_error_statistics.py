from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    nees_band,
    paper_accuracy,
    trajectory_errors,
    true_value_of,
)
from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Reference


def solution_of(
    trajectory: Trajectory | None = None,
    estimates: tuple[Estimate, ...] = (),
    covariance: np.ndarray | None = None,
) -> Solution:
    if trajectory is None:
        nothing = np.zeros((0, 3))
        square = np.zeros((0, 3, 3))
        trajectory = Trajectory(np.zeros(0), nothing, nothing, nothing, square, square, square)
    return Solution(
        trial="made by hand",
        solver="batch",
        body_axes="RFU",
        converged=True,
        iterations=1,
        cost=0.0,
        estimates=estimates,
        covariance=np.zeros((0, 0)) if covariance is None else covariance,
        trajectory=trajectory,
    )


def estimate_of(
    name: str, value: list[float], std: list[float], observable: list[bool] | None = None
) -> Estimate:
    n = len(value)
    return Estimate(
        name=name,
        component_names=tuple(f"{name}_{i}" for i in range(n)),
        value=np.array(value),
        std=np.array(std),
        prior_value=np.zeros(n),
        prior_std=np.full(n, 1e3),
        observable=np.array([True] * n if observable is None else observable),
    )


def trajectory_of(reference: Reference, std: tuple[float, float, float]) -> Trajectory:
    n = reference.time.size
    p, v, a = (np.tile(s**2 * np.eye(3), (n, 1, 1)) for s in std)
    return Trajectory(
        reference.time, reference.geodetic, reference.velocity, reference.rph, p, v, a
    )


def swaying(t: np.ndarray, lon: float = 2.0) -> Reference:
    """Motion with 2 Hz sway about a heading that crosses north."""
    w = 4.0 * np.pi
    geodetic = np.stack([0.6 + 1e-7 * np.sin(w * t), lon + 1e-6 * t, 5.0 + np.cos(w * t)], 1)
    velocity = np.stack([np.sin(w * t), np.cos(w * t), 0.1 * t], 1)
    heading = (4.0 * DEG * np.sin(w * t)) % (2.0 * np.pi)
    rph = np.stack([4.0 * DEG * np.cos(w * t), 2.0 * DEG * np.sin(w * t), heading], 1)
    return Reference(t, geodetic, velocity, rph)


def test_errors_by_hand() -> None:
    t = np.array([0.0, 1.0])
    frame = LocalFrame(0.6, 2.0, 30.0)
    offset = np.array([3.0, -4.0, 12.0])
    origin = np.tile([0.6, 2.0, 30.0], (2, 1))
    truth = Reference(t, origin, np.ones((2, 3)), np.tile([0.0, 0.0, 0.01], (2, 1)))
    found = replace(
        trajectory_of(truth, (2.0, 0.5, 0.02)),
        geodetic=np.tile(np.array(frame.geodetic(offset)), (2, 1)),
        velocity=truth.velocity + np.array([0.5, 1.0, -0.5]),
        rph=np.tile([0.02, -0.04, 2.0 * np.pi - 0.01], (2, 1)),
    )
    errors = trajectory_errors(solution_of(found), truth)
    np.testing.assert_array_equal(errors.epochs, [0, 1])
    np.testing.assert_allclose(errors.position.error[1], offset, atol=1e-4)
    np.testing.assert_allclose(errors.position.normalised[1], offset / 2.0, atol=1e-4)
    np.testing.assert_allclose(errors.position.nees, 169.0 / 4.0, atol=1e-3)
    np.testing.assert_allclose(errors.velocity.nees, 6.0)
    np.testing.assert_allclose(errors.attitude.error[0], [0.02, -0.04, -0.02], atol=1e-12)
    np.testing.assert_allclose(errors.attitude.nees, 6.0)


def test_nees_uses_the_whole_covariance() -> None:
    t = np.array([0.0])
    truth = Reference(t, np.array([[0.6, 2.0, 0.0]]), np.zeros((1, 3)), np.zeros((1, 3)))
    covariance = np.array([[[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 9.0]]])
    found = replace(
        trajectory_of(truth, (1.0, 1.0, 1.0)),
        velocity=np.array([[1.0, 1.0, 3.0]]),
        velocity_cov=covariance,
    )
    errors = trajectory_errors(solution_of(found), truth)
    # Inverse of [[4, 1], [1, 1]] is [[1, -1], [-1, 4]] / 3: (1 - 2 + 4) / 3 + 1.
    np.testing.assert_allclose(errors.velocity.nees, [2.0])
    np.testing.assert_allclose(errors.velocity.std, [[2.0, 1.0, 3.0]])


@pytest.mark.parametrize("lon", [2.0, np.pi - 1e-6])
def test_interpolates_a_dense_reference(lon: float) -> None:
    reference = swaying(np.arange(0.0, 4.0, 0.01), lon)
    wrapped = (reference.geodetic[:, 1] + np.pi) % (2.0 * np.pi) - np.pi
    reference.geodetic[:, 1] = wrapped
    between = swaying(np.arange(0.0, 3.98, 0.0337) + 0.0042, lon)
    errors = trajectory_errors(solution_of(trajectory_of(between, (1.0, 1.0, 1.0))), reference)
    assert errors.time.size == between.time.size
    # The error of a cubic, of waves of 1 m and 1 m/s: 1e-5 at the ends, a third of it within.
    assert np.abs(errors.position.error).max() < 1.2e-5
    assert np.abs(errors.velocity.error).max() < 1.2e-5
    assert np.abs(errors.attitude.error).max() < 1e-4 * DEG


def test_sparse_reference_only_counts_where_times_coincide() -> None:
    reference = swaying(np.arange(0.0, 20.0))
    found = swaying(np.arange(-2.0, 25.0, 0.5) + 4e-7)
    errors = trajectory_errors(solution_of(trajectory_of(found, (1.0, 1.0, 1.0))), reference)
    np.testing.assert_allclose(errors.time, np.arange(0.0, 20.0), atol=1e-6)
    np.testing.assert_allclose(found.time[errors.epochs], errors.time)


def test_gaps_in_the_reference_are_left_out() -> None:
    t = np.arange(0.0, 4.0, 0.01)
    reference = swaying(t[(t < 1.0) | (t > 2.0)])
    found = swaying(np.arange(0.005, 3.9, 0.01))
    errors = trajectory_errors(solution_of(trajectory_of(found, (1.0, 1.0, 1.0))), reference)
    assert not np.any((errors.time > 0.99) & (errors.time < 2.01))
    assert errors.time.size > 250


def test_no_common_epoch() -> None:
    reference = swaying(np.arange(3.0))
    found = swaying(np.arange(3.0) + 0.5)
    errors = trajectory_errors(solution_of(trajectory_of(found, (1.0, 1.0, 1.0))), reference)
    assert errors.time.size == 0
    assert errors.position.nees.shape == (0,)


def test_nees_of_draws_lies_inside_its_band() -> None:
    rng = np.random.default_rng(7)
    n = 2000
    zero = np.zeros((n, 3))
    truth = Reference(np.arange(float(n)), zero + np.array([0.6, 2.0, 0.0]), zero, zero)
    root = np.array([[1e-3, 0.0, 0.0], [5e-4, 2e-3, 0.0], [-3e-4, 1e-3, 4e-3]])
    draws = [rng.standard_normal((n, 3)) @ root.T for _ in range(2)]
    covariance = np.tile(root @ root.T, (n, 1, 1))
    found = replace(
        trajectory_of(truth, (1.0, 1.0, 1.0)),
        velocity=draws[0],
        velocity_cov=covariance,
        rph=draws[1],
        rph_cov=covariance,
    )
    errors = trajectory_errors(solution_of(found), truth)
    low, high = nees_band(3, n, 0.999)
    assert low < errors.velocity.nees.mean() < high
    assert low < errors.attitude.nees.mean() < high
    overconfident = replace(errors.velocity, covariance=0.5 * covariance)
    assert overconfident.nees.mean() > high


def test_nees_band() -> None:
    # Quantiles of chi² with 1 and with 10 degrees of freedom, from tables.
    np.testing.assert_allclose(nees_band(1, 1, 0.95), (0.000982, 5.02389), rtol=1e-3)
    np.testing.assert_allclose(nees_band(2, 5, 0.90), (3.940 / 5, 18.307 / 5), rtol=1e-3)


def test_calibration_errors_by_hand() -> None:
    estimates = (
        estimate_of("scale_error", [0.003], [0.001]),
        estimate_of("unknown_m", [7.0], [1.0]),
        estimate_of("lever_arm_m", [1.0, 2.0, 3.0], [0.5, 9.0, 0.0], [True, False, False]),
    )
    covariance = np.diag([1e-6, 1.0, 0.25, 81.0, 0.0])
    covariance[0, 2] = covariance[2, 0] = 0.5 * 1e-3 * 0.5
    truth = {"scale_error": 0.002, "lever_arm_m": [0.5, 0.0, 3.0], "not_estimated_s": [1.0]}
    errors = calibration_errors(solution_of(None, estimates, covariance), truth)
    assert errors.names == ("scale_error_0", "lever_arm_m_0", "lever_arm_m_1", "lever_arm_m_2")
    np.testing.assert_allclose(errors.error, [0.001, 0.5, 2.0, 0.0])
    np.testing.assert_allclose(errors.normalised, [1.0, 1.0, 2.0 / 9.0, np.nan])
    np.testing.assert_array_equal(errors.tested, [True, True, False, False])
    assert errors.dof == 2
    # z = (1, 1) with correlation 0.5: 2 / (1 + 0.5).
    assert errors.nees == pytest.approx(4.0 / 3.0)


def test_calibration_without_truth() -> None:
    estimates = (estimate_of("scale_error", [0.003], [0.001]),)
    errors = calibration_errors(solution_of(None, estimates, np.array([[1e-6]])), {})
    assert errors.names == ()
    assert errors.dof == 0
    assert errors.nees == 0.0


def test_joint_calibration_nees_of_draws() -> None:
    rng = np.random.default_rng(11)
    root = np.tril(rng.standard_normal((7, 7))) + 3.0 * np.eye(7)
    root *= np.array([1e-3, 1e-3, 1e-3, 1e-6, 1.0, 1.0, 1e2])[:, None]
    covariance = root @ root.T
    std = np.sqrt(np.diag(covariance))
    truth = {
        "misalignment_deg": [1.0, 2.0, 3.0],
        "scale_error": 0.002,
        "lever_arm_m": [1.0, 2.0, 3.0],
    }
    true_values = np.array([1.0, 2.0, 3.0, 0.002, 1.0, 2.0, 3.0])
    runs = 300
    nees = []
    for _ in range(runs):
        value = (true_values + root @ rng.standard_normal(7)).tolist()
        estimates = (
            estimate_of("misalignment_deg", value[:3], std[:3]),
            estimate_of("scale_error", value[3:4], std[3:4]),
            estimate_of("lever_arm_m", value[4:], std[4:]),
        )
        errors = calibration_errors(solution_of(None, estimates, covariance), truth)
        assert errors.dof == 7
        nees.append(errors.nees)
    low, high = nees_band(7, runs, 0.999)
    assert low < np.mean(nees) < high


def test_misalignment_near_180_deg() -> None:
    estimate = estimate_of("misalignment_deg", [-179.95, 0.1, 0.0], [0.1] * 3)
    nearest = true_value_of(estimate, {"misalignment_deg": [179.9, 0.0, 0.0]})
    np.testing.assert_allclose(nearest, [-180.1, 0.0, 0.0])
    moderate = estimate_of("misalignment_deg", [30.0, 0.0, 0.0], [0.1] * 3)
    unchanged = true_value_of(moderate, {"misalignment_deg": [29.0, 0.0, 0.0]})
    np.testing.assert_allclose(unchanged, [29.0, 0.0, 0.0])
    none = true_value_of(moderate, {"misalignment_deg": [0.0, 0.0, 0.0]})
    np.testing.assert_allclose(none, 0.0)


def test_only_rotation_vectors_have_equivalents() -> None:
    estimate = estimate_of("gyro_bias_deg_h", [-180.0, 0.0, 0.0], [0.1] * 3)
    kept = true_value_of(estimate, {"gyro_bias_deg_h": [180.0, 0.0, 0.0]})
    np.testing.assert_allclose(kept, [180.0, 0.0, 0.0])


def test_truth_of_another_size() -> None:
    estimate = estimate_of("scale_error", [0.001, 0.002, 0.003], [1e-4] * 3)
    np.testing.assert_allclose(true_value_of(estimate, {"scale_error": 0.002}), [0.002] * 3)
    assert true_value_of(estimate, {"scale_error": [0.001, 0.002]}) is None
    assert true_value_of(estimate, {}) is None


def test_paper_accuracy() -> None:
    estimates = [
        estimate_of("misalignment_deg", [0.99, 2.02, 3.0], [0.1] * 3),
        estimate_of("scale_error", [0.0021], [1e-4]),
        estimate_of("lever_arm_m", [1.0, -0.9, 3.3], [0.1] * 3),
        estimate_of("gyro_bias_deg_h", [5.0, 5.0, 5.0], [0.1] * 3),
    ]
    truth = {
        "misalignment_deg": [1.0, 2.0, 3.0],
        "scale_error": 0.002,
        "lever_arm_m": [1.0, -1.0, 3.0],
        "gyro_bias_deg_h": [1.0, 1.0, 1.0],
    }
    expected = np.mean([99.0, 99.0, 100.0, 95.0, 100.0, 90.0, 90.0])
    assert paper_accuracy(estimates, truth) == pytest.approx(expected)
    truth["misalignment_deg"] = [1.0, 2.0, 0.0]
    expected = np.mean([99.0, 99.0, 95.0, 100.0, 90.0, 90.0])
    assert paper_accuracy(estimates, truth) == pytest.approx(expected)
    assert np.isnan(paper_accuracy(estimates, {}))
