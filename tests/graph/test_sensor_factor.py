"""The factor of all measurements after a node."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from jacobians import differentiate
from truth import exact_states, scenario

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.inertial_chain import InertialChain
from factorgraph_dvl.graph.sensor_factor import (
    Linearized,
    NodeMeasurements,
    bind,
    measured_nodes,
    measurement_factor,
    sensor_factor,
    states_at,
)
from factorgraph_dvl.imu.gtsam_measurements import preintegrate
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import one_segment
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate

FREE = {
    "dvl": {
        "misalignment_std_deg": [5, 10, 20],
        "scale_error_std": [0.1, 0.1, 0.1],
        "bias_std_m_s": [0.1, 0.1, 0.1],
        "time_offset_std_s": 0.1,
        "reference": "water",
    },
    "gnss": {"lever_arm_std_m": [0.1, 0.1, 0.1]},
}
ERRORS_FREE = FREE | {
    "imu": {
        "gyro_scale_std_ppm": 300,
        "accel_scale_std_ppm": 300,
        "gyro_misalignment_std_deg": 0.03,
        "accel_misalignment_std_deg": 0.03,
    }
}


NODES = [keys.node(0), keys.bias(0), keys.node(1)]


def chain_of(imu, frame, seg, gravity_n):
    """The chain of a segment, without factors."""
    biases = imu.parameters(0.0)
    graph = gtsam.NonlinearFactorGraph()
    return InertialChain(frame, seg, gravity_n, biases, biases, imu.settings, graph)


def node_measurements(time=20.0, **changes):
    """What a noiseless vessel measures in the second after `time`, and the truth there."""
    scene = scenario(**changes)
    trial = simulate(scene)
    frame = trial.frame()
    window = (trial.imu.time > time - 0.3) & (trial.imu.time < time + 1.3)
    imu = replace(
        trial.imu,
        time=trial.imu.time[window],
        gyro=trial.imu.gyro[window],
        accel=trial.imu.accel[window],
    )
    inc, _ = increments(imu, (0, 0))
    first = int(np.argmin(np.abs(inc.start - time)))
    last = int(np.argmin(np.abs(inc.end - time - 1.0))) + 1
    seg = one_segment(inc, first, last)
    states = exact_states(scene, frame, seg.node_time)
    values, observations = {}, []
    parameters = [p for aid in trial.aids for p in aid.parameters()]
    parameters += trial.imu.error_parameters()
    for p in parameters:
        true = trial.calibration_truth.get(p.name, np.zeros(p.mean.size)) * p.si
        true = np.broadcast_to(true, p.mean.shape).copy()
        values[p.name] = exp_so3(true) if p.rotation else true
    for aid in trial.aids:
        start, end = seg.node_time
        inside = np.flatnonzero((aid.time >= start) & (aid.time < end - 1e-6))
        observations += rows_of(aid, inside).observations(frame, "RFU")
    middle = states.p_n[:1] + 0.5 * states.v_n[:1]
    chain = chain_of(trial.imu, frame, seg, frame.gravity_without_rotation(middle))
    estimated = [p for p in parameters if p.estimated]
    some = {p.name: keys.calibration(i, p.mean.size) for i, p in enumerate(estimated)}
    bound, _ = bind(chain, observations, estimated, some, 0.0)
    fixed = {p.name: values[p.name] for p in parameters if not p.estimated}
    measured = NodeMeasurements.of(bound, estimated, fixed)
    free = {p.name: values[p.name] for p in measured.parameters}
    return measured, states, free


def gtsam_values(measured, states, values):
    out = gtsam.Values()
    for k in range(2):
        nav = gtsam.NavState(gtsam.Rot3(states.nRb[k]), states.p_n[k], states.v_n[k])
        out.insert(keys.node(k), nav)
    bias = gtsam.imuBias.ConstantBias(states.accel_bias[0], states.gyro_bias[0])
    out.insert(keys.bias(0), bias)
    for i, p in enumerate(measured.parameters):
        value = values[p.name]
        out.insert(keys.calibration(i, p.mean.size), gtsam.Rot3(value) if p.rotation else value)
    return out


def factor_of(measured, first=None):
    rows = sum(b.weight.size for b in measured.bound)
    weight = np.linspace(1.0, 2.0, rows)
    shared = [keys.calibration(i, p.mean.size) for i, p in enumerate(measured.parameters)]
    return measurement_factor(measured, weight, NODES, shared, first)


def test_the_factor_has_no_error_at_the_truth():
    measured, states, values = node_measurements(trial=FREE)
    assert len(measured.bound) == 3
    factor = factor_of(measured)
    residual = factor.unwhitenedError(gtsam_values(measured, states, values))
    # What the segment's one gravity and first-order biases leave.
    assert np.abs(residual).max() < 2e-5
    turned = replace(states, nRb=states.nRb.transpose(0, 2, 1))
    assert np.abs(factor.unwhitenedError(gtsam_values(measured, turned, values))).max() > 1.0


@pytest.mark.parametrize("claims", [FREE, ERRORS_FREE], ids=["sensors", "imu"])
def test_the_factor_linearises_as_differences_do(claims):
    measured, states, values = node_measurements(trial=claims)
    own = {p.name for p in measured.parameters} & ERRORS.keys()
    assert bool(own) == ("imu" in claims)
    rng = np.random.default_rng(3)
    states = replace(
        states,
        nRb=states.nRb @ exp_so3(rng.normal(0, 0.1, (1, 3))),
        v_n=states.v_n + rng.normal(0, 0.1, (1, 3)),
        gyro_bias=states.gyro_bias + 1e-5,
        accel_bias=states.accel_bias + 1e-2,
    )
    for p in measured.parameters:
        small = 1e-4 if p.name in own else 1e-5 if p.spec.unit == "s" else 0.1
        step = rng.normal(0.0, small, p.mean.size)
        value = values[p.name]
        values[p.name] = value @ exp_so3(step) if p.rotation else value + step
    at = gtsam_values(measured, states, values)
    factor = factor_of(measured)
    A, b = factor.linearize(at).jacobian()
    np.testing.assert_allclose(b, -factor.unwhitenedError(at), atol=1e-12)
    sizes = at.dims()

    def change(h):
        delta, place = gtsam.VectorValues(), 0
        for key in factor.keys():  # noqa: SIM118
            delta.insert(key, h[place : place + sizes[key]])
            place += sizes[key]
        return factor.unwhitenedError(at.retract(delta))

    numerical = differentiate(change, A.shape[1], 1e-5)
    scale = np.maximum(np.abs(numerical).max(axis=0), 1.0)
    # What transitions leave out: second order in the Earth's rate, 1e-4 of the bias's share.
    assert np.abs((A - numerical) / scale).max() < 2e-4


def test_what_was_computed_elsewhere_is_not_taken():
    """A range is not linear in the position, nor a velocity in the accelerometer's bias."""
    measured, states, values = node_measurements(trial=FREE)
    residual, jacobian, *_ = measured.linearize(states, values)
    own = states_at(gtsam_values(measured, states, values), NODES)
    computed = Linearized(own, values, residual + 100.0, jacobian)

    def is_taken(states, values):
        factor = factor_of(measured, computed)
        at = gtsam_values(measured, states, values)
        return bool(np.abs(factor.linearize(at).jacobian()[1]).max() > 50.0)

    assert is_taken(states, values)
    step = 1e-3
    for name in ("p_n", "v_n", "gyro_bias", "accel_bias"):
        assert not is_taken(replace(states, **{name: getattr(states, name) + step}), values), name
    turned = replace(states, nRb=states.nRb @ exp_so3(np.full((1, 3), step)))
    assert not is_taken(turned, values)
    for p in measured.parameters:
        if not p.rotation:
            assert not is_taken(states, values | {p.name: values[p.name] + step}), p.name


class StillFrame(LocalFrame):
    """A frame that does not turn with the Earth."""

    earth_rate = np.zeros(3)


def test_a_stationary_vessel_reports_the_velocity_of_its_lever_arm():
    # 0.1 rad/s about z and 2 m forward: 0.2 m/s to the left, which is -x of RFU.
    dvl = Dvl(
        DvlSettings(lever_arm_m=(0.0, 2.0, 0.0)),
        np.array([0.55]),
        np.zeros((1, 3)),
        np.ones((1, 3)),
    )
    frame = StillFrame(0.0, 0.0, 0.0)
    time = np.arange(1, 201) * 0.01
    gyro = np.tile([0.0, 0.0, 0.1], (time.size, 1))
    trial = simulate(scenario())
    imu = replace(trial.imu, time=time, gyro=gyro, accel=np.tile([0, 0, 9.8], (time.size, 1)))
    inc, _ = increments(imu, (0, 0))
    chain = chain_of(imu, frame, one_segment(inc, 50, 100), np.array([[0.0, 0.0, -9.8]]))
    estimated = [p for p in dvl.parameters() if p.estimated]
    fixed = {p.name: p.mean for p in dvl.parameters() if not p.estimated}
    mean = {p.name: exp_so3(p.mean) if p.rotation else p.mean for p in dvl.parameters()}
    bound, _ = bind(chain, dvl.observations(frame, "RFU"), estimated, {}, 0.0)
    measured = NodeMeasurements.of(bound, estimated, fixed)
    rest = np.zeros((2, 3))
    states = States(exp_so3([[0.0, 0.0, 0.0], [0.0, 0.0, 0.05]]), rest, rest, rest, rest)
    residual, *_ = measured.linearize(states, mean)
    np.testing.assert_allclose(residual, [-0.2, 0.0, 0.0], atol=1e-9)


def test_a_factor_with_the_wrong_number_of_keys_is_refused():
    measured, _, _ = node_measurements(trial=FREE)
    with pytest.raises(ValueError, match="keys"):
        measurement_factor(measured, np.ones(5), NODES, [])


def public_factor(**changes):
    """`sensor_factor` of a DVL in a noiseless turn, its values at the truth, and its chain."""
    scene = scenario(trial=FREE, **changes)
    trial = simulate(scene)
    frame = trial.frame()
    times = np.arange(18.0, 24.0)
    chain = preintegrate(trial.imu, times, frame, exact_states(scene, frame, times).p_n)
    states = exact_states(scene, frame, chain.time)
    values, named = gtsam.Values(), {"bias": keys.bias(0)}
    for k, name in ((2, "state"), (3, "state_after")):
        named[name] = keys.node(k)
        nav = gtsam.NavState(gtsam.Rot3(states.nRb[k]), states.p_n[k], states.v_n[k])
        values.insert(named[name], nav)
    values.insert(named["bias"], gtsam.imuBias.ConstantBias())
    for i, p in enumerate(trial.dvl.parameters()):
        if not p.estimated:
            continue
        true = np.zeros(p.mean.size) + trial.calibration_truth.get(p.name, 0.0) * p.si
        named[p.name] = keys.calibration(i, p.mean.size)
        values.insert(named[p.name], gtsam.Rot3(exp_so3(true)) if p.rotation else true)
    (velocity,) = trial.dvl.observations(frame, trial.body_axes)
    return velocity, trial.dvl.parameters(), chain, named, values


def test_a_factor_of_an_own_graph_has_no_error_at_the_truth():
    velocity, parameters, chain, named, values = public_factor()
    assert measured_nodes(velocity, parameters, chain) == [0, 1, 2, 3, 4]
    factor = sensor_factor(velocity, parameters, chain, 2, named, values)
    assert factor.dim() == 5 * 3
    # In standard deviations, of 8 mm/s at 4 m/s.
    assert np.abs(factor.unwhitenedError(values)).max() < 0.01
    state = values.atNavState(named["state"])
    turned = gtsam.NavState(state.attitude().inverse(), state.position(), state.velocity())
    wrong = gtsam.Values(values)
    wrong.update(named["state"], turned)
    assert np.abs(factor.unwhitenedError(wrong)).max() > 100.0


def test_the_jacobians_of_a_factor_hold_in_any_graph():
    velocity, parameters, chain, named, values = public_factor()
    rng = np.random.default_rng(5)
    delta = gtsam.VectorValues()
    for key, size in values.dims().items():
        delta.insert(key, rng.normal(0.0, 1e-5 if key == named["bias"] else 1e-3, size))
    values = values.retract(delta)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(sensor_factor(velocity, parameters, chain, 2, named, values))
    ordering = gtsam.Ordering()
    for key in named.values():
        ordering.push_back(key)
    A, b = graph.linearize(values).jacobian(ordering)
    factor = graph.at(0)
    np.testing.assert_allclose(b, -factor.unwhitenedError(values), atol=1e-12)
    sizes = values.dims()
    edges = np.cumsum([0, *(sizes[key] for key in named.values())])

    def change(h):
        step = gtsam.VectorValues()
        for i, key in enumerate(named.values()):
            step.insert(key, h[edges[i] : edges[i + 1]])
        return factor.unwhitenedError(values.retract(step))

    numerical = differentiate(change, A.shape[1], 1e-5)
    scale = np.maximum(np.abs(numerical).max(axis=0), 1.0)
    assert np.abs((A - numerical) / scale).max() < 2e-4


def test_a_factor_without_measurements_and_an_unknown_parameter_are_refused():
    velocity, parameters, chain, named, values = public_factor(dvl={"rate_hz": 0.5})
    assert len(measured_nodes(velocity, parameters, chain)) == 3
    missing = next(k for k in range(5) if k not in measured_nodes(velocity, parameters, chain))
    with pytest.raises(ValueError, match="no measurement"):
        sensor_factor(velocity, parameters, chain, missing, named, values)
    with pytest.raises(KeyError, match="arm"):
        sensor_factor(velocity, parameters, chain, 2, named | {"arm": 1}, values)


def test_a_factor_says_that_it_leaves_a_window_out():
    trial = simulate(scenario(dvl={"averaging_s": 0.5}, trial={"dvl": {"averaging_s": 0.5}}))
    frame = trial.frame()
    chain = preintegrate(trial.imu, np.arange(10.0, 12.0), frame)
    (velocity,) = trial.dvl.observations(frame, trial.body_axes)
    values = gtsam.Values()
    for key in (1, 3):
        values.insert(key, gtsam.NavState())
    values.insert(2, gtsam.imuBias.ConstantBias())
    key_of = {"state": 1, "bias": 2, "state_after": 3}
    with pytest.warns(UserWarning, match="window"):
        sensor_factor(velocity, trial.dvl.parameters(), chain, 0, key_of, values)


def test_nodes_that_the_imu_does_not_cover_are_refused():
    trial = simulate(scenario())
    frame = trial.frame()
    gap = (trial.imu.time < 10.0) | (trial.imu.time > 12.0)
    imu = rows_of(trial.imu, gap)
    for record, times, text in (
        (trial.imu, [0.0, 1000.0], "covers"),
        (trial.imu, [3.0, 2.0], "increase"),
        (trial.imu, [3.0, 3.001], "apart"),
        (imu, [5.0, 9.0, 14.0], "gap"),
    ):
        with pytest.raises(DataError, match=text):
            preintegrate(record, times, frame)
    np.testing.assert_allclose(preintegrate(imu, [13.0, 14.004], frame).time, [13.0, 14.0])
