"""Ranges of an LBL net that are not those to its transponders are named before a solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import config

import factorgraph_dvl as fd
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.plausibility.survey import accepted_errors
from factorgraph_dvl.quality.finding import Code


@pytest.fixture(scope="module")
def trial():
    return fd.simulate(config("dive-lbl", imu={"rate_hz": 20}), seed=1)


def changed(trial, **changes):
    beacons = replace(trial.beacons, **changes)
    others = tuple(beacons if a is trial.beacons else a for a in trial.others)
    return replace(trial, others=others)


def found(trial, **changes):
    findings = fd.survey(changed(trial, **changes)).findings
    return [f for f in findings if f.code == Code.BEACON_RANGES]


def renamed(trial, **names):
    return np.array([names.get(str(n), str(n)) for n in trial.beacons.name])


def test_ranges_that_are_right_have_no_finding(trial):
    assert found(trial) == []


def test_transponders_taken_for_each_other_are_named(trial):
    first, second = found(trial, name=renamed(trial, T1="T2", T2="T1"))
    assert first.severity == second.severity == "error"
    assert "ranges to T1" in str(first)
    assert "they are those to T2" in str(first)
    assert "they are those to T1" in str(second)


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (1500.0, "is a travel time in s"),
        (750.0, "is a travel time there and back in s"),
        (1.5, "is a travel time in ms"),
        (0.75, "is a travel time there and back in ms"),
    ],
)
def test_times_in_place_of_ranges_are_named(trial, factor, says):
    named = found(trial, range=trial.beacons.range / factor)
    assert len(named) >= 2
    assert all(f.severity == "error" and says in str(f) for f in named)


def test_a_beacon_far_from_its_place_is_a_warning(trial):
    longer = np.where(trial.beacons.name == "T3", 400.0, 0.0)
    (finding,) = found(trial, range=trial.beacons.range + longer)
    assert finding.severity == "warning"
    assert "ranges to T3" in str(finding)


@pytest.mark.parametrize(
    ("swapped", "factor", "says"),
    [
        ({"T1": "T2", "T2": "T1"}, 1.0, "they are those to T2"),
        ({}, 1.5, "is a travel time in ms"),
    ],
)
def test_a_mistake_is_refused_with_its_reason(trial, swapped, factor, says):
    beacons = trial.beacons
    spoilt = changed(trial, name=renamed(trial, **swapped), range=beacons.range / factor)
    with pytest.raises(DataError, match=says) as refused:
        fd.solve(spoilt)
    assert "--anyway" in str(refused.value)
    accepted = accepted_errors(fd.survey(spoilt), anyway=True)
    assert any(says in str(error) for error in accepted)


def test_without_fixes_nothing_is_compared(trial):
    assert found(replace(trial, gnss=None)) == []
