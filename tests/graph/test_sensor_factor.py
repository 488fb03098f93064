"""The factor of all measurements after a node."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from jacobians import differentiate
from truth import exact_states, scenario

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.sensor_factor import (
    Linearized,
    NodeMeasurements,
    Rows,
    measurement_factor,
)
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import one_segment
from factorgraph_dvl.imu.propagation import States, attach
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
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
    states = exact_states(scene, frame, seg.node_time[:1])
    values, rows, times, count = {}, [], [], 0
    parameters = [p for aid in trial.aids for p in aid.parameters()]
    for p in parameters:
        true = trial.calibration_truth.get(p.name, np.zeros(p.mean.size)) * p.si
        true = np.broadcast_to(true, p.mean.shape).copy()
        values[p.name] = exp_so3(true) if p.rotation else true
    for aid in trial.aids:
        start, end = seg.node_time
        inside = np.flatnonzero((aid.time >= start) & (aid.time < end - 1e-6))
        for o in rows_of(aid, inside).observations(frame, "RFU"):
            rows.append(Rows(o, slice(count, count + o.time.size), o.time))
            times.append(o.time)
            count += o.time.size
    middle = states.p_n + 0.5 * states.v_n
    measured = NodeMeasurements(
        attachment=attach(seg, np.concatenate(times), frame.earth_rate),
        rows=tuple(rows),
        parameters=tuple(p for p in parameters if p.estimated),
        fixed={p.name: values[p.name] for p in parameters if not p.estimated},
        gravity_n=frame.gravity_without_rotation(middle),
        earth_rate_n=frame.earth_rate,
    )
    free = {p.name: values[p.name] for p in measured.parameters}
    return measured, states, free


def gtsam_values(measured, states, values):
    out = gtsam.Values()
    nav = gtsam.NavState(gtsam.Rot3(states.nRb[0]), states.p_n[0], states.v_n[0])
    out.insert(keys.node(0), nav)
    bias = gtsam.imuBias.ConstantBias(states.accel_bias[0], states.gyro_bias[0])
    out.insert(keys.bias(0), bias)
    for i, p in enumerate(measured.parameters):
        value = values[p.name]
        out.insert(keys.calibration(i, p.mean.size), gtsam.Rot3(value) if p.rotation else value)
    return out


def factor_of(measured, first=None):
    rows = sum(r.time.size * len(r.observation.components) for r in measured.rows)
    weight = np.linspace(1.0, 2.0, rows)
    shared = [keys.calibration(i, p.mean.size) for i, p in enumerate(measured.parameters)]
    return measurement_factor(measured, weight, keys.node(0), keys.bias(0), shared, first)


def test_the_factor_has_no_error_at_the_truth():
    measured, states, values = node_measurements(trial=FREE)
    assert len(measured.rows) == 3
    factor = factor_of(measured)
    residual = factor.unwhitenedError(gtsam_values(measured, states, values))
    # What the segment's one gravity and first-order biases leave.
    assert np.abs(residual).max() < 2e-5
    turned = replace(states, nRb=states.nRb.transpose(0, 2, 1))
    assert np.abs(factor.unwhitenedError(gtsam_values(measured, turned, values))).max() > 1.0


def test_the_factor_linearises_as_differences_do():
    measured, states, values = node_measurements(trial=FREE)
    rng = np.random.default_rng(3)
    states = replace(
        states,
        nRb=states.nRb @ exp_so3(rng.normal(0, 0.1, (1, 3))),
        v_n=states.v_n + rng.normal(0, 0.1, (1, 3)),
        gyro_bias=states.gyro_bias + 1e-5,
        accel_bias=states.accel_bias + 1e-2,
    )
    for p in measured.parameters:
        step = rng.normal(0.0, 1e-5 if p.spec.unit == "s" else 0.1, p.mean.size)
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
    residual, jacobian, _ = measured.linearize(states, values)
    computed = Linearized(states, values, residual + 100.0, jacobian)

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


def test_a_stationary_vessel_reports_the_velocity_of_its_lever_arm():
    # 0.1 rad/s about z and 2 m forward: 0.2 m/s to the left, which is -x of RFU.
    dvl = Dvl(
        DvlSettings(lever_arm_m=(0.0, 2.0, 0.0)),
        np.array([0.55]),
        np.zeros((1, 3)),
        np.ones((1, 3)),
    )
    frame = LocalFrame(0.0, 0.0, 0.0)
    time = np.arange(1, 201) * 0.01
    gyro = np.tile([0.0, 0.0, 0.1], (time.size, 1))
    trial = simulate(scenario())
    imu = replace(trial.imu, time=time, gyro=gyro, accel=np.tile([0, 0, 9.8], (time.size, 1)))
    inc, _ = increments(imu, (0, 0))
    seg = one_segment(inc, 50, 100)
    none = np.zeros(3)
    measured = NodeMeasurements(
        attachment=attach(seg, dvl.time, none),
        rows=(Rows(dvl.observations(frame, "RFU")[0], slice(0, 1), dvl.time),),
        parameters=tuple(p for p in dvl.parameters() if p.estimated),
        fixed={p.name: p.mean for p in dvl.parameters() if not p.estimated},
        gravity_n=np.array([[0.0, 0.0, -9.8]]),
        earth_rate_n=none,
    )
    rest = np.zeros((1, 3))
    states = States(np.eye(3)[None], rest, rest, rest, rest)
    values = {p.name: exp_so3(p.mean) if p.rotation else p.mean for p in measured.parameters}
    np.testing.assert_allclose(measured.residuals(states, values), [-0.2, 0.0, 0.0], atol=1e-9)


def test_a_factor_with_the_wrong_number_of_keys_is_refused():
    measured, _, _ = node_measurements(trial=FREE)
    with pytest.raises(ValueError, match="keys"):
        measurement_factor(measured, np.ones(5), keys.node(0), keys.bias(0), [])
