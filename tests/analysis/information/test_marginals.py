"""Posterior against prior, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

from factorgraph_dvl.analysis.information.marginals import marginals
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.quality.texts import text_of


def estimate(name, components, std, prior):
    std, prior = np.array(std, dtype=float), np.array(prior, dtype=float)
    return Estimate(
        name,
        components,
        np.zeros(std.size),
        std,
        np.zeros(std.size),
        prior,
        (prior > 0.0) & (std <= 0.5 * prior),
    )


def view(P, prior, names=("a_deg", "b_m", "c_m")):
    P, names = np.array(P, dtype=float), names[: len(P)]
    return marginals([estimate("all", names, np.sqrt(np.diag(P)), prior)], P)


def test_directions_are_generalised_eigenvectors():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    prior = np.array([2.0, 1.0, 0.5])
    P = np.linalg.inv(A @ A.T + np.diag(prior**-2))
    found = view(P, prior)
    ours = [d.information for d in found.directions]
    expected = eigh(np.linalg.inv(P), np.diag(prior**-2), eigvals_only=True)
    np.testing.assert_allclose(ours, expected, rtol=1e-9)
    np.testing.assert_allclose([d.ratio**-2 for d in found.directions], ours)
    assert ours == sorted(ours)
    np.testing.assert_allclose(np.diag(found.correlation), 1.0)


def test_two_that_cannot_be_told_apart():
    # Data that know a - 2 b to 0.01, nothing else; priors 2 deg and 1 m. In units of the
    # priors, a' = a / 2: only a' - b. Open is a' + b, with all of its prior's σ.
    prior = np.array([2.0, 1.0])
    row = np.array([[1.0, -2.0]]) / 0.01
    found = view(np.linalg.inv(row.T @ row + np.diag(prior**-2)), prior)
    weakest = found.directions[0]
    assert weakest.ratio == pytest.approx(1.0, rel=1e-6)
    np.testing.assert_allclose(np.abs(weakest.vector), [np.sqrt(0.5)] * 2, rtol=1e-4)
    assert not found.observable.any()
    (sentence,) = map(text_of, found.sentences)
    assert "a_deg and b_m cannot be separated: 100 % of the prior's σ remains" in sentence
    assert "a_deg by 1 and b_m by 0.5 change together" in sentence
    assert "only a_deg - 2 · b_m is known, to 0.01" in sentence


def test_one_that_is_not_told():
    found = view(np.diag([1.0, 1e-6]), [1.0, 1.0])
    assert tuple(map(text_of, found.sentences)) == (
        "a_deg is not determined by the data: 100 % of the prior's σ remains",
    )
    assert [d.names for d in found.directions] == [("a_deg",), ("b_m",)]


def test_several_that_are_not_told_are_named_one_by_one():
    found = view(np.diag([1e-6, 1.0, 1.0]), [1.0, 1.0, 1.0])
    assert [text_of(s).split()[0] for s in found.sentences] == ["b_m", "c_m"]


def test_two_open_combinations_of_two_components():
    # 0.9 and 0.7 of the prior's σ are left along the diagonals: neither is told.
    turn = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    found = view(turn @ np.diag([0.81, 0.49]) @ turn.T, [1.0, 1.0])
    assert [d.ratio for d in found.directions] == pytest.approx([0.9, 0.7])
    # sqrt((0.81 + 0.49) / 2) = 0.806.
    left = "is hardly determined by the data: 81 % of the prior's σ remains"
    assert tuple(map(text_of, found.sentences)) == (f"a_deg {left}", f"b_m {left}")


def test_known_but_correlated():
    P = np.array([[4.0, 1.96], [1.96, 1.0]]) * 1e-4
    found = view(P, [1.0, 1.0])
    (sentence,) = map(text_of, found.sentences)
    # a - 1.96 b: sqrt(4 - 1.96²) cm = 0.398 cm; a alone 2 cm.
    assert "hard to separate (correlation 0.980)" in sentence
    assert "a_deg - 1.96 · b_m is known to 0.004, a_deg alone to 0.02" in sentence


def test_all_is_told():
    found = view(np.diag([1e-6, 1e-6]), [1.0, 1.0])
    assert tuple(map(text_of, found.sentences)) == ()
    assert found.observable.all()


def test_what_is_held_or_without_prior_is_left_out():
    P = np.diag([1.0, 0.0, 0.04])
    found = marginals(
        [
            estimate("a_m", ("a_m",), [1.0], [np.nan]),
            estimate("b_m", ("b_m",), [0.0], [0.0]),
            estimate("c_m", ("c_m",), [0.2], [1.0]),
        ],
        P,
    )
    assert found is not None
    assert found.names == ("c_m",)
    assert marginals([estimate("b_m", ("b_m",), [0.0], [0.0])], np.zeros((1, 1))) is None
    assert marginals([], np.zeros((0, 0))) is None
