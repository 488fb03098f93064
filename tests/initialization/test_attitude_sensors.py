"""Attitude and mounting of sensors that measure attitudes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from inertial import constant_segments

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.attitude_sensors import (
    attitude_at_start,
    attitudes,
    known_mountings,
    mean_mounting,
)
from factorgraph_dvl.initialization.dead_reckoned_spans import arc_from_start
from factorgraph_dvl.sensors.parameters import Parameter, ParameterSpec
from factorgraph_dvl.sensors.protocol import Attitudes

FRAME = LocalFrame(0.6, 2.0, 0.0)
MOUNTING = np.array([0.3, -0.5, 1.0])
SPEC = ParameterSpec("sextant_mounting", "deg", kind="rotation")


@dataclass
class Sextant:
    """An attitude sensor of which only the attitudes matter."""

    seen: Attitudes

    def attitudes(self, frame: LocalFrame) -> Attitudes:
        return self.seen


def rates(time: Array) -> Array:
    """Attitudes of the body, turned about two axes one after the other, kept in space."""
    first, second = np.clip(time, 0.0, 2.0), np.clip(time - 2.0, 0.0, None)
    return exp_so3(first[:, None] * [0.2, 0.0, 0.0]) @ exp_so3(second[:, None] * [0.0, 0.2, 0.0])


def span():
    """An arc with these rates: what it carries is the body's own attitude."""
    seg = constant_segments(5.0)
    arc = arc_from_start(seg, 0, FRAME, np.zeros((seg.node_time.size, 3)))
    return SimpleNamespace(
        start=0.0,
        since=arc.since,
        covers=lambda time: (time >= 0.0) & (time <= 4.0),
        carry=lambda time: (None, rates(time), None, None),
        to_space=lambda time: np.tile(np.eye(3), (time.size, 1, 1)),
    )


def sensor(monkeypatch, sigma, time=None):
    time = np.arange(0.0, 4.0, 0.5) if time is None else time
    sRb = exp_so3(MOUNTING)
    parameter = Parameter(SPEC, MOUNTING + 0.01, np.full(3, sigma))
    seen = Attitudes(time, rates(time) @ sRb.T, np.full(time.size, 1e-5), parameter)
    from factorgraph_dvl.initialization import attitude_sensors

    monkeypatch.setattr(attitude_sensors, "AttitudeAid", Sextant)
    return SimpleNamespace(aids=(Sextant(seen), "a sensor of something else"))


def test_a_mean_mounting_is_that_of_all_attitudes():
    nRb = rates(np.arange(4.0))
    parameter = Parameter(SPEC, MOUNTING, np.ones(3))
    off = exp_so3(np.array([[1e-3, 0, 0], [-1e-3, 0, 0], [0, 1e-3, 0], [0, -1e-3, 0]]))
    seen = Attitudes(np.arange(4.0), nRb @ off @ exp_so3(MOUNTING).T, np.ones(4), parameter)
    np.testing.assert_allclose(log_so3(mean_mounting(seen, nRb)), MOUNTING, atol=1e-6)


def test_a_sensor_without_measurements_is_left_out(monkeypatch):
    trial = sensor(monkeypatch, 1.0, np.zeros(0))
    assert attitudes(trial, FRAME) == ()


def test_turns_about_two_axes_tell_an_unknown_mounting(monkeypatch):
    found = known_mountings(sensor(monkeypatch, 3.0), FRAME, [span()])
    np.testing.assert_allclose(log_so3(found["sextant_mounting_deg"]), MOUNTING, atol=1e-9)


def test_turns_about_one_axis_do_not(monkeypatch):
    trial = sensor(monkeypatch, 3.0, np.arange(0.0, 1.9, 0.1))
    assert known_mountings(trial, FRAME, [span()]) == {}


def test_a_mounting_that_is_known_is_taken_as_it_stands(monkeypatch):
    found = known_mountings(sensor(monkeypatch, 0.01), FRAME, [])
    np.testing.assert_allclose(log_so3(found["sextant_mounting_deg"]), MOUNTING + 0.01, atol=1e-9)


def test_the_attitude_at_the_start_is_one_from_any_measurement(monkeypatch):
    trial = sensor(monkeypatch, 3.0)
    mountings = {"sextant_mounting_deg": exp_so3(MOUNTING)}
    found = attitude_at_start(trial, FRAME, span(), mountings)
    np.testing.assert_allclose(log_so3(found), 0.0, atol=1e-7)
    assert attitude_at_start(trial, FRAME, span(), {}) is None


@pytest.fixture(autouse=True)
def _no_warnings():
    with np.errstate(all="raise"):
        yield
