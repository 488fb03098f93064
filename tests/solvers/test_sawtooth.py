"""Delays that rise and fall back: found by their scores, named, and taken out."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.sensors.clock import Clock
from factorgraph_dvl.solvers.sawtooth import best_sawtooth

CLOCK = Clock.of("dvl")


def values(delay, period, start):
    return {
        "time_offset_s": np.zeros(1),
        "dvl_clock_rate_ppm": np.zeros(1),
        "dvl_sawtooth_delay_s": np.array([delay]),
        "dvl_sawtooth_s": np.array([period, start]),
    }


def test_a_delay_rises_within_a_period_and_falls_back():
    """0.2 s in 10 s: from -0.1 s at the start to 0.1 s, by hand."""
    time = np.array([3.0, 5.5, 8.0, 12.999, 13.0])
    lag = CLOCK.lag(time, values(0.2, 10.0, 3.0), 0.0)
    np.testing.assert_allclose(lag, [-0.1, -0.05, 0.0, 0.09998, -0.1], atol=1e-12)
    # Linear in the delay.
    by = CLOCK.by_parameters(time, values(0.0, 10.0, 3.0), 0.0)["dvl_sawtooth_delay_s"]
    np.testing.assert_allclose(0.2 * by, lag, atol=1e-12)


def test_without_a_period_there_is_no_delay():
    time = np.linspace(0.0, 10.0, 5)
    assert not CLOCK.lag(time, values(0.2, 0.0, 0.0), 0.0).any()


@pytest.mark.parametrize("period", [3.7, 10.0, 45.0])
def test_scores_show_period_and_start(period):
    """Of 1 m/s² and 0.01 m/s white noise, the score on a delay d is w d and noise of √w."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 450.0, 0.2)
    w = 1e4 * np.cos(0.7 * time) ** 2
    delay = 0.05 * (np.mod((time - 1.3) / period, 1.0) - 0.5)
    found = best_sawtooth(time, w * delay + np.sqrt(w) * rng.standard_normal(time.size), w)
    assert found is not None
    assert found.period == pytest.approx(period, rel=2e-3)
    away = np.mod((found.start - 1.3) / found.period + 0.5, 1.0) - 0.5
    assert abs(away) < 0.02
    assert found.fall == pytest.approx(np.sum(w * delay**2), rel=0.15)


def test_noise_pays_for_the_search():
    """The best of all periods and starts takes off hardly more than they cost, in 19 of 20."""
    rng = np.random.default_rng(2)
    time = np.arange(0.0, 450.0, 0.2)
    w = np.full(time.size, 1e4)
    falls = []
    for _ in range(100):
        found = best_sawtooth(time, np.sqrt(w) * rng.standard_normal(time.size), w)
        assert found is not None
        falls.append(found.fall - 2.0 * np.log(found.tried))
    assert np.quantile(falls, 0.95) < 3.0


def test_a_few_measurements_show_none():
    assert best_sawtooth(np.arange(10.0), np.ones(10), np.ones(10)) is None


def test_a_clock_that_jumps_by_years_shows_none():
    time = np.append(np.arange(100.0), 1.3e9 + np.arange(100.0))
    assert best_sawtooth(time, np.ones(200), np.ones(200)) is None
