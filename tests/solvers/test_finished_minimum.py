"""Minima that stages keep: a run that takes them finds the same to the last digit."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from truth import KNOWN_CLOCK, merged, scenario

from factorgraph_dvl.background import PROCESSES
from factorgraph_dvl.io.finished_stages import FinishedStages
from factorgraph_dvl.sensors.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import rounds
from factorgraph_dvl.solvers.batch import solve_with_problem

CORRELATED = {
    "trial": {"dvl": {"correlation_time_s": 8.0, "correlated_std_m_s": 0.01, "noise": "stated"}}
}
WALKING = {
    "imu": {"gyro_bias_walk_deg_h_sqrt_h": 1.0},
    "trial": {"imu": {"gyro_bias_walk_deg_h_sqrt_h": 1.0, "gyro_scale_std_ppm": 100.0}},
}


def solved(trial, folder, *, resume):
    stages = FinishedStages(folder, "inputs", resume=resume)
    solution, found = solve_with_problem(trial, rate_hz=1.0, stages=stages)
    return solution, found


def same(first, again):
    (one, at), (two, there) = first, again
    assert [str(f) for f in two.findings] == [str(f) for f in one.findings]
    assert (two.iterations, two.cost) == (one.iterations, one.cost)
    for e in one.estimates:
        np.testing.assert_array_equal(two.estimate(e.name).value, e.value)
    np.testing.assert_array_equal(two.covariance, one.covariance)
    for name in ("geodetic", "velocity", "rph", "position_cov", "rph_cov"):
        mine, other = (getattr(each.trajectory, name) for each in (one, two))
        np.testing.assert_array_equal(other, mine)
    for mine, other in zip(one.residuals, two.residuals, strict=True):
        np.testing.assert_array_equal(other.residual, mine.residual)
        np.testing.assert_array_equal(other.sigma, mine.sigma)
    np.testing.assert_array_equal(there.covariances.nodes, at.covariances.nodes)


def forbidden(*args, **kwargs):
    raise AssertionError("minimised again")


@pytest.mark.parametrize("more", [{}, CORRELATED, WALKING], ids=["as is", "correlated", "walking"])
def test_a_kept_minimum_is_taken_to_the_last_digit(monkeypatch, tmp_path, more):
    trial = simulate(scenario(**merged(merged({}, KNOWN_CLOCK), more)), 4)
    first = solved(trial, tmp_path / "stages", resume=False)
    kept = list((tmp_path / "stages").glob("minimum-*"))
    assert kept
    monkeypatch.setattr(rounds, "minimise", forbidden)
    same(first, solved(trial, tmp_path / "stages", resume=True))


@pytest.mark.parametrize("processes", [1, 2])
def test_rounds_with_another_parameter_are_kept_apart(monkeypatch, tmp_path, processes):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setenv(PROCESSES, f"{processes}")
    trial = simulate(scenario(**merged({}, KNOWN_CLOCK)), 4)
    late = replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + 0.05))
    first = solved(late, tmp_path / "stages", resume=False)
    assert Code.ESTIMATED_INSTEAD in [f.code for f in first[0].findings]
    monkeypatch.setattr(rounds, "minimise", forbidden)
    same(first, solved(late, tmp_path / "stages", resume=True))


def test_a_damaged_minimum_is_searched_again(tmp_path):
    trial = simulate(scenario(**merged({}, KNOWN_CLOCK)), 4)
    first = solved(trial, tmp_path / "stages", resume=False)
    for file in (tmp_path / "stages").glob("minimum-*"):
        file.write_bytes(file.read_bytes()[:-9])
    same(first, solved(trial, tmp_path / "stages", resume=True))
