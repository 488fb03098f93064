"""What changes between trials: found with place, size and probability, and nothing else."""

from __future__ import annotations

import os

import numpy as np
import pytest
from gaussian_trials import SIGMA, gaussian_trials, remount
from scipy.stats import binom, chi2

from factorgraph_dvl.campaign.changes import normal_equivalent, supremum_probability
from factorgraph_dvl.campaign.joint_calibration import joint_calibration
from factorgraph_dvl.campaign.model import fitted, probabilities

DAYS = np.arange(40.0)
RUNS = 10 * int(os.environ.get("FACTORGRAPH_DVL_SEEDS", "50"))


def found_by(joint):
    return [(c.component, c.after) for c in joint.changes]


def test_a_remount_is_found_with_place_size_and_probability():
    joint = joint_calibration(gaussian_trials(1, remount(22)), DAYS)
    ((component, after),) = found_by(joint)
    assert component == 2
    assert abs(after - 22) <= 1
    step, std = joint.step(0)
    assert abs(step - 0.1) < 3.3 * std
    assert std == pytest.approx(0.03 * np.sqrt(1 / 23 + 1 / 17), rel=0.25)
    assert joint.changes[0].probability < 1e-6
    # The joint calibration is that after the remount.
    assert abs(joint.value[2] - 0.1) < 3.3 * np.sqrt(joint.covariance[2, 2])


def test_a_replaced_transducer_steps_in_several_components():
    shift = remount(14)
    shift[15:, 3] = 0.003
    joint = joint_calibration(gaussian_trials(2, shift), DAYS)
    assert sorted(c for c, _ in found_by(joint)) == [2, 3]
    assert all(abs(after - 14) <= 1 for _, after in found_by(joint))


def test_nothing_is_found_where_nothing_changed():
    joint = joint_calibration(gaussian_trials(3, np.zeros(7)), DAYS)
    assert not joint.changes
    assert not joint.drifts
    assert joint.probability > 1e-3


def test_a_walk_at_random_is_a_drift_and_no_series_of_steps():
    rng = np.random.default_rng(4)
    shift = np.zeros((40, 7))
    shift[:, 2] = np.cumsum(0.03 * rng.standard_normal(40))
    joint = joint_calibration(gaussian_trials(4, shift), DAYS)
    assert [d.component for d in joint.drifts] == [2]
    assert 2 not in [c for c, _ in found_by(joint)]
    assert np.sqrt(joint.drifts[0].variance) == pytest.approx(0.03, rel=0.6)
    # The present value, not the mean of all.
    assert abs(joint.value[2] - shift[-1, 2]) < 3.3 * np.sqrt(joint.covariance[2, 2])


def test_a_scale_follows_temperature():
    temperature = 15.0 + 8.0 * np.sin(DAYS / 4.0)
    shift = np.zeros((40, 7))
    shift[:, 3] = 1e-4 * (temperature - temperature.mean())
    joint = joint_calibration(gaussian_trials(6, shift), DAYS, {"temperature": temperature})
    (slope,) = joint.slopes
    assert (slope.covariate, slope.component) == ("temperature", 3)
    value, std = joint.slope(0)
    assert abs(value - 1e-4) < 3.3 * std
    assert not joint.changes


def test_variance_between_trials_is_found_where_it_is():
    rng = np.random.default_rng(7)
    shift = np.zeros((40, 7))
    shift[:, 4] = 0.05 * rng.standard_normal(40)
    best = fitted(gaussian_trials(7, shift))
    std = np.sqrt(best.variance) * best.scale
    assert std[4] == pytest.approx(0.05, rel=0.35)
    assert np.all(np.delete(std, 4) < SIGMA[[0, 1, 2, 3, 5, 6]])
    p = probabilities(best)
    assert p[4] < 1e-6
    assert np.all(np.delete(p, 4) > 1e-3)


def test_the_supremum_is_that_of_a_brownian_bridge():
    """Against a simulated chain of equal trials."""
    rng = np.random.default_rng(0)
    count = 40
    c = np.arange(1, count)
    walks = np.cumsum(rng.standard_normal((20_000, count)), axis=1)
    bridge = walks[:, :-1] - walks[:, -1:] * c / count
    largest = np.abs(bridge / np.sqrt(c * (count - c) / count)).max(axis=1)
    odds = c / (count - c)
    neighbours = np.sqrt(odds[:-1] / odds[1:])
    for z in (3.0, 3.5):
        share = np.mean(largest > z)
        bound = supremum_probability(z, neighbours)
        assert share - 3.3 * np.sqrt(share / 20_000) < bound
        # Little more than half of the sum over all steps.
        assert bound < 0.6 * (count - 1) * chi2.sf(z**2, 1)
    assert normal_equivalent(2.0, 1e9) == pytest.approx(2.0, abs=1e-6)
    assert normal_equivalent(4.0, 10) < 3.1


@pytest.mark.slow
def test_false_alarms_and_power():
    """Steps of 0.1 deg at sigma 0.03 deg after any trial but the outermost two: 95 % and 1 %."""
    rng = np.random.default_rng(0)
    alarms = hits = 0
    for seed in range(RUNS):
        joint = joint_calibration(gaussian_trials(seed, np.zeros(7)), DAYS)
        alarms += bool(joint.changes or joint.drifts)
        after = int(rng.integers(1, 38))
        joint = joint_calibration(gaussian_trials(seed + RUNS, remount(after)), DAYS)
        hits += any(k == 2 and abs(c - after) <= 2 for k, c in found_by(joint))
    assert alarms <= binom.ppf(0.999, RUNS, 0.01)
    assert hits >= binom.ppf(0.001, RUNS, 0.95)
