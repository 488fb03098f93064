"""Measurement update and smoother against closed forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.baselines.kalman_filter import ForwardPass, smoothed_errors, update


@dataclass(frozen=True)
class Filtered:
    covariance: np.ndarray


def test_an_update_adds_information():
    rng = np.random.default_rng(0)
    A, H = rng.normal(size=(4, 4)), rng.normal(size=(2, 4))
    P, R = A @ A.T + np.eye(4), np.diag([0.3, 0.7])
    K, after = update(P, H, R)
    expected = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    np.testing.assert_allclose(after, expected, atol=1e-12)
    np.testing.assert_allclose(K, expected @ H.T @ np.linalg.inv(R), atol=1e-12)
    for one, other in zip(update(P, H, np.diag(R)), (K, after), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_the_smoother_is_the_least_squares_solution_of_a_random_walk():
    z, start, walk, noise = np.array([1.0, 2.0, -1.0, 0.5]), 4.0, 0.5, 0.25
    n, x, P = z.size, 0.0, np.array([[start]])
    filtered, predicted, corrections, states = [], [], [], []
    for k in range(n):
        P = P + (walk if k else 0.0)
        predicted.append(P)
        K, P = update(P, np.eye(1), np.array([noise]))
        corrections.append(K[0] * (z[k] - x))
        x = x + corrections[-1][0]
        states.append(x)
        filtered.append(P)
    ones = np.ones((n, 1, 1))
    forward = ForwardPass(
        Filtered(np.array(filtered)), ones, np.array(predicted), np.array(corrections)
    )
    error, covariance = smoothed_errors(forward)
    D = np.diff(np.eye(n), axis=0)
    information = np.eye(n) / noise + D.T @ D / walk
    information[0, 0] += 1.0 / start
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(np.array(states) + error[:, 0], expected @ z / noise)
    np.testing.assert_allclose(covariance[:, 0, 0], np.diag(expected))
