"""Measurements against their prediction."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements, bind
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import gate
from factorgraph_dvl.replay.gate import InnovationGate, _one_after_another, gated


def test_a_kind_of_outliers_is_excluded_until_it_agrees():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    used, finding = gate.accept("DVL", rng.normal(size=(50, 3)))
    assert used.all()
    assert finding is None
    used, _ = gate.accept("DVL", np.array([[7.0, 0, 0]]))
    assert not used.any()
    used, finding = gate.accept("DVL", np.full((30, 3), 8.0))
    assert not used.any()
    assert (finding.code, finding.sensor) == (Code.CONTRADICTS, "DVL")
    assert gate.excluded == {"DVL"}
    for _ in range(60):
        used, finding = gate.accept("DVL", rng.normal(size=(1, 3)))
        if finding is not None:
            break
    assert (finding.code, finding.sensor) == (Code.HEARD_AGAIN, "DVL")
    assert not gate.inconsistent


def test_an_outlier_is_rejected_and_nothing_else():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    gate.accept("GNSS", rng.normal(size=(50, 3)))
    used, finding = gate.accept("GNSS", np.array([[200.0, 0, 0]]))
    assert not used.any()
    assert finding is None
    used, _ = gate.accept("GNSS", rng.normal(size=(5, 3)))
    assert used.all()
    assert not gate.inconsistent


def test_a_kind_of_large_innovations_is_excluded_though_none_is_an_outlier():
    gate = InnovationGate()
    _, finding = gate.accept("GNSS", np.full((50, 3), 4.0))
    assert gate.excluded == {"GNSS"}
    assert "the last 50 innovations are 4.0 times as large as predicted" in finding.text


def test_innovations_that_are_too_large_are_inconsistent():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    used, finding = gate.accept("DVL", rng.normal(0.0, 2.0, (50, 3)))
    assert used.all()
    assert "too small" in finding.text
    assert gate.inconsistent == {"DVL"}


def test_echoes_are_rejected_one_by_one():
    gate = InnovationGate()
    rng = np.random.default_rng(0)
    normalised = np.where(rng.random(2000) < 0.2, 40.0, rng.normal(size=2000))
    for value in normalised:
        used, finding = gate.accept("range", np.array([[value]]), 3.5)
        assert used.all() == (abs(value) < 3.5)
        assert finding is None
    assert not gate.inconsistent
    # A clock that has jumped is another matter.
    found = [gate.accept("range", np.array([[40.0]]), 3.5)[1] for _ in range(50)]
    assert {f.code for f in found if f is not None} == {Code.CONTRADICTS}
    assert any("none are used until" in str(f) for f in found)


def bound_to(started, aids, seg):
    start = started.start
    p_n = start.values.atNavState(keys.node(start.node)).position()
    values = {p.name: np.eye(3) if p.rotation else p.mean for p in start.all_parameters}
    gravity = start.frame.gravity_without_rotation(p_n[None])
    chain = start.chain.following(seg, gravity, start.node)
    observations = [o for aid in aids for o in aid.observations(start.frame, start.body_axes)]
    bound, _ = bind(chain, observations, start.parameters, {}, start.clock_zero)
    measured = NodeMeasurements.of(bound, start.parameters, start.fixed)
    measured.attach(values)
    return measured


def test_measurements_of_one_time_share_the_motion_there(started):
    seg = started.segment(0)
    gnss, dvl = started.aids(seg)
    found = bound_to(started, [gnss, replace(dvl, time=dvl.time + 0.05)], seg)
    by_label = {b.observation.label: b for b in found.bound}
    assert by_label["GNSS position"].attachment is by_label["GNSS velocity"].attachment
    assert by_label["DVL velocity"].attachment is not by_label["GNSS velocity"].attachment
    names = {p.name for p in found.parameters}
    assert {"misalignment_deg", "scale_error", "lever_arm_m"} <= names
    assert names <= {p.name for p in started.start.parameters}


def measured(label, time, components, gate=None):
    o = SimpleNamespace(
        label=label, unit="m/s", components=components, time=np.asarray(time, float), gate=gate
    )
    return SimpleNamespace(observation=o, weight=np.ones((o.time.size, len(components))))


def test_innovations_have_the_spread_of_prediction_and_noise_and_outliers_no_weight():
    rows = (measured("a", [1.0, 2.0], ("x", "y")), measured("b", [1.5], ("z",)))
    variance = np.array([9.0, 16.0, 9.0, 16.0, 13.0])
    sigma = np.array([4.0, 3.0, 4.0, np.inf, 1.0])
    residual = np.array([5.0, 10.0, 500.0, 7.0, 0.1])
    weights, innovations, findings = gated(
        SimpleNamespace(bound=rows), residual, variance, sigma, InnovationGate()
    )
    np.testing.assert_allclose(innovations[0].sigma, [[5.0, 5.0], [5.0, np.nan]])
    np.testing.assert_allclose(innovations[0].residual, [[5.0, 10.0], [500.0, np.nan]])
    assert innovations[0].used.tolist() == [True, False]
    np.testing.assert_allclose(weights[0], [[0.25, 1.0 / 3.0], [0.0, 0.0]])
    np.testing.assert_allclose(innovations[1].sigma, [[np.sqrt(14.0)]])
    np.testing.assert_allclose(weights[1], [[1.0]])
    assert not findings


@pytest.fixture
def shared():
    """Covariance of five predictions of one component that share an error of 3 sigma."""
    return np.full((5, 5), 9.0)


def test_innovations_are_white(shared):
    rng = np.random.default_rng(1)
    root = np.linalg.cholesky(shared + np.eye(5))
    found, spread = zip(
        *(_one_after_another(root @ rng.normal(size=5), shared, (5, 1)) for _ in range(4000)),
        strict=True,
    )
    normalised = np.array(found)[..., 0] / np.array(spread)[..., 0]
    np.testing.assert_allclose(np.cov(normalised.T), np.eye(5), atol=0.08)
    # The first is predicted worst.
    assert np.all(np.diff(spread[0][:, 0]) < 0.0)


def test_an_outlier_does_not_change_what_is_predicted_next(shared):
    residual = np.array([0.5, 40.0, 0.2, -0.1, 0.3])
    found, spread = _one_after_another(residual, shared, (5, 1))
    without, _ = _one_after_another(residual[[0, 2, 3, 4]], shared[1:, 1:], (4, 1))
    assert abs(found[1, 0]) > gate._LIMIT * spread[1, 0]
    np.testing.assert_allclose(found[[0, 2, 3, 4]], without)


def test_what_was_not_measured_changes_nothing():
    """Its rows are zero."""
    covariance = np.zeros((4, 4))
    covariance[:1, :1] = covariance[2:3, 2:3] = covariance[0, 2] = covariance[2, 0] = 4.0
    found, spread = _one_after_another(np.array([1.0, 0.0, 1.0, 0.0]), covariance, (2, 2))
    np.testing.assert_allclose(found[:, 1], 0.0)
    np.testing.assert_allclose(spread[:, 1], 1.0)
    # 4/5 of the first is in the second too.
    np.testing.assert_allclose(found[1, 0], 1.0 - 0.8)
