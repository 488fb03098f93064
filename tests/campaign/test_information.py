"""Information of the data of each trial, and the joint calibration, against one least squares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from factorgraph_dvl.campaign.information import TrialCalibration, information_of
from factorgraph_dvl.campaign.model import fit
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.sensors.dvl import LEVER_ARM_SPEC, MISALIGNMENT_SPEC, SCALE_SPEC
from factorgraph_dvl.sensors.parameters import ParameterSpec
from factorgraph_dvl.solution import Calibration

SHARED = (MISALIGNMENT_SPEC, SCALE_SPEC, LEVER_ARM_SPEC)
DAILY = ParameterSpec("gyro_bias", "deg_h", frame="b")
PRIOR = np.array([10.0] * 3 + [0.1] + [2.0] * 3 + [0.05] * 3)
TRUTH = np.array([2.0, 1.0, 30.0, 0.004, 1.0, 1.2, 1.4])


def posterior(rows, y, mean, covariance):
    """Return mean and covariance of a linear trial with rows of unit noise."""
    information = np.linalg.inv(covariance)
    P = np.linalg.inv(information + rows.T @ rows)
    return P @ (information @ mean + rows.T @ y), P


def calibration(x, P, mean, std):
    estimates, at = [], 0
    for spec in (*SHARED, DAILY):
        own = slice(at, at + spec.size)
        at += spec.size
        sigma = np.sqrt(np.diag(P))[own]
        estimates.append(
            Estimate(
                spec.name,
                spec.component_names,
                x[own],
                sigma,
                mean[own],
                std[own],
                sigma < std[own],
            )
        )
    return Calibration("t", "batch", "RFU", True, 1, 0.0, tuple(estimates), P)


def trials(count, rng, prior=None):
    """Return linear trials: rows, measurements, and what each alone makes of them."""
    mean = np.concatenate([TRUTH + 0.1 * PRIOR[:7] * rng.standard_normal(7), np.zeros(3)])
    covariance = np.diag(PRIOR**2)
    names = ()
    if prior is not None:
        mean[:7], covariance[:7, :7] = prior
        names = tuple(n for spec in SHARED for n in spec.component_names)
    out = []
    for _ in range(count):
        rows = rng.standard_normal((30, 10)) / PRIOR * 30.0
        # One direction that no trial sees.
        rows[:, 6] = 0.0
        y = rows @ np.concatenate([TRUTH, 0.05 * rng.standard_normal(3)])
        y += rng.standard_normal(30)
        x, P = posterior(rows, y, mean, covariance)
        found = calibration(x, P, mean, np.sqrt(np.diag(covariance)))
        joint = covariance[:7, :7] if prior is not None else None
        out.append((rows, y, TrialCalibration(found, names, joint)))
    return mean, out


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_joint_calibration_is_that_of_one_least_squares(rng):
    mean, found = trials(6, rng)
    joint = fit(information_of([t for *_, t in found]), np.zeros(7))
    # One graph of all: seven nodes that the trials share, and three of each.
    daily = block_diag(*(rows[:, 7:] for rows, _, _ in found))
    rows = np.hstack([np.vstack([rows[:, :7] for rows, _, _ in found]), daily])
    y = np.concatenate([y for _, y, _ in found])
    std = np.concatenate([PRIOR[:7], np.tile(PRIOR[7:], 6)])
    x, P = posterior(rows, y, np.concatenate([mean[:7], np.zeros(18)]), np.diag(std**2))
    value, covariance = joint.value_in(-1)
    sigma = np.sqrt(np.diag(P))[:7]
    np.testing.assert_allclose((value - x[:7]) / sigma, 0.0, atol=1e-6)
    np.testing.assert_allclose(
        covariance / np.outer(sigma, sigma), P[:7, :7] / np.outer(sigma, sigma), atol=1e-6
    )


def test_a_joint_prior_is_taken_off_with_its_correlations(rng):
    root = rng.standard_normal((7, 7)) * PRIOR[:7, None] * 0.01
    earlier = TRUTH + root @ rng.standard_normal(7), root @ root.T
    _, found = trials(3, rng, earlier)
    information = information_of([t for *_, t in found])
    for (rows, y, _), matrix, weighted in zip(
        found, information.matrix, information.weighted, strict=True
    ):
        # Of the data and the prior of the day alone.
        daily = rows[:, 7:]
        noise = np.linalg.inv(np.eye(30) + daily @ np.diag(PRIOR[7:] ** 2) @ daily.T)
        expected = rows[:, :7].T @ noise @ rows[:, :7]
        scale = np.sqrt(np.diag(expected)) + 1e-3
        np.testing.assert_allclose(
            matrix / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5
        )
        right = rows[:, :7].T @ noise @ y - expected @ information.origin
        np.testing.assert_allclose(
            weighted / scale, right / scale, atol=1e-4 * abs(right / scale).max()
        )


def test_what_no_trial_sees_stays_at_its_prior(rng):
    mean, found = trials(4, rng)
    joint = fit(information_of([t for *_, t in found]), np.zeros(7))
    value, covariance = joint.value_in(0)
    assert value[6] == pytest.approx(mean[6], abs=1e-6)
    assert np.sqrt(covariance[6, 6]) == pytest.approx(PRIOR[6], rel=1e-3)


def test_chi_square_of_equal_trials_is_about_its_freedom():
    found = []
    for seed in range(20):
        _, each = trials(8, np.random.default_rng(seed))
        joint = fit(information_of([t for *_, t in each]), np.zeros(7))
        assert joint.freedom == pytest.approx(7 * 6, abs=0.1)
        found.append(joint.statistic)
    # Of 20 means, within 3.3 standard deviations.
    assert abs(np.mean(found) - 42.0) < 3.3 * np.sqrt(2 * 42 / 20)
