"""Measurements of one segment."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.sensor_factor import NodeMeasurements, bind
from factorgraph_dvl.replay.gate import InnovationGate
from factorgraph_dvl.replay.measurements import gated


def bound_to(started, aids, seg):
    start = started.start
    p_n = start.values.atNavState(keys.node(start.node)).position()
    values = {p.name: np.eye(3) if p.rotation else p.mean for p in start.all_parameters}
    gravity = start.frame.gravity_without_rotation(p_n[None])
    chain = start.chain.following(seg, gravity, start.node)
    observations = [o for aid in aids for o in aid.observations(start.frame, start.body_axes)]
    bound, _ = bind(chain, observations, start.parameters, {}, values, start.clock_zero)
    return NodeMeasurements.of(bound, start.parameters, start.fixed)


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
    jacobian = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    P = np.diag([9.0, 4.0])
    sigma = np.array([4.0, 3.0, 4.0, np.inf, 1.0])
    residual = np.array([5.0, 10.0, 500.0, 7.0, 0.1])
    weights, innovations, findings = gated(
        SimpleNamespace(bound=rows), residual, jacobian, sigma, P, InnovationGate()
    )
    np.testing.assert_allclose(innovations[0].sigma, [[5.0, 5.0], [5.0, np.nan]])
    np.testing.assert_allclose(innovations[0].residual, [[5.0, 10.0], [500.0, np.nan]])
    assert innovations[0].used.tolist() == [True, False]
    np.testing.assert_allclose(weights[0], [[0.25, 1.0 / 3.0], [0.0, 0.0]])
    np.testing.assert_allclose(innovations[1].sigma, [[np.sqrt(14.0)]])
    np.testing.assert_allclose(weights[1], [[1.0]])
    assert not findings
