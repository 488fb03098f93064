"""The inertial part of the graph."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from jacobians import differentiate
from problems import SHORT, walking
from truth import exact_states, scenario

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.inertial_chain import inertial_chain
from factorgraph_dvl.graph.priors import square_root
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import InitialAttitude


def chain_of(scene, trial=None):
    trial = trial or simulate(scene)
    frame = trial.frame()
    seg = segments(increments(trial.imu)[0], 1.0)
    states = exact_states(scene, frame, seg.node_time)
    return inertial_chain(trial, frame, seg, states), states


def values_of(chain, states):
    out = gtsam.Values()
    for k in range(states.p_n.shape[0]):
        state = gtsam.NavState(gtsam.Rot3(states.nRb[k]), states.p_n[k], states.v_n[k])
        out.insert(keys.node(k), state)
        if chain.walking or k == 0:
            biases = gtsam.imuBias.ConstantBias(states.accel_bias[k], states.gyro_bias[k])
            out.insert(keys.bias(k), biases)
    return out


@pytest.mark.parametrize("walks", [False, True])
def test_the_truth_costs_next_to_nothing(walks):
    scene = walking({"noise": False}) if walks else scenario(manoeuvres=SHORT)
    chain, states = chain_of(scene)
    if walks:
        # A walk of the simulator is none of the chain's at zero cost.
        states = replace(
            states, gyro_bias=0.0 * states.gyro_bias, accel_bias=0.0 * states.gyro_bias
        )
    assert chain.walking == walks
    cost = chain.graph.error(values_of(chain, states))
    assert cost / chain.graph.size() < 0.5
    off = replace(states, v_n=states.v_n + np.linspace(0.0, 1.0, len(states.v_n))[:, None])
    assert chain.graph.error(values_of(chain, off)) > 100.0 * (cost + 1.0)


def test_a_known_start_holds_the_first_attitude():
    scene = scenario(manoeuvres=SHORT)
    trial = simulate(scene)
    sigma = 1e-3
    rph = trial.reference.rph[0]
    known = replace(trial, initial_attitude=InitialAttitude(rph, np.full(3, sigma)))
    chain, states = chain_of(scene, known)
    free, _ = chain_of(scene, trial)
    turned = replace(states, nRb=states.nRb @ exp_so3(np.array([0.0, 0.0, 0.01])))
    more = [
        each.graph.error(values_of(each, turned)) - each.graph.error(values_of(each, states))
        for each in (chain, free)
    ]
    assert more[0] - more[1] == pytest.approx(0.5 * (0.01 / sigma) ** 2, rel=0.2)


def test_across_a_gap_of_the_imu_no_vessel_jumps():
    scene = scenario(manoeuvres=[{"straight_s": 12}], imu={"gaps_s": [[4.0, 6.0]]})
    chain, states = chain_of(scene)
    (_, last), (first, _) = chain.segments.arc_nodes
    pair = [keys.node(int(last)), keys.node(int(first))]
    every = (chain.graph.at(i) for i in range(chain.graph.size()))
    (factor,) = [f for f in every if list(f.keys()) == pair]
    values = values_of(chain, states)
    assert factor.error(values) < 0.5
    linear = factor.linearize(values)
    A, _ = linear.jacobian()

    def moved(h):
        out = gtsam.Values()
        for j, key in enumerate(pair):
            out.insert(key, values.atNavState(key).retract(h[9 * j : 9 * j + 9]))
        return -factor.linearize(out).jacobian()[1]

    np.testing.assert_allclose(A, differentiate(moved, 18), atol=1e-5)


def test_small_standard_deviations_are_no_constraints():
    root = np.diag(1.0 / np.array([1e-10, 1.0, 1e3]))
    model = square_root(root)
    assert not model.isConstrained()
    np.testing.assert_allclose(
        np.abs(model.whiten(np.array([DEG_PER_HOUR, 1.0, 1.0]))), [DEG_PER_HOUR * 1e10, 1.0, 1e-3]
    )
