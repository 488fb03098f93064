"""Where the minimisation of a long trial starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import config

from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import stretch
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu
from factorgraph_dvl.solvers.rounds import settle
from factorgraph_dvl.solvers.stretch import started_from_stretch


def silent(*_):
    pass


@pytest.fixture(scope="module")
def prepared():
    trial = simulate(config("ship"), 1)
    return prepare_without_imu(trial.until(trial.dvl.time[0] + 900.0))


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(stretch, "_LENGTH", 240.0)


def test_a_short_trial_starts_by_itself(prepared):
    assert started_from_stretch(prepared, silent) is prepared


@pytest.mark.slow
def test_a_stretch_leads_to_the_same_answer(prepared, short):
    started = started_from_stretch(prepared, silent)
    assert np.all(started.first_chain.density != prepared.first_chain.density, axis=1).any()
    one, other = (settle(each, each.states, silent) for each in (prepared, started))
    assert one.settled
    assert other.settled
    found, there = (each.minimum.evaluation.parameters for each in (one, other))
    for name in ("lever_arm_m", "scale_error", "time_offset_s"):
        P = one.minimum.information.covariance_of(
            [{one.problem.key(name): np.eye(found[name].size)}]
        )
        sigma = np.sqrt(np.diag(P))
        assert np.all(np.abs(found[name] - there[name]) < 0.2 * sigma)
    assert other.minimum.iterations < one.minimum.iterations


def test_where_a_sensor_is_silent_a_trial_starts_by_itself(prepared, short):
    trial = prepared.trial
    time = prepared.first_chain.node_time
    ends = (trial.gnss.time < time[0] + 60.0) | (trial.gnss.time > time[-1] - 60.0)
    gnss = rows_of(trial.gnss, ends)
    silent_inside = replace(prepared, trial=replace(trial, gnss=gnss))
    assert started_from_stretch(silent_inside, silent) is silent_inside
