"""White and Gauss-Markov noise told apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from factorgraph_dvl.simulation.faults import gauss_markov
from factorgraph_dvl.statistics import correlation
from factorgraph_dvl.statistics.correlation import Correlation, fit_correlation


def residuals(time, white, correlated, tau, seed=0):
    rng = np.random.default_rng(seed)
    noise = np.sqrt(white) * rng.standard_normal((time.size, 2))
    return noise + np.sqrt(correlated) * gauss_markov(time, tau, 2, rng)


@pytest.mark.parametrize(("white", "correlated", "tau"), [(0.5, 0.5, 2.0), (0.3, 0.7, 10.0)])
def test_parts_and_time_are_found(white, correlated, tau):
    time = np.arange(6000) * 0.2
    found = fit_correlation(time, residuals(time, white, correlated, tau))
    assert found.white == pytest.approx(white, rel=0.1)
    assert found.correlated == pytest.approx(correlated, rel=0.25)
    assert found.time_s == pytest.approx(tau, rel=0.3)
    assert found.gain > 1000.0


def test_a_short_trial_takes_the_time_that_is_expected():
    time = np.arange(2250) * 0.2
    rates = []
    for seed in range(6):
        data = residuals(time, 0.3, 0.7, 100.0, seed)
        found = fit_correlation(time, data, expected_time_s=100.0)
        assert found.white == pytest.approx(0.3, rel=0.1)
        # Only the rate of the random walk is seen, 2 c / tau.
        rates.append(2.0 * found.correlated / found.time_s)
    assert np.exp(np.mean(np.log(rates))) == pytest.approx(0.014, rel=0.4)


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_is_white(seed):
    time = np.arange(2250) * 0.2
    assert fit_correlation(time, residuals(time, 1.0, 0.0, 1.0, seed)) is None
    assert (
        fit_correlation(time, residuals(time, 1.0, 0.0, 1.0, seed), expected_time_s=100.0) is None
    )


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_persists_for_less_than_an_interval_takes_no_long_search(monkeypatch, seed):
    taken = []

    def counted(*args, **kwargs):
        fit = minimize(*args, **kwargs)
        taken.append(fit.nfev)
        return fit

    monkeypatch.setattr(correlation, "minimize", counted)
    noise = np.random.default_rng(seed).standard_normal((5001, 2))
    time = np.arange(5000) * 0.2
    # White noise and such a process have the same spectrum: only one of them is searched.
    found = fit_correlation(time, noise[1:] + 0.08 * noise[:-1])
    assert found is not None
    assert found.long_run_factor(0.2) == pytest.approx(1.0, abs=1e-3)
    assert sum(taken) < 200


def test_drift_is_no_correlation():
    time = np.arange(2250) * 0.2
    data = residuals(time, 1.0, 0.0, 1.0) + 5.0 * np.sin(time / 150.0)[:, None]
    assert fit_correlation(time, data) is None


def test_a_minute_shows_that_noise_persists_but_hardly_for_how_long():
    """Without an expected time, one that is as long as the record explains it as well."""
    time = np.arange(225) * 0.2
    for seed in range(20):
        found = fit_correlation(time, residuals(time, 0.5, 0.5, 2.0, seed), expected_time_s=2.0)
        assert 0.5 < found.time_s < 10.0
        assert found.gain > 20.0


def test_gaps_are_left_out():
    time = np.arange(6000) * 0.2
    data = residuals(time, 0.5, 0.5, 2.0)
    data[1000:1300] = np.nan
    kept = np.ones(time.size, dtype=bool)
    kept[3000:3200] = False
    found = fit_correlation(time[kept], data[kept])
    assert found.white == pytest.approx(0.5, rel=0.15)
    assert found.time_s == pytest.approx(2.0, rel=0.4)
    assert fit_correlation(time[:50], data[:50]) is None


def test_the_long_run_factor_is_that_of_a_mean():
    fit = Correlation(white=0.5, correlated=0.5, time_s=2.0, gain=100.0)
    time = np.arange(200_000) * 0.2
    data = residuals(time, 0.5, 0.5, 2.0)
    means = data.reshape(400, 500, 2).mean(axis=1)
    assert fit.long_run_factor(0.2) == pytest.approx(means.var() * 500, rel=0.15)
