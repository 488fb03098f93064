"""A prior against the data alone, and an earlier calibration against a trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import build_solution, build_trial
from scipy.stats import chi2

from factorgraph_dvl.plausibility.earlier_calibration import prior_against_data, prior_findings
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.results import consistency_findings
from factorgraph_dvl.sensors.parameters import JointPrior


def combined(prior, P0, data, information):
    """The posterior of a prior and of data with some information."""
    P = np.linalg.inv(np.linalg.inv(P0) + information)
    return P @ (np.linalg.solve(P0, prior) + information @ data), P


def test_what_the_data_say_alone_is_found_again():
    rng = np.random.default_rng(0)
    root, other = rng.normal(size=(2, 4, 4))
    P0, Pd = root @ root.T, other @ other.T
    prior, data = rng.normal(size=(2, 4))
    value, P = combined(prior, P0, data, np.linalg.inv(Pd))
    test = prior_against_data(prior, P0, value, P)
    assert test.freedom == 4
    assert test.statistic == pytest.approx((data - prior) @ np.linalg.solve(P0 + Pd, data - prior))
    np.testing.assert_allclose(test.value, data, rtol=1e-6)
    np.testing.assert_allclose(test.std, np.sqrt(np.diag(Pd)), rtol=1e-6)


def test_directions_that_the_data_do_not_tell_are_left_out():
    P0 = np.diag([4.0, 9.0])
    value, P = combined(np.zeros(2), P0, np.array([1.0, 0.0]), np.diag([1.0, 0.0]))
    test = prior_against_data(np.zeros(2), P0, value, P)
    assert test.freedom == 1
    assert test.statistic == pytest.approx(1.0 / 5.0)
    np.testing.assert_allclose(test.std, [1.0, np.inf])


def test_the_statistic_is_chi_square_of_honest_priors():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    P0, information = root @ root.T, np.diag([2.0, 0.5, 0.0])
    found = []
    for _ in range(400):
        prior = root @ rng.normal(size=3)
        data = rng.normal(size=3) / np.sqrt([2.0, 0.5, 1.0])
        found.append(prior_against_data(prior, P0, *combined(prior, P0, data, information)))
    assert {test.freedom for test in found} == {2}
    mean = np.mean([test.statistic for test in found])
    low, high = chi2.ppf([0.001, 0.999], 800) / 400
    assert low < mean < high


@pytest.mark.parametrize(("apart", "severity"), [(1.0, None), (4.0, "warning"), (7.6, "error")])
def test_an_earlier_calibration_is_contradicted(apart, severity):
    # 0.0002 ± 0.0003 against 0.0053 ± 0.0006 gave 0.0013 ± 0.0003 without a word.
    prior, P0 = np.array([2e-4]), np.array([[9e-8]])
    data = prior + apart * np.hypot(3e-4, 6e-4)
    value, P = combined(prior, P0, data, np.array([[1.0 / 36e-8]]))
    trial = build_trial()
    trial = replace(
        trial, dvl=replace(trial.dvl, prior=JointPrior("old", {"scale_error": prior}, P0))
    )
    scale = replace(build_solution().estimates[1], value=value, std=np.sqrt(np.diag(P)))
    found = list(prior_findings(trial, [scale], P))
    assert [f.severity for f in found] == ([severity] if severity else [])
    if severity == "error":
        assert found[0].code == Code.PRIOR_CONTRADICTED
        assert found[0].parameter == "scale_error"
        for said in ("old", "0.0002 ± 0.0003", "0.0053 ± 0.0006", "0.0012 ± 0.0003"):
            assert said in found[0].text


@pytest.mark.parametrize(
    ("value", "std", "severity"),
    [
        # The data outweigh a prior that is six standard deviations off, or are drawn by it.
        (0.006, 1e-5, "warning"),
        (0.0045, 5e-4, "error"),
        (0.004, 1e-5, None),
        # Half of what the prior knew, and half of the way: seven standard deviations apart.
        (0.00495, 7.07e-4, "error"),
    ],
)
def test_a_value_far_from_its_stated_prior_is_a_reason(value, std, severity):
    scale = build_solution().estimates[1]
    scale = replace(
        scale, value=np.array([value]), std=np.array([std]), prior_std=np.array([1e-3])
    )
    found = consistency_findings([scale], [])
    assert [(f.code, f.severity) for f in found] == (
        [(Code.FAR_FROM_PRIOR, severity)] if severity else []
    )
