"""Sensors by the clock of another one: what is known of their offsets together."""

from __future__ import annotations

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.graph.priors import add_priors, prior_root
from factorgraph_dvl.sensors.attitude import AttitudeSettings
from factorgraph_dvl.sensors.clock import Clock, ClockSection, on_shared_clocks


def sensor(section, settings, prefix=""):
    clock = Clock.of(section, prefix=prefix)
    return SimpleNamespace(
        section=section, settings=settings, parameters=lambda: clock.parameters(settings)
    )


def aids(**attitude):
    dvl = ClockSection(file="dvl.csv", time_offset_s=0.3, time_offset_std_s=2.0)
    own = AttitudeSettings(clock="dvl", time_offset_std_s=0.5, **attitude)
    return [sensor("dvl", dvl), sensor("attitude", own, "attitude_")]


def offsets(every):
    shared = on_shared_clocks((p for aid in every for p in aid.parameters()), every)
    return [p for p in shared if p.stem.endswith("time_offset")]


def test_offset_of_a_shared_clock_follows_that_of_its_sensor():
    """Covariance by hand: 2² of the DVL, in both, and 0.5² more of the attitudes."""
    root = prior_root(offsets(aids(time_offset_s=0.1)))
    np.testing.assert_allclose(root @ root.T, [[4.0, 4.0], [4.0, 4.25]])
    assert offsets(aids(time_offset_s=0.1))[1].mean[0] == pytest.approx(0.4)


def test_cost_counts_the_difference_of_shared_clocks():
    """1 s beside 0.3 ± 2 s, and 2.5 s: 0.5 (0.35² + (1.5 / 0.5)²)."""
    both, graph = offsets(aids()), gtsam.NonlinearFactorGraph()
    add_priors(graph, both, {p.name: i for i, p in enumerate(both)})
    values = gtsam.Values()
    values.insert(0, np.array([1.0]))
    values.insert(1, np.array([2.5]))
    assert graph.error(values) == pytest.approx(0.5 * (0.35**2 + 3.0**2))


def test_shared_clock_that_is_known_leaves_its_own_prior():
    dvl = ClockSection(file="dvl.csv", time_offset_s=0.3)
    every = [sensor("dvl", dvl), aids()[1]]
    known, own = offsets(every)
    assert known.sigma[0] == 0.0
    assert own.sigma[0] == 0.5
    assert own.mean[0] == pytest.approx(0.3)


@pytest.mark.parametrize("name", ["sonar", "attitude"])
def test_clock_that_no_other_sensor_has_is_refused(name):
    own = AttitudeSettings(clock=name)
    with pytest.raises(ConfigError, match="clock of its own") as error:
        offsets([aids()[0], sensor("attitude", own, "attitude_")])
    assert "attitude.clock" in str(error.value)
    assert "dvl" in str(error.value)
