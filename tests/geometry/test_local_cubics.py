"""Local cubics: exact on cubics, and what they leave of noise."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.geometry.local_cubics import local_cubics, smoothed_arcs, wave_width


@pytest.mark.parametrize("count", [40, 400])
def test_cubics_stay_as_they_are_to_the_ends(count):
    t = np.linspace(-1.0, 1.0, count)
    values = np.column_stack([t**3 - t, 2.0 * t**2, np.ones(count)])
    np.testing.assert_allclose(local_cubics(values, 11), values, atol=1e-12)


def test_noise_falls_as_the_weights_say():
    noise = np.random.default_rng(1).standard_normal((20_000, 1))
    # Savitzky and Golay: the central weight of a cubic over 2h + 1 samples is its variance.
    h = 5
    weight = 3.0 * (3 * h**2 + 3 * h - 1) / ((2 * h - 1) * (2 * h + 1) * (2 * h + 3))
    left = local_cubics(noise, 2 * h + 1)
    assert np.var(left) == pytest.approx(weight, rel=0.06)


def test_records_are_smoothed_over_less_than_waves_and_never_across_gaps():
    assert wave_width(0.1) == 15
    assert wave_width(1.0) == 0
    time = np.concatenate([np.arange(0.0, 3.0, 0.1), np.arange(10.0, 13.0, 0.1)])
    step = np.where(time < 5.0, 0.0, 100.0)[:, None]
    np.testing.assert_allclose(smoothed_arcs(time, step, 15, 0.3), step, atol=1e-9)
