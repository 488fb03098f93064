"""The window of a replay without IMU: what left it is known as well as by a batch solution."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from truth import CONFIGS

from factorgraph_dvl.replay.motion_window import SmoothedWindow, WindowProblem, smooth_window
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.motion_preparation import motion_observations, prepare_motion
from factorgraph_dvl.solvers.motion_smoother import smooth_motion


@pytest.fixture(scope="module")
def ship():
    legs = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5}]
    scenario = load_scenario(CONFIGS / "ship.yaml")
    return simulate(msgspec.structs.replace(scenario, manoeuvres=legs), 2)


@pytest.fixture(scope="module")
def found(ship):
    """The batch solution, with the weights at its minimum."""
    smoothed = smooth_motion(prepare_motion(ship), lambda stage, iteration, cost: None)
    problem, at = smoothed.problem, smoothed.evaluation
    at = problem.weighed(at.states, at.parameters)
    covariances = problem.equations(at).factorise().covariances()
    return SmoothedWindow(problem, at, covariances)


def window(ship, found, first):
    """Return the window of the nodes from one on, after a step."""
    problem, at = found.problem, found.evaluation
    observations = []
    for aid in ship.aids:
        own = motion_observations(aid, problem.frame, ship.body_axes)
        last = -np.inf
        for o, seen in zip(problem.observations, at.seen, strict=True):
            if o.label in [each.label for each in own]:
                last = max(last, *o.time[seen.interpolation.node < first])
        rest = rows_of(aid, aid.time > last)
        observations += motion_observations(rest, problem.frame, ship.body_axes)
    nodes = slice(first, None)
    chain = replace(
        problem.chain, time=problem.chain.time[nodes], density=problem.chain.density[nodes]
    )
    states = at.states[nodes]
    split = WindowProblem(
        problem,
        found.known_before(first),
        chain,
        problem.attitude,
        observations,
        states,
        np.zeros(problem.constants),
    )
    return smooth_window(split, states, at.parameters)


def test_a_window_and_what_is_known_before_it_are_the_whole(ship, found):
    assert not any(rows.any() for rows in found.problem.rejected.values())
    split = window(ship, found, 40)
    whole, part = found.covariances, split.covariances
    np.testing.assert_allclose(part.constants, whole.constants, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(part.nodes, whole.nodes[40:], rtol=1e-3, atol=1e-6)
    step, _ = found.problem.equations(found.evaluation).factorise().step()
    std = np.sqrt(np.diagonal(whole.nodes, axis1=1, axis2=2))
    expected = found.evaluation.states + step
    assert np.abs((split.evaluation.states - expected[40:]) / std[40:]).max() < 0.01


def test_one_outlier_does_not_reject_the_others(ship, found):
    fixes = ship.gnss.geodetic.copy()
    fixes[-5, 2] += 100.0
    split = window(replace(ship, gnss=replace(ship.gnss, geodetic=fixes)), found, 20)
    assert {label: rows.sum() for label, rows in split.problem.rejected.items()} == {
        "GNSS position": 1
    }
    assert not split.inconsistent
