"""Score and average information of variances, against a dense likelihood."""

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.statistics.average_information import SharedRows, restricted_score
from factorgraph_dvl.statistics.elimination import eliminated

COUNT = 12
# Variances of the measurements, of the steps of a walk, and of what else errs in a measurement.
VARIANCES = np.array([0.5, 0.2])
BESIDE = 0.3
Y = np.random.default_rng(4).normal(size=COUNT).cumsum()


def system(variances):
    """A walk that is measured: residuals, whitened Jacobian, sigma of each row."""
    noise, steps = variances
    sigma = np.sqrt(np.concatenate([np.full(COUNT, noise + BESIDE), np.full(COUNT - 1, steps)]))
    J = np.concatenate([np.eye(COUNT), np.diff(np.eye(COUNT), axis=0)])
    return J / sigma[:, None], np.concatenate([Y, np.zeros(COUNT - 1)]) / sigma, sigma


def minus_two_log(variances):
    J, y, sigma = system(variances)
    x = np.linalg.lstsq(J, y, rcond=None)[0]
    return np.sum((y - J @ x) ** 2) + 2.0 * np.log(sigma).sum() + np.linalg.slogdet(J.T @ J)[1]


@pytest.fixture(scope="module")
def found():
    J, y, _ = system(VARIANCES)
    x = np.linalg.lstsq(J, y, rcond=None)[0]
    residual = J @ x - y
    graph, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(1)
    names = [keys.node(k) for k in range(COUNT)]
    h = np.diag(J @ np.linalg.inv(J.T @ J) @ J.T)
    parts = []
    for i in range(COUNT):
        graph.add(names[i], J[i, i : i + 1, None], -residual[i : i + 1], unit)
    for i in range(COUNT - 1):
        a, b = J[COUNT + i, i], J[COUNT + i, i + 1]
        graph.add(
            names[i], np.array([[a]]), names[i + 1], np.array([[b]]),
            -residual[COUNT + i : COUNT + i + 1], unit,
        )  # fmt: skip
    own = np.array(names)
    measured = Rows(
        "y", ("y",), own[:, None], (1,), np.diag(J[:COUNT])[:, None, None], residual[:COUNT, None]
    )
    between = np.stack([np.diag(J[COUNT:]), np.diag(J[COUNT:], 1)], axis=1)[:, None]
    steps = Rows(
        "s", ("s",), np.stack([own[:-1], own[1:]], axis=1), (1, 1), between, residual[COUNT:, None]
    )
    share = VARIANCES[0] / (VARIANCES[0] + BESIDE)
    for number, (rows, part) in enumerate(((measured, share), (steps, 1.0))):
        shape = rows.vector.shape
        leverage = (h[:COUNT] if number == 0 else h[COUNT:])[:, None]
        parts.append(SharedRows(rows, np.full(shape, number), np.full(shape, part), leverage))
    information = eliminated(graph, keys.ordering(names), dict.fromkeys(names, 1))
    return restricted_score(parts, 2, information)


def test_score_is_the_slope_of_the_likelihood(found):
    for i in range(2):
        step = 1e-5 * np.eye(2)[i]
        ends = [minus_two_log(VARIANCES * np.exp(sign * step)) for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / 2e-5
        assert found.freedom[i] - found.squares[i] == pytest.approx(slope, rel=1e-5)


def test_information_is_the_average_of_observed_and_expected(found):
    J, y, sigma = system(VARIANCES)
    # Of measurements as they are: P = R^-1/2 (I - H) R^-1/2, V_i the derivative of R.
    rest = np.eye(len(y)) - J @ np.linalg.inv(J.T @ J) @ J.T
    P = rest / np.outer(sigma, sigma)
    measured = np.arange(len(y)) < COUNT
    V = [np.diag(VARIANCES[0] * measured), np.diag(VARIANCES[1] * ~measured)]
    plain = P @ (y * sigma)
    expected = np.array([[plain @ a @ P @ b @ plain for b in V] for a in V])
    np.testing.assert_allclose(found.information, expected, rtol=1e-9)
