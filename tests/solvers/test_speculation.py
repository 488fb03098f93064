"""One process and two: the same results, whatever the test in the second one finds."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import numpy as np
import pytest
from truth import KNOWN_CLOCK, merged, scenario

from factorgraph_dvl.background import PROCESSES
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.sensors.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import speculation
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.information_along_trial import solve_with_history
from factorgraph_dvl.solvers.speculation import speculated


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(**merged({}, KNOWN_CLOCK)), 4)


@pytest.fixture
def processes(monkeypatch):
    """Set the number of processes."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return lambda count: monkeypatch.setenv(PROCESSES, str(count))


@pytest.mark.parametrize("late_s", [0.0, 0.05])
def test_one_process_and_two_find_the_same(trial, processes, late_s):
    late = replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + late_s))
    processes(1)
    one = solve(late, rate_hz=1.0)
    processes(2)
    two = solve(late, rate_hz=1.0)
    codes = [f.code for f in one.findings]
    assert (Code.ESTIMATED_INSTEAD in codes) == (late_s > 0.0)
    assert [str(f) for f in two.findings] == [str(f) for f in one.findings]
    assert two.verdict == one.verdict
    assert two.iterations == one.iterations
    for e in one.estimates:
        np.testing.assert_array_equal(two.estimate(e.name).value, e.value)
    np.testing.assert_array_equal(two.covariance, one.covariance)


@pytest.mark.parametrize("count", [1, 2])
def test_records_that_cannot_be_used_come_before_what_fails_with_them(trial, processes, count):
    processes(count)
    lost = replace(
        trial, dvl=replace(trial.dvl, velocity=np.full_like(trial.dvl.velocity, np.nan))
    )
    with pytest.raises(DataError, match="--anyway"):
        solve(lost)


def test_without_a_test_the_result_is_computed_once(processes):
    processes(2)
    given = []
    assert speculated(lambda explain: given.append(explain) or 3, given.append) == 3
    assert len(given) == 1


def test_time_while_a_test_runs_is_used(processes, monkeypatch):
    processes(2)
    monkeypatch.setattr(speculation, "_of_its_own", lambda *_: time.sleep(0.3))
    used = []
    assert speculated(lambda explain: explain(None, None, None) or 3, used.append) == 3
    assert used == [3]
    used.clear()

    def slow(explain):
        explain(None, None, None)
        time.sleep(1.0)
        return 3

    # The test has ended by then.
    assert speculated(slow, used.append) == 3
    assert not used


def test_the_history_is_the_same_whenever_it_is_followed(trial, processes):
    processes(1)
    _, later = solve_with_history(trial, rate_hz=1.0)
    processes(2)
    _, meanwhile = solve_with_history(trial, rate_hz=1.0)
    np.testing.assert_array_equal(meanwhile.root, later.root)
