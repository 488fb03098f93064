"""Score tests against fits in which the candidates are free."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from freed_scores import scores

from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

WIDE = {"slope": (2, np.array([1e3])), "curve": (3, np.array([1e3])), "wave": (4, np.full(2, 1e3))}


@pytest.fixture(scope="module")
def line():
    """A constant is fitted to data with a slope; slope, curvature and wave are candidates."""
    t = np.linspace(-1.0, 1.0, 60)
    columns = {
        1: np.ones((60, 1)),
        2: t[:, None],
        3: t[:, None] ** 2,
        4: np.stack([np.sin(9.0 * t), np.cos(9.0 * t)], axis=1),
    }
    data = 0.4 + 1.5 * t + np.random.default_rng(0).normal(0.0, 1.0, 60)
    graph = gtsam.GaussianFactorGraph()
    root = np.linalg.qr(np.hstack([*columns.values(), (data - data.mean())[:, None]]), mode="r")
    # Only a custom factor takes four variables.
    unit = gtsam.noiseModel.Unit.Create(6)
    rows = gtsam.CustomFactor(
        unit, list(columns), lambda _, at, jacobians: filled(jacobians, root)
    )
    graph.push_back(rows.linearize(gtsam.Values()))
    for key, sigma in WIDE.values():
        n = sigma.size
        graph.add(key, np.diag(1.0 / sigma), np.zeros(n), gtsam.noiseModel.Unit.Create(n))
    ordering = gtsam.Ordering()
    for key in (1, 2, 3, 4):
        ordering.push_back(key)
    tree = graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)
    information = SquareRootInformation([tree], {1: 1, 2: 1, 3: 1, 4: 2})
    return columns, data, scores(tree.optimize(), information, WIDE)


def filled(jacobians, root):
    if jacobians is not None:
        for i, (a, b) in enumerate([(0, 1), (1, 2), (2, 3), (3, 5)]):
            jacobians[i] = np.asfortranarray(root[:, a:b])
    return -root[:, 5]


def fall(columns, data, keys):
    """Fall of the sum of squares when candidates are free."""
    left = []
    for free in ([1], [1, *keys]):
        A = np.hstack([columns[k] for k in free])
        x, *_ = np.linalg.lstsq(A, data, rcond=None)
        left.append(np.sum((data - A @ x) ** 2))
    return left[0] - left[1], x


@pytest.mark.parametrize("names", [["slope"], ["curve"], ["wave"], ["slope", "wave"]])
def test_chi2_is_the_fall_of_the_cost(line, names):
    columns, data, found = line
    expected, x = fall(columns, data, [WIDE[name][0] for name in names])
    test = found.test(names)
    assert test.chi2 == pytest.approx(expected, rel=1e-4)
    np.testing.assert_allclose(test.step, x[1:], rtol=1e-3, atol=1e-5)
    assert test.freedom == x.size - 1


def test_the_cause_ranks_first(line):
    *_, found = line
    ranked = sorted(WIDE, key=lambda name: -found.test([name]).evidence(WIDE[name][1]))
    assert ranked[0] == "slope"
    assert found.test(["slope"]).log10_p < -5.0
    # 60 data of unit noise, a third of their square: known to 0.224, with a prior of 1e3.
    test = found.test(["slope"])
    assert test.evidence(np.array([1e3])) == pytest.approx(test.chi2 - 16.8, abs=0.1)
    assert found.test(["slope"]).std == pytest.approx(1.0 / np.sqrt(60 / 3), rel=0.05)
