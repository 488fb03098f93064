"""Changes along a trial: found where they are, with their size, and seldom by chance."""

from __future__ import annotations

import re
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from truth import merged, scenario

from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.statistics.constancy import Change, changes
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

TIME = np.arange(400.0)
# A constant and a slope along something that has nothing to do with time.
DESIGN = np.stack([np.ones(400), np.random.default_rng(5).normal(size=400)], axis=1)


def fitted(data, gradient=None):
    """Return the tests of a fit of DESIGN to data with unit noise, with a gradient beside it."""
    x = np.linalg.lstsq(DESIGN, data, rcond=None)[0]
    if gradient is not None:
        x = x - np.linalg.solve(DESIGN.T @ DESIGN, gradient)
    graph = gtsam.GaussianFactorGraph()
    graph.add(1, DESIGN, data - DESIGN @ x, gtsam.noiseModel.Unit.Create(400))
    ordering = gtsam.Ordering()
    ordering.push_back(1)
    tree = graph.eliminateMultifrontal(ordering, gtsam.EliminateQR)
    information = SquareRootInformation([tree], {1: 2})
    keys = np.ones((400, 1), dtype=int)
    rows = Rows("y", ("",), keys, (2,), DESIGN[:, None, :], (DESIGN @ x - data)[:, None])
    functional = {1: np.eye(2)}
    return changes(
        [(rows, TIME)],
        information.covariance_with([functional]),
        information.covariance_of([functional]),
        (0.0, 399.0),
        None if gradient is None else {1: gradient},
    )


def exact(data, i, time):
    """Fall of the sum of squares, and the estimate, when component i changes after a time."""
    more = np.column_stack([DESIGN, DESIGN[:, i] * (time < TIME)])
    fits = [np.linalg.lstsq(A, data, rcond=None)[0] for A in (DESIGN, more)]
    before, after = (
        np.sum((data - A @ x) ** 2) for A, x in zip((DESIGN, more), fits, strict=True)
    )
    return before - after, fits[1][2]


@pytest.mark.parametrize("component", [0, 1])
def test_a_change_shifts_the_components_as_a_fit_does(component):
    data = np.random.default_rng(2).normal(size=400) + DESIGN[:, component] * (TIME > 150.0)
    change = fitted(data)[component]
    more = np.column_stack([DESIGN, DESIGN[:, component] * (change.time < TIME)])
    one, both = (np.linalg.lstsq(A, data, rcond=None)[0] for A in (DESIGN, more))
    assert change.size == pytest.approx(both[2])
    assert change.shift == pytest.approx(both[:2] - one)


@pytest.mark.parametrize("component", [0, 1])
def test_the_test_is_the_fall_of_the_cost(component):
    data = np.random.default_rng(1).normal(size=400)
    data += 1.5 * DESIGN[:, component] * (TIME > 250)
    test = fitted(data)[component]
    assert test.time == pytest.approx(250, abs=4.0)
    fall, size = exact(data, component, test.time)
    # The scatter of twenty scores is 1 within a third.
    assert fall / 1.7 < test.chi2 <= fall * (1.0 + 1e-9)
    assert test.size == pytest.approx(size, rel=1e-9)
    assert (test.size / test.std) ** 2 == pytest.approx(fall, rel=1e-9)


def test_a_gradient_that_no_row_has_makes_no_change():
    data = np.random.default_rng(4).normal(size=400)
    with_gradient = fitted(data, np.array([80.0, -60.0]))
    for one, other in zip(with_gradient, fitted(data), strict=True):
        assert one.time == other.time
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-9)
        assert one.size == pytest.approx(other.size, rel=1e-9)


def test_a_drift_is_the_largest_fall_although_it_scatters_most():
    """The scores of a drift scatter as it goes on; those of what follows it scatter less."""
    data = np.random.default_rng(2).normal(size=400) + 0.03 * TIME
    drift, other = fitted(data)
    assert drift.fall == pytest.approx((drift.size / drift.std) ** 2, rel=1e-9)
    assert drift.chi2 < 0.2 * drift.fall
    assert drift.fall > 20.0 * other.fall


def test_chance_seldom_makes_a_change():
    rng = np.random.default_rng(0)
    largest = [max(t.significance for t in fitted(rng.normal(size=400))) for _ in range(150)]
    assert max(largest) < 5.0
    # Andrews: one test of a change within 5 to 95 % exceeds 3.6 in one of a hundred.
    assert np.mean(np.array(largest) > 3.6) < 0.06


def test_correlated_noise_seldom_makes_a_change():
    """What goes up and down for some parts of the trial is no step."""
    rng = np.random.default_rng(3)
    wander = np.zeros((40, 400))
    for j in range(1, 400):
        wander[:, j] = 0.9 * wander[:, j - 1] + rng.normal(size=40)
    significances = [max(t.significance for t in fitted(each)) for each in wander]
    assert np.mean(np.array(significances) > 5.0) < 0.1
    # Without the scatter nearly all would be.
    assert np.mean([fitted(each)[0].size / fitted(each)[0].std > 5.0 for each in wander]) > 0.3


SCENE = {
    "noise": True,
    "sway": merged({}, {"roll": [{"amplitude_deg": 4, "frequency_hz": 0.3}]}),
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.005},
    "gnss": {"position_std_m": [0.02] * 3, "velocity_std_m_s": [0.02] * 3},
}


def test_a_scale_that_changes_is_found_and_makes_the_result_useless():
    trial = simulate(scenario(**SCENE), 2)
    assert not [f for f in solve(trial).findings if f.code == Code.CHANGED_ALONG_TRIAL]
    velocity = trial.dvl.velocity * np.where(trial.dvl.time[:, None] > 30.0, 1.01, 1.0)
    changed = solve(replace(trial, dvl=replace(trial.dvl, velocity=velocity)))
    (finding,) = (f for f in changed.findings if f.code == Code.CHANGED_ALONG_TRIAL)
    assert finding.parameter == "scale_error"
    assert float(finding.text.split()[3]) == pytest.approx(0.01, rel=0.2)
    assert float(re.search(r"at (\d+) s", finding.text)[1]) == pytest.approx(30.0, abs=1.0)
    assert changed.verdict.grade == "do not use"


def test_a_change_beyond_its_prior_pays_for_it():
    # 1.5 ± 0.1 of a bias that is known to 0.05: 0.05² / (0.05² + 0.1²) = 0.2.
    change = Change(100.0, 120.0, 30.0, 1.5, 0.1, np.zeros(1))
    found = change.within(0.05)
    assert found.chi2 == pytest.approx(20.0)
    assert found.fall == pytest.approx(24.0)
    assert (found.size, found.std) == (1.5, 0.1)
    # One that may be anything costs nothing; one that nothing is known of is none.
    assert change.within(1e6).chi2 == pytest.approx(100.0)
    assert Change(0.0, 0.0, 30.0, 0.0, np.inf, np.zeros(1)).within(1.0).chi2 == 0.0
