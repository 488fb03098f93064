"""The chain of a trial without IMU: its factors in bulk, and for GTSAM's own optimisers."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from truth import config

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.smooth_motion import SmoothStates
from factorgraph_dvl.sensors.protocol import Linearization
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise
from factorgraph_dvl.solvers.preparation_without_imu import prepare_without_imu

# Turns sharp enough that clocks stay where they are between nodes, and as smooth as a ship's.
TURNS = [
    [{"turn_deg_s": rate, "duration_s": 15, "ramp_s": 6}, {"straight_s": 5}]
    for rate in (6.0, -7.0, 8.0)
]
LEGS = [{"straight_s": 4}, *(leg for both in TURNS for leg in both)]


@pytest.fixture(scope="module")
def prepared():
    return prepare_without_imu(simulate(config("ship", manoeuvres=LEGS), seed=3))


@pytest.fixture(scope="module")
def problem(prepared):
    chain, states, values = prepared.first_chain, prepared.states, prepared.values
    processes = prepared.stated_processes(chain, states, values)
    return Problem(
        chain, prepared.observations, prepared.parameters, start=values, processes=processes
    )


@pytest.fixture(scope="module")
def values(prepared, problem):
    rng = np.random.default_rng(1)
    off = rng.normal(0.0, 1e-3, (prepared.states.p_n.shape[0], 12))
    states = prepared.states.retracted(off)
    # Accelerations jump at nodes, so nothing that a clock moves may be at one.
    chain = problem.chain
    late = {chain.clock: 0.013, chain.attitude_clock: 0.02}
    late = {name: prepared.values[name] + by for name, by in late.items()}
    return problem.values(states, problem.prior_values() | prepared.values | late)


def moved(values, key, step):
    delta = gtsam.VectorValues()
    for other, size in values.dims().items():
        delta.insert(other, step if other == key else np.zeros(size))
    return values.retract(delta)


def by_level_axes(problem, here, there):
    """Return whitened residuals of attitudes if only positions, and so level axes, change."""
    out = []
    for bound, before, after in zip(problem.bound, here.motions, there.motions, strict=True):
        if bound.observation.unit == "rad":
            motion = replace(before, p_n=after.p_n)
            residual = problem.residual(bound.observation, motion, here.parameters)
            out.append((bound.weight * residual).ravel())
    return np.concatenate(out)


def test_the_gradient_is_that_of_the_cost(problem, values):
    problem.weigh(problem.evaluate(values))
    here = problem.evaluate(values)
    gradient = problem.linearize(here).gradientAtZero()
    some = [
        keys.attitude(7),
        keys.rate(7),
        keys.node(7),
        *(problem.key(p.name) for p in problem.parameters),
    ]
    some += [process.key(1) for process in problem.processes]
    level = by_level_axes(problem, here, here)
    for key in some:
        for i in range(values.dims()[key]):
            step = np.zeros(values.dims()[key])
            step[i] = 1e-6
            cost = []
            for way in (1.0, -1.0):
                there = problem.evaluate(moved(values, key, way * step))
                # What turns the level axes at the position, 1e-6 rad/s, is left out of Jacobians.
                turned = by_level_axes(problem, here, there)
                cost.append(there.cost - 0.5 * (turned - level) @ (turned + level))
            expected = (cost[0] - cost[1]) / 2e-6
            scale = max(1.0, np.abs(gradient.at(key)).max())
            assert gradient.at(key)[i] == pytest.approx(expected, abs=1e-5 * scale)


def test_the_clock_of_attitudes_leaves_these_where_they_are(prepared, problem):
    name = problem.chain.attitude_clock
    start = problem.prior_values() | prepared.values
    problem.weigh(problem.evaluate(problem.values(prepared.states, start)))
    before, after = (
        problem.evaluate(problem.values(prepared.states, start | {name: start[name] + late}))
        for late in (0.0, 0.02)
    )
    of_attitude = [b.observation.unit == "rad" for b in problem.bound]
    assert sum(of_attitude) == 1
    for k, bound in enumerate(problem.bound):
        here, there = before.motions[k], after.motions[k]
        used = (bound.weight > 0.0).all(axis=1)
        weight = bound.weight[used]
        changed = np.abs((after.residuals[k] - before.residuals[k])[used] / weight)
        if bound.observation.unit == "rad":
            np.testing.assert_allclose(there.nRb, here.nRb, atol=1e-12)
            # At up to 8 m/s the level axes turn by 8/6.4e6 rad/s, heading by tan(latitude) of it.
            assert 0.0 < changed.max() < 0.02 * 4.0 * 8.0 / 6.4e6
        else:
            assert changed.max() > 1e-4


@pytest.mark.parametrize("moved", ["m", "rad"])
def test_a_clock_that_moves_measurements_past_nodes_makes_no_jump(prepared, moved):
    """The cost goes on where fixes pass nodes, and where pings pass those of attitudes."""
    chain, start = prepared.first_chain, prepared.values
    clock = {"m": chain.clock, "rad": chain.attitude_clock}[moved]
    rng = np.random.default_rng(2)
    states = prepared.states.retracted(rng.normal(0.0, 1e-3, (prepared.states.p_n.shape[0], 12)))
    problem = Problem(chain, prepared.observations, prepared.parameters, start=start)

    def at(late):
        values = problem.prior_values() | start | {clock: start[clock] + late}
        return problem.evaluate(problem.values(states, values))

    problem.weigh(at(0.0))
    # Fixes move beside the nodes, and pings beside those of the attitude.
    unit = {"m": "m", "rad": "m/s"}[moved]
    (which,) = (i for i, b in enumerate(problem.bound) if b.observation.unit == unit)
    used = (problem.weights[which] > 0.0).any(axis=1)
    here = at(0.0).attached[which]
    place = here.place if moved == "m" else here.turned
    to_node = (place.span - place.tau)[used]
    # From here on, some pass a node.
    edge = float(to_node[to_node > 1e-3].min())
    nodes = [chain.nodes_at(at(edge + by).attached[which])[used] for by in (-1e-4, 1e-4)]
    assert (nodes[0] != nodes[1]).any()
    h = 1e-4
    before, after = (np.array([at(edge + by).cost for by in (s, 2.0 * s)]) for s in (-h, h))
    # Carried on from either side, both lead to the same value with the same slope.
    slope = (before[0] - before[1]) / h, (after[1] - after[0]) / h
    middle = 2.0 * before[0] - before[1], 2.0 * after[0] - after[1]
    assert middle[0] == pytest.approx(middle[1], rel=1e-9)
    if moved == "m":
        # Velocities and rates have a slope that jumps at nodes: acceleration is no state.
        assert slope[0] == pytest.approx(slope[1], rel=1e-3)


def test_what_is_missing_half_way_by_hand(prepared):
    chain, k = prepared.first_chain, 5
    start, dt = chain.node_time[k], chain.node_time[k + 1] - chain.node_time[k]
    q, axis, zero = chain.density[k], np.array([0.0, 1.0, 0.0]), np.zeros((1, 1))
    # By the clock of attitudes, as far from its nodes.
    at = chain.attach(np.array([start + 0.5 * dt]), chain.attitude_shift)
    along = {"d_p": chain.nRt[k] @ axis, "d_v": chain.nRt[k] @ axis, "d_theta": axis}
    along = {name: each[None, None] for name, each in (along | {"d_omega": axis}).items()}

    def missing(*names, at=at):
        lin = Linearization(zero, **{name: along[name] for name in names})
        return float(chain.missing(at, lin)[0, 0])

    # tau³ rest³ / 3 dt³ of a value, tau rest (dt² - 3 tau rest) / dt³ of its rate.
    assert missing("d_v") == pytest.approx(q[4] * dt / 16.0)
    assert missing("d_p") == pytest.approx(q[4] * dt**3 / 192.0)
    assert missing("d_omega") == pytest.approx(q[1] * dt / 16.0)
    assert missing("d_theta", "d_omega") == pytest.approx(q[1] * (dt**3 / 192.0 + dt / 16.0))
    # Attitudes alone are those by which the motion is known.
    assert chain.missing(at, Linearization(zero, d_theta=along["d_theta"])) is None
    # Half-way both are independent; at a third, tau² rest² (rest - tau) / 2 dt³ = 2/243 dt².
    every = missing("d_p", "d_v", "d_theta", "d_omega")
    assert every == pytest.approx((q[1] + q[4]) * (dt / 16.0 + dt**3 / 192.0))
    third = chain.attach(np.array([start + dt / 3.0]), chain.attitude_shift)
    both, alone = missing("d_p", "d_v", at=third), (missing(n, at=third) for n in ("d_p", "d_v"))
    assert both - sum(alone) == pytest.approx(2.0 * q[4] * 2.0 / 243.0 * dt**2)
    # Attitudes have their own place between the nodes, and beyond these only one node is known.
    late = replace(at, turned=replace(at.turned, tau=at.turned.span + 2.0))
    assert missing("d_v", at=late) == pytest.approx(q[4] * dt / 16.0)
    assert missing("d_omega", at=late) == pytest.approx(2.0 * q[1])
    both = missing("d_theta", "d_omega", at=late)
    # Of 2 s: tau³ / 3 of the value, tau of its rate, and twice tau² / 2.
    assert both == pytest.approx((8.0 / 3.0 + 2.0 + 4.0) * q[1])


def test_pings_at_nodes_miss_nothing_where_clocks_agree(prepared, problem):
    start = problem.prior_values() | prepared.values
    clock = problem.chain.attitude_clock
    (ping,) = (b for b in problem.bound if b.observation.unit == "m/s")
    # Where the record begins nodes are elsewhere.
    time = ping.times(start)
    at_nodes = np.abs(time[:, None] - problem.chain.node_time).min(axis=1) < 1e-9
    assert at_nodes.sum() > time.size - 4

    def missing(late):
        parameters = start | {clock: start[clock] + late}
        evaluation = problem.evaluate(problem.values(prepared.states, parameters))
        at, motion = (
            each[problem.bound.index(ping)] for each in (evaluation.attached, evaluation.motions)
        )
        return ping.missing(at, motion, evaluation.parameters, problem.processes_of(ping))

    # Attitudes of nodes are early by this.
    agreed = problem.chain.attitude_shift - problem.chain.shift(start)
    np.testing.assert_allclose(missing(agreed)[at_nodes], 0.0, atol=1e-12)
    assert (missing(agreed)[~at_nodes & ping.usable] > 1e-6).all()
    # Rates, which count by the lever arm, and attitudes, by the speed, then are between nodes.
    beside, tau = missing(0.1)[at_nodes], 0.1
    assert (beside.max(axis=1) > 1e-9).all()
    arm, speed = np.linalg.norm(start["lever_arm_m"]), 8.0
    q = problem.chain.density[:, :3].max()
    assert beside.max() < q * (arm * np.sqrt(tau) + speed * np.sqrt(tau**3 / 3.0)) ** 2


def test_each_measurement_is_a_factor_of_its_own_and_the_whole_graph_is_the_problem(
    problem, values
):
    problem.weigh(problem.evaluate(values))
    graph, start = problem.nonlinear_graph()
    evaluation = problem.evaluate(start)
    assert graph.error(start) == pytest.approx(evaluation.cost, rel=1e-9)
    assert graph.size() >= sum((w > 0.0).any(axis=1).sum() for w in problem.weights)
    own = problem.linearize(evaluation)
    ordering = problem.ordering()
    expected, _ = own.hessian(ordering)
    found, _ = graph.linearize(start).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-8


def test_the_whole_graph_is_the_problem_also_where_clocks_have_moved(prepared, problem):
    clocks = [name for name in prepared.values if name.endswith("time_offset_s")]
    late = {name: prepared.values[name] + 0.03 for name in clocks if name != problem.chain.clock}
    values = problem.values(prepared.states, problem.prior_values() | prepared.values | late)
    problem.weigh(problem.evaluate(values))
    graph, start = problem.nonlinear_graph()
    evaluation = problem.evaluate(start)
    bound = problem.bound_at
    late = (b.times(evaluation.parameters) - b.times(bound) for b in problem.bound)
    assert max(np.abs(each).max() for each in late) > 0.02
    ordering = problem.ordering()
    expected, _ = problem.linearize(evaluation).hessian(ordering)
    found, _ = graph.linearize(start).hessian(ordering)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-8


def test_gtsams_own_optimiser_and_marginals_agree(prepared, problem):
    values = problem.values(prepared.states, problem.prior_values() | prepared.values)
    near = minimise(problem, values, stage="test", tolerance=1e-8).evaluation
    # Clocks have moved since: measurements are bound anew, with pings between nodes of the
    # attitude, where its acceleration does not jump.
    chain = problem.chain
    early = chain.shift(near.parameters) - 0.2
    problem = Problem(
        replace(chain, attitude_time=chain.node_time + early),
        problem.observations,
        problem.all_parameters,
        start=near.parameters,
        processes=problem.processes,
    )
    minimum = minimise(problem, near.values, stage="test", tolerance=1e-10, max_iterations=300)
    assert minimum.converged
    best = minimum.evaluation.values
    graph, _ = problem.nonlinear_graph()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-9)
    steps = gtsam.VectorValues()
    for key, size in best.dims().items():
        steps.insert(key, np.full(size, 1e-4))
    start = best.retract(steps)
    assert graph.error(start) > graph.error(best) + 10.0
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    marginals = gtsam.Marginals(graph, found)
    information, _ = factorized(problem, minimum.evaluation)
    for p in problem.parameters:
        key = problem.key(p.name)
        sigma = np.sqrt(np.diag(information.marginals([key])[key]))
        theirs = np.sqrt(np.diag(marginals.marginalCovariance(key)))
        np.testing.assert_allclose(theirs, sigma, rtol=0.01)
        if p.rotation:
            off = gtsam.Rot3.Logmap(best.atRot3(key).between(found.atRot3(key)))
        else:
            off = found.atVector(key) - best.atVector(key)
        assert np.abs(off / sigma).max() < 0.01, p.name


def test_steady_motion_along_the_track_costs_nothing(prepared):
    chain = prepared.first_chain
    time = chain.node_time
    angle = 0.05 * (time - time[0])
    nRt = exp_so3(np.column_stack([np.zeros((time.size, 2)), angle]))
    omega = np.tile([0.0, 0.0, 0.05], (time.size, 1))
    v_n = 3.0 * nRt[:, :, 0]
    p_n = 60.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle])
    turning = replace(chain, nRt=nRt)
    states = turning.states(turning.values(SmoothStates(nRt, p_n, v_n, omega)))
    (step,) = turning.steps(states)
    assert np.abs(step.residual).max() < 1e-6
    # Waves turn the body, and with it no velocity.
    rolled = nRt @ exp_so3(np.array([0.1, 0.0, 0.0]))
    body_rate = omega @ exp_so3(np.array([0.1, 0.0, 0.0]))
    states = turning.states(turning.values(SmoothStates(rolled, p_n, v_n, body_rate)))
    (step,) = turning.steps(states)
    assert np.abs(step.residual).max() < 1e-6


def test_a_transposed_attitude_is_no_minimum(prepared, problem):
    values = problem.values(prepared.states, problem.prior_values() | prepared.values)
    problem.weigh(problem.evaluate(values))
    before = minimise(problem, values, stage="test").evaluation
    states, parameters = before.states, before.parameters
    turned = SmoothStates(states.nRb.transpose(0, 2, 1), states.p_n, states.v_n, states.omega_b)
    after = problem.evaluate(problem.values(turned, parameters))
    assert after.cost > 100.0 * before.cost
