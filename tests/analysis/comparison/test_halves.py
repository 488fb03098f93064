"""The halves of a trial against each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_solution, build_trial
from scipy.stats import chi2

from factorgraph_dvl.analysis.comparison.halves import compare_halves, halves_of
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.quality.finding import Code

SIGMA = np.array([5.0, 5.0, 5.0, 0.1])
TRUTH = np.array([1.0, 2.0, 3.0, 0.005])


def half(prior, data, information):
    """A half whose data have some information, with a prior that both halves share."""
    P = np.linalg.inv(np.diag(SIGMA**-2) + information)
    value = P @ (SIGMA**-2 * prior + information @ data)
    std = np.sqrt(np.diag(P))
    solution = build_solution(covariance=P)
    own = np.split(np.arange(4), [3])
    estimates = tuple(
        replace(e, value=value[i], std=std[i], prior_std=SIGMA[i])
        for e, i in zip(solution.estimates, own, strict=True)
    )
    return replace(solution, estimates=estimates)


def drawn(rng, change=0.0):
    """Two halves of an honest trial, with a change of the last component; 2 tells less."""
    prior = TRUTH + SIGMA * rng.normal(size=4)
    informed = np.diag([1e4, 1e4, 1e-9, 1e6]), np.diag([1e4, 0.04, 1e-9, 1e4])
    return [
        half(
            prior,
            TRUTH + k * change * np.eye(4)[3] + rng.normal(size=4) / np.sqrt(np.diag(own)),
            own,
        )
        for k, own in enumerate(informed)
    ]


def test_the_statistic_is_chi_square_though_the_prior_is_shared():
    rng = np.random.default_rng(0)
    found = [compare_halves(build_trial(), *drawn(rng)) for _ in range(300)]
    assert {h.freedom for h in found} == {3}
    low, high = chi2.ppf([0.001, 0.999], 900) / 300
    assert low < np.mean([h.statistic for h in found]) < high
    z = np.array([h.difference / h.std for h in found])[:, [0, 1, 3]]
    np.testing.assert_allclose(np.mean(z**2, axis=0), 1.0, atol=0.35)
    assert sum(bool(h.findings()) for h in found) <= 2


def test_a_change_between_the_halves_is_named():
    halves = compare_halves(build_trial(), *drawn(np.random.default_rng(1), change=0.2))
    (finding,) = halves.findings()
    assert (finding.code, finding.severity) == (Code.HALVES_DIFFER, "error")
    assert "scale_error" in finding.text
    assert halves.columns()["difference"][3] == pytest.approx(0.2, abs=0.05)


def test_a_trial_is_cut_in_the_middle():
    trial = build_trial(seconds=20.0)
    first, second = halves_of(trial)
    for record, a, b in zip(
        (trial.imu, *trial.aids), (first.imu, *first.aids), (second.imu, *second.aids), strict=True
    ):
        np.testing.assert_array_equal(np.concatenate([a.time, b.time]), record.time)
    assert first.imu.time[-1] < second.imu.time[0] == pytest.approx(10.02, abs=0.03)
    assert first.initial_attitude is trial.initial_attitude
    assert second.initial_attitude is None
    assert second.initial_position is None
    with pytest.raises(ConfigError, match="where the second half starts"):
        halves_of(replace(trial, gnss=None))
