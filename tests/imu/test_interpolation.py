"""Rate and force at any time, as smooth as the noise asks for."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.imu import interpolation
from factorgraph_dvl.imu.interpolation import best_window, smooth, smoothed_share, unsmoothed

DT = 0.01
TIME = np.arange(0.0, 10.0, DT)


def noise(sigma):
    return np.random.default_rng(2).normal(0.0, sigma, (TIME.size, 3))


def test_the_more_motion_the_narrower_the_window():
    white = noise(1e-3)
    slow, fast = (np.sin(2 * np.pi * f * TIME)[:, None] * np.ones(3) + white for f in (0.2, 4.0))
    assert best_window(white, DT, 1e-3) == 51
    assert best_window(white, DT, 1e-3) >= best_window(slow, DT, 1e-3)
    assert best_window(slow, DT, 1e-3) > best_window(fast, DT, 1e-3)
    assert best_window(fast - white, DT, 1e-9) == 0


@pytest.mark.parametrize("count", [TIME.size, 200])
def test_a_cubic_is_left_as_it_is(count):
    """Also by the matrices that are kept for short signals."""
    time = TIME[:count]
    values = np.stack([1.0 + 0.0 * time, 2.0 * time, time**3], axis=1)
    found = smooth(time, values, DT, 1e-3, averaged=False, window=11)
    at = np.array([0.5, 1.234])
    value, slope, misfit = found.at(at)
    np.testing.assert_allclose(value, np.stack([[1, 1], 2 * at, at**3], axis=1), atol=1e-9)
    np.testing.assert_allclose(slope[:, 2], 3 * at**2, atol=1e-6)
    np.testing.assert_array_equal(misfit, 0.0)


def test_a_sway_that_goes_on_keeps_its_size_under_noise_and_beside_steps():
    """Lever arms of a DVL are as much too long as the rate of the sway is too small."""
    rng = np.random.default_rng(3)
    time = DT * np.arange(40_000)
    sway = 0.88 * np.sin(4.0 * np.pi * time)[:, None] * np.ones(3)
    steps = np.where((time > 100.0) & (time < 120.0), 0.2, 0.0)[:, None]
    values = sway + steps + 2.6e-3 * rng.standard_normal(sway.shape)
    window = best_window(values, DT, 2.6e-3)
    found = smooth(time, values, DT, 2.6e-3, averaged=False, window=window)
    left = found.spline(time) - values
    assert window > 5
    assert abs(np.sum(left * sway) / np.sum(sway**2)) < 3e-4


@pytest.mark.parametrize("averaged", [True, False])
def test_a_long_signal_is_smoothed_in_parts_as_in_one(monkeypatch, averaged):
    time = DT * np.arange(2_100)
    values = np.random.default_rng(4).normal(0.0, 1.0, (time.size, 3)) + np.sin(time)[:, None]
    values[700:] += 30.0
    found = []
    for size in (time.size, 500):
        monkeypatch.setattr(interpolation, "_AT_ONCE", size)
        found.append(smooth(time, values, DT, 1.0, averaged=averaged, window=17))
    whole, parts = found
    for signal in ("spline", "misfit"):
        one, other = getattr(whole, signal), getattr(parts, signal)
        np.testing.assert_array_equal(other.t, one.t)
        np.testing.assert_allclose(other.c, one.c, rtol=0.0, atol=1e-14)
    assert whole.misfit.c.any()


def test_means_are_corrected_to_the_value_at_the_middle():
    # The mean of t² over an interval exceeds its middle's by dt² / 12.
    values = np.repeat((TIME**2 + DT**2 / 12.0)[:, None], 3, axis=1)
    found = smooth(TIME, values, DT, 1e-3, averaged=True, window=11)
    np.testing.assert_allclose(found.at(np.array([5.0]))[0], 25.0, rtol=1e-12)


def test_the_noise_that_is_left_is_as_stated():
    found = smooth(TIME, noise(1e-3), DT, 1e-3, averaged=False, window=51)
    value, slope, _ = found.at(TIME[60:-60])
    assert np.std(value) == pytest.approx(found.sigma, rel=0.25)
    assert np.std(slope) == pytest.approx(found.slope_sigma, rel=0.25)
    assert found.sigma < 0.25e-3


@pytest.mark.parametrize("length", [0.05, 0.1, 0.2, 0.305, 1.0])
def test_means_have_the_noise_of_one_value(length):
    """With the share of the smoothed signal; those of many samples have less by themselves."""
    time = np.arange(0.0, 400.0, DT)
    white = np.random.default_rng(3).normal(0.0, 1e-3, (time.size, 3))
    found = smooth(time, white, DT, 1e-3, averaged=False, window=51)
    ends = np.arange(3.0, 397.0, 0.1)[:, None] + 0.5 * length * np.array([-1.0, 1.0])
    # Samples are values at their times: half of an interval before and after belongs to each.
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(white * DT, axis=0)])
    edges = np.append(time - 0.5 * DT, time[-1] + 0.5 * DT)
    angle = np.stack([np.interp(ends, edges, each) for each in total.T], axis=2)
    raw = (angle[:, 1] - angle[:, 0]) / length
    smoothed = (found.integral(ends[:, 1]) - found.integral(ends[:, 0])) / length
    share, slope, sigma = smoothed_share(51, np.array([length / DT]))
    mean = (1.0 - share) * raw + share * smoothed
    assert np.std(mean) == pytest.approx(1e-3 * sigma[0], rel=0.05)
    if length < 0.2:
        assert sigma[0] * 1e-3 == pytest.approx(found.sigma)
        assert 0.0 < share[0] < 1.0
        later = smoothed_share(51, np.array([length / DT + 0.5]))[0]
        assert slope[0] == pytest.approx(2.0 * (later[0] - share[0]), rel=0.1)
    if length > 0.3:
        assert share[0] == 0.0


def test_a_step_is_named_as_not_resolved():
    values = np.where(TIME < 5.0, 0.0, 1.0)[:, None] * np.ones(3)
    found = smooth(TIME, values, DT, 1e-3, averaged=False, window=25)
    misfit = found.at(np.array([2.0, 4.9, 4.995, 5.0, 5.1, 8.0]))[2]
    assert misfit[3].min() > 0.1
    np.testing.assert_allclose(misfit[2], found.at(np.array([4.99, 5.0]))[2].mean(axis=0))
    assert misfit[[0, -1]].max() == 0.0
    # Nothing is kept where there is nothing, or where nobody asks.
    assert found.misfit.c.shape[0] < 50
    assert smooth(TIME, 0.0 * values, DT, 1e-3, averaged=False, window=25).misfit is None
    alone = smooth(TIME, values, DT, 1e-3, averaged=False, window=25, with_misfit=False)
    assert alone.misfit is None
    np.testing.assert_array_equal(alone.spline.c, found.spline.c)


def test_samples_that_are_left_alone_have_their_own_noise():
    assert unsmoothed(DT, 1e-3).spline is None
    assert unsmoothed(DT, 1e-3).slope_sigma == pytest.approx(0.2)
    assert smooth(TIME[:5], noise(1.0)[:5], DT, 1.0, averaged=False, window=11).window == 0
