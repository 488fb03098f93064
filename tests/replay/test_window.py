"""The window of a replay without IMU: with what is known before it, it is the whole trial."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import msgspec
import numpy as np
import pytest
from truth import CONFIGS

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.replay.window import BatchSolution, Window, WindowChain
from factorgraph_dvl.sensors.attitude import AttitudeAngles
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.solvers.preparation_without_imu import (
    lasting_observations,
    prepare_without_imu,
)
from factorgraph_dvl.solvers.rounds import settle
from factorgraph_dvl.statistics.elimination import eliminated

FIRST = 40
# What a window takes of noise and strengths is the same through water.
OVER_GROUND = pytest.mark.parametrize("ship", ["ship"], indirect=True)


@pytest.fixture(scope="module", params=["ship", "ship-water"])
def ship(request):
    legs = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 40, "ramp_s": 5}]
    scenario = load_scenario(CONFIGS / f"{request.param}.yaml")
    return simulate(msgspec.structs.replace(scenario, manoeuvres=legs), 2)


def solved(trial, duration):
    """Return a batch solution, and what windows take from it."""
    prepared = prepare_without_imu(trial)
    settled = settle(prepared, prepared.states, lambda stage, iteration, cost: None)
    return settled, BatchSolution.of(prepared, settled.problem, duration)


@pytest.fixture(scope="module")
def both(ship):
    return solved(ship, 80.0)


@pytest.fixture(scope="module")
def batch(both):
    return both[1]


@pytest.fixture(scope="module")
def whole(both):
    """All nodes of a batch solution."""
    problem, minimum = both[0].problem, both[0].minimum
    # What the clocks have moved beyond the last node since it was bound.
    beyond = {
        b.observation.label: b.observation.time[
            ~problem.chain.covers(b.times(minimum.evaluation.parameters))
        ]
        for b in problem.bound
    }
    problem.reject(beyond)
    return Window(problem, minimum.evaluation, minimum.information)


def later(ship, whole, first):
    """Return the problem of the nodes from one on, where the whole was solved."""
    problem, chain, s = whole.problem, whole.chain, whole.evaluation.states
    past = whole.before(first)
    nodes = slice(first, None)
    states = type(s)(s.nRb[nodes], s.p_n[nodes], s.v_n[nodes], s.omega_b[nodes], s.time[nodes])
    own = WindowChain(
        frame=chain.frame,
        node_time=chain.node_time[nodes],
        attitude_time=chain.attitude_time[nodes],
        density=chain.density[nodes],
        start=states,
        nRt=chain.nRt[nodes],
        clock=chain.clock,
        attitude_clock=chain.attitude_clock,
        resolution=chain.resolution,
        known=past.known,
    )
    observations = []
    for aid in ship.aids:
        every = lasting_observations(aid, chain.frame, ship.body_axes, ship)
        last = max(past.measured[o.label] for o in every)
        rest = rows_of(aid, aid.time > last)
        observations += lasting_observations(rest, chain.frame, ship.body_axes, ship)
    # A few rows hardly show the noise of attitudes.
    std = {o.label: o.std for o in problem.observations if isinstance(o, AttitudeAngles)}
    observations = [
        replace(o, std=std[o.label][-o.time.size :]) if o.label in std else o for o in observations
    ]
    out = Problem(
        own,
        observations,
        problem.all_parameters,
        start=whole.values,
        clock_zero=problem.clock_zero,
        processes=past.processes,
    )
    out.noise_factors, out.long_run = problem.noise_factors, problem.long_run
    values = out.values(states, {**whole.values, **past.nodes})
    return out, out.weighed(out.evaluate(values))


def information_of(problem, at):
    return eliminated(problem.linearize(at), problem.ordering(), at.values.dims())


def test_a_window_and_what_is_known_before_it_are_the_whole(ship, whole):
    problem, at = later(ship, whole, FIRST)
    weighed = whole.problem.weighed(whole.evaluation)
    part = Window(problem, at, information_of(problem, at))
    all_of = Window(whole.problem, weighed, information_of(whole.problem, weighed))
    std = np.sqrt(np.diag(all_of.constants))
    np.testing.assert_allclose(np.sqrt(np.diag(part.constants)), std, rtol=1e-3)
    step = part.information.solution()
    expected = all_of.information.solution()
    for name, own in problem.columns.items():
        key = problem.key(name)
        assert np.abs((step.at(key) - expected.at(key)) / std[own]).max() < 1e-2, name
    # The acceleration of the first is that to the next alone.
    near, found = (
        np.diagonal(each[1:], axis1=1, axis2=2) for each in (all_of.states[FIRST:], part.states)
    )
    np.testing.assert_allclose(found, near, rtol=1e-2)


def of_constants(known, count):
    """Return the covariance of the last variables, of a node after the first some unknown."""
    states, own = known.root[:, :-count], known.root[:, -count:]
    left = own - states @ np.linalg.lstsq(states, own, rcond=None)[0]
    return np.linalg.inv(left.T @ left)


def test_what_is_known_twice_is_known_once(ship, whole):
    """Nodes may leave in one step or in two."""
    at_once = whole.before(FIRST + 10).known
    problem, at = later(ship, whole, FIRST)
    in_two = Window(problem, at, information_of(problem, at)).before(10).known
    constants = sum(p.mean.size for p in problem.parameters)
    first = [keys.attitude(0), keys.rate(0), keys.node(0)]
    assert set(at_once.keys) == set(in_two.keys) > set(first)
    std = [np.sqrt(np.diag(of_constants(known, constants))) for known in (in_two, at_once)]
    np.testing.assert_allclose(*std, rtol=1e-3)


def test_a_tilt_moves_the_constants_by_their_covariance(whole):
    known = whole.before(FIRST).known
    count = sum(p.mean.size for p in whole.problem.parameters)
    gradient = np.zeros(count)
    gradient[3] = 2.0
    change = known.tilted(gradient).right - known.right
    moved = np.linalg.lstsq(known.root, change, rcond=None)[0][-count:]
    P = of_constants(known, count)
    sigma = np.sqrt(np.diag(P))
    np.testing.assert_allclose(moved / sigma, -P @ gradient / sigma, rtol=1e-6, atol=1e-6)


def test_what_is_known_is_a_factor_at_its_own_values(whole):
    known = whole.before(FIRST).known
    graph = gtsam.NonlinearFactorGraph()
    graph.add(known.factor())
    np.testing.assert_allclose(graph.error(known.values), 0.5 * known.right @ known.right)


def test_motion_is_returned_once(whole):
    axes = "FRD"
    first = whole.motion(-np.inf, 30, axes)
    second = whole.motion(float(first.time[-1]), whole.last, axes)
    every = whole.motion(-np.inf, whole.last, axes)
    np.testing.assert_array_equal(np.append(first.time, second.time), every.time)
    assert whole.newest(axes).time[0] == pytest.approx(whole.now)
    assert every.time[-1] <= whole.now


@OVER_GROUND
def test_a_few_rows_have_the_noise_of_the_record(ship, whole, batch):
    rows = rows_of(ship.attitude, slice(100, 110))
    (few,) = batch.observations(rows)
    (every,) = (o for o in whole.problem.observations if o.label == "Attitude")
    np.testing.assert_allclose(few.std, every.std[100:110])
    # Stated noise of other sensors may differ from row to row.
    assert batch.std.keys() == {"Attitude"}
    assert batch.labels["gnss"] == {"GNSS position"}


@OVER_GROUND
def test_densities_are_those_of_turns_where_the_vessel_turns(ship, batch):
    record = AttitudeRecord(ship.attitude, ship.body_axes, estimated=False)
    time = np.array([20.0, 43.0, 65.0])
    density = batch.density(record, ship, time, {})
    # The averages that axes of the track follow reach over the whole of this turn.
    np.testing.assert_array_equal(density, batch.densities[[0, 2, 2]])
    assert np.any(batch.densities[0] != batch.densities[2])


@OVER_GROUND
def test_before_the_first_turn_another_strength_is_assumed(ship):
    _, batch = solved(ship.until(35.0), 35.0)
    leg, *others = batch.densities
    for density in others:
        np.testing.assert_array_equal(density[:3], leg[:3])
        assert np.all(density[3:] >= 1e-3)


@OVER_GROUND
def test_the_tilt_grows_with_time(whole, batch):
    np.testing.assert_allclose(80.0 * batch.tilt, whole.problem.tilt.gradient)
