"""Truncated least squares: scale, weights, windows."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.statistics.robust_weights import (
    Truncation,
    misfit,
    persistent_misfit,
    robust_scale,
    windows,
)


def noise(count=400, sigma=1.0):
    return np.random.default_rng(0).normal(0.0, sigma, (count, 3))


def test_scale_sees_neither_outliers_nor_what_is_slow():
    residuals = noise(sigma=2.0)
    slow = 10.0 * np.sin(np.linspace(0.0, 6.0, 400))[:, None]
    gross = np.zeros((400, 3))
    gross[::10] = 100.0
    np.testing.assert_allclose(robust_scale(residuals + slow), 2.0, rtol=0.15)
    # One difference in five contains an outlier.
    assert np.all(robust_scale(residuals + gross) < 3.0)
    assert np.all(robust_scale(np.zeros((400, 3))) == 0.2)


def test_good_residuals_are_not_worth_a_search():
    search = Truncation(noise(), apart=False)
    assert not search.worth_it
    assert search.done


@pytest.mark.parametrize("apart", [False, True])
def test_a_mean_is_found_among_outliers(apart):
    """The mean of what stays, where least squares is drawn away by several sigma."""
    data = noise()
    bad = np.zeros((400, 3), dtype=bool)
    bad[::7] = True if not apart else [True, False, False]
    data[bad] += 30.0
    mean = data.mean(axis=0)
    search = Truncation(data - mean, apart=apart)
    assert search.worth_it
    steps = 0
    while not search.done:
        weights = np.broadcast_to(search.weights(data - mean), data.shape)
        mean = np.sum(weights * data, axis=0) / weights.sum(axis=0)
        steps += 1
    assert steps < 30
    found = np.broadcast_to(search.outliers(data - mean), data.shape)
    assert found[bad].all()
    assert found[~bad].mean() < 0.005
    assert np.all(np.abs(mean) < 0.2)


def test_errors_of_less_than_a_stated_deviation_are_not_gross():
    """The noise turned out to be a 50th of what was stated."""
    data = noise()
    data[::10] += 8.0
    assert Truncation(data, apart=False).worth_it
    assert not Truncation(data, apart=False, unit=50.0).worth_it


def test_unused_components_count_nothing():
    data = noise()
    data[5] = np.nan
    data[7] = [50.0, np.nan, np.nan]
    search = Truncation(data, apart=False)
    found = search.outliers(data)
    assert found[7, 0]
    assert not found[5, 0]


def test_windows_join_what_is_wrong_together():
    time = np.arange(200) * 0.2
    rejected = np.zeros(200, dtype=bool)
    rejected[50:80] = True
    rejected[60] = False
    rejected[[10, 120, 140, 160, 190]] = True
    used = np.ones(200, dtype=bool)
    inside = windows(time, rejected, used)
    assert inside[50:80].all()
    assert inside.sum() == 30
    # Few and far between, as of a sensor that measures seldom, they are no window.
    assert not windows(20.0 * time, rejected, used).any()


def test_misfit_by_hand():
    """Two good residuals of 1 and -1 sigma, and a gross one, of a sensor of 0.1 m/s."""
    residuals = np.array([[1.0], [-1.0], [50.0], [np.nan]])
    sigma = np.full((4, 1), 0.1)
    rejected = np.array([[False], [False], [True], [False]])
    found = misfit(residuals, sigma, rejected, "m/s", 0.1)
    # Uniform over 20 m/s, one in a hundred: 2 log 2000.
    expected = 2.0 * (1.0 + np.log(2.0 * np.pi * 0.1**2)) + 2.0 * np.log(2000.0)
    assert found == pytest.approx(expected)
    assert found < misfit(residuals, sigma, np.zeros_like(rejected), "m/s", 0.1)


def test_gross_errors_are_worth_their_rejection_and_halves_of_honest_noise_are_not():
    rng = np.random.default_rng(1)
    sigma = np.full((400, 1), 0.1)
    honest = rng.normal(0.0, 1.0, (400, 1))
    gross = honest.copy()
    gross[::40] += 100.0
    # Truncated, the smaller half has a tenth of the noise, and all of the larger is beyond it.
    mixed = honest * np.where(np.arange(400)[:, None] % 2, 0.1, 1.0)
    for residuals, out, pays in (
        (gross, np.abs(gross) > 10.0, True),
        (mixed, np.abs(mixed) > 0.4, False),
    ):
        none = np.zeros_like(out)
        with_all = misfit(residuals, sigma, none, "m/s", 0.01)
        assert (misfit(residuals, sigma, out, "m/s", 0.01) < with_all) == pays


def test_rejecting_everything_never_pays_as_noise_goes_to_zero():
    """The price is in absolute units: it does not fall with the noise of the others.

    Of all that is rejected, what persists is as likely as steps of honest noise, and no more.
    """
    residuals = np.random.default_rng(2).normal(0.0, 1.0, (400, 1))
    sigma = np.full((400, 1), 1e-3)
    costs = [
        misfit(residuals, sigma, np.abs(residuals) > limit, "m", None)
        for limit in (np.inf, 1.0, 0.1, 0.01)
    ]
    assert min(costs[1:]) > costs[0]


def test_persistent_misfit_by_hand():
    """Two steps, of 1 and -2 m/s, each with the noise of two measurements of 0.1 m/s."""
    residuals = np.array([[0.0], [10.0], [np.nan], [-10.0]])
    sigma = np.full((4, 1), 0.1)
    spread = 0.1 * np.sqrt(2.0)
    expected = (1.0 + 4.0) / spread**2 + 2.0 * np.log(2.0 * np.pi * spread**2)
    assert persistent_misfit(residuals, sigma, None) == pytest.approx(expected)


def test_a_jump_is_worth_its_rejection_and_a_slow_error_is_not():
    """Both leave the rest larger than their steps; the jump has but two steps."""
    white = np.random.default_rng(3).normal(0.0, 0.3, (400, 1))
    sigma = np.full((400, 1), 0.1)
    jump, slow = white.copy(), white.copy()
    jump[100:200] += 30.0
    slow += 30.0 * np.sin(np.linspace(0.0, 6.0, 400))[:, None]
    for residuals, pays in ((jump, True), (slow, False)):
        out = np.abs(residuals) > 10.0
        rejecting = misfit(residuals, sigma, out, "m/s", 0.1)
        honest = min(
            misfit(residuals, sigma, np.zeros_like(out), "m/s", 0.1),
            persistent_misfit(residuals, sigma, 0.1),
        )
        assert (rejecting < honest) == pays
