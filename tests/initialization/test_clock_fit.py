"""The fit of a clock's parameters to velocities beside the carried IMU."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.initialization.clock_fit import fit_clock, variances, window_misfits


class Turns:
    """Twelve windows of 30 s at 5 Hz, of which two turn; a clock is 0.1 s late throughout."""

    noise = 0.1
    late = 0.1

    def __init__(self, noise):
        self.time = 30.0 * np.arange(12)[:, None] + 0.2 * np.arange(150)
        self.inside = np.ones(self.time.shape, dtype=bool)
        self.count = np.full(12, 3.0 * 147)
        since = np.vander(np.arange(150.0), 3)
        self._basis = np.linalg.qr(since)[0]
        at = np.arange(150)[:, None] * 0.2 / 30.0 * 2.0 * np.pi
        self.slope = np.zeros((*self.time.shape, 3))
        self.slope[[4, 9]] = np.concatenate([np.cos(2.0 * at), np.sin(3.0 * at), 0.0 * at], axis=1)
        self._noise = self._detrended(noise)
        self.slope = self._detrended(self.slope)

    def _detrended(self, values):
        return values - self._basis @ (self._basis.T @ values)

    def residual(self, offset):
        return self._noise + self.slope * (self.late - offset * np.ones_like(self.time))[..., None]


def correlated(rng, share):
    """Noise of 0.1 m/s, a share of whose variance is correlated over 2 s."""
    phi = np.exp(-0.1)
    out = rng.normal(size=(150, 12, 3))
    for k in range(1, 150):
        out[k] = phi * out[k - 1] + np.sqrt(1.0 - phi**2) * out[k]
    white = rng.normal(size=out.shape)
    return 0.1 * (np.sqrt(share) * out + np.sqrt(1.0 - share) * white).transpose(1, 0, 2)


def fitted(noise):
    turns = Turns(noise)
    return fit_clock(turns, np.ones((12, 150, 1)), np.zeros(1))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_standard_deviations_hold_whether_noise_is_correlated_or_not(share):
    rng = np.random.default_rng(3)
    fits = [fitted(correlated(rng, share)) for _ in range(200)]
    z = [(fit.values[0] - Turns.late) / fit.sigma[0] for fit in fits]
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_white_noise_is_not_inflated():
    inflation = [
        fitted(correlated(np.random.default_rng(seed), 0.0)).inflation for seed in range(20)
    ]
    assert np.mean(inflation) < 1.3


def test_a_gain_counts_the_windows_that_are_asked_for():
    turns = Turns(correlated(np.random.default_rng(1), 0.5))
    design = np.stack([np.ones((12, 150)), np.arange(12)[:, None] > 4 + np.zeros(150)], axis=-1)
    constant = fit_clock(turns, design[..., :1], np.zeros(1))
    jump = fit_clock(turns, design, np.zeros(2))
    every = np.ones(12, dtype=bool)
    parts = [jump.gain(constant, np.arange(12) == k) for k in range(12)]
    assert jump.gain(constant, every) == pytest.approx(sum(parts))
    assert jump.gain(constant, ~every) == 0.0
    assert not jump.better_than(constant, every)


def test_a_misfit_is_that_of_the_mean_square():
    """Of a window of squares 0.04 m²/s² in the mean: 441 / 2 ln(0.04 + 1e-6)."""
    turns = Turns(np.zeros((12, 150, 3)))
    residual = np.full((12, 150, 3), 0.2 * np.sqrt(441.0 / 450.0))
    np.testing.assert_allclose(variances(turns, residual), 0.040001)
    np.testing.assert_allclose(window_misfits(turns, residual), 220.5 * np.log(0.040001))
