"""Parts of the replay: adapter, segments, smoother, samples, gate, convergence."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from jacobians import differentiate
from truth import exact_states, scenario

from factorgraph_dvl.analysis.convergence import check_limits, convergence, lacking
from factorgraph_dvl.errors import ConfigError
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
from factorgraph_dvl.imu.preintegration import one_segment, segments
from factorgraph_dvl.imu.propagation import States, attach
from factorgraph_dvl.replay.estimate import Innovations
from factorgraph_dvl.replay.gate import Gate
from factorgraph_dvl.replay.samples import SampleBuffer
from factorgraph_dvl.replay.silence import Silence
from factorgraph_dvl.replay.smoother import Smoother
from factorgraph_dvl.report.figures.convergence import convergence_figure
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings, DvlVelocity
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solution import Estimate

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

NOISE = ImuSettings(
    gyro_noise_deg_sqrt_h=0.001,
    gyro_bias_std_deg_h=0.1,
    accel_noise_ug_sqrt_hz=20,
    accel_bias_std_ug=100,
)


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
        for o in rows_of(aid, inside).observations(frame):
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
        rows=(Rows(dvl.observations(frame)[0], slice(0, 1), dvl.time),),
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


def test_one_segment_is_that_of_the_whole_chain():
    trial = simulate(scenario())
    inc, _ = increments(trial.imu)
    chain = segments(inc, 1.0)
    k = 20
    one = one_segment(inc, int(chain.first[k]), int(chain.last[k]))
    for name, values in zip(("dR", "dV", "dP"), one.totals(), strict=True):
        whole = dict(zip(("dR", "dV", "dP"), chain.totals(), strict=True))[name]
        np.testing.assert_allclose(values[0], whole[k], atol=1e-12)
    time = chain.node_time[k] + np.array([0.0, 0.123, 0.9])
    rate = trial.frame().earth_rate
    a, b = attach(one, time, rate), attach(chain, time, rate)
    for name in ("tau", "dR", "dA", "dV", "dP", "gyro", "alpha", "force", "omega_sigma"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12, err_msg=name)


def chain_of_states(count):
    """A prior, and for each further state a factor to the one before and a measurement."""
    prior, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    bias = gtsam.imuBias.ConstantBias()
    state = gtsam.NavState()
    loose = gtsam.noiseModel.Isotropic.Sigma
    prior.add(gtsam.PriorFactorNavState(keys.node(0), state, loose(9, 0.1)))
    prior.add(gtsam.PriorFactorConstantBias(keys.bias(0), bias, loose(6, 1e-3)))
    values.insert(keys.node(0), state)
    values.insert(keys.bias(0), bias)
    params = gtsam.PreintegrationParams.MakeSharedU(9.8)
    params.setGyroscopeCovariance(1e-6 * np.eye(3))
    params.setAccelerometerCovariance(1e-4 * np.eye(3))
    params.setIntegrationCovariance(1e-8 * np.eye(3))
    pim = gtsam.PreintegratedImuMeasurementsG(params)
    for _ in range(20):
        pim.integrateMeasurement(np.array([0.3, 0.1, 9.9]), np.array([0.05, 0.1, 0.2]), 0.01)
    rng = np.random.default_rng(1)
    steps = []
    for k in range(1, count):
        graph, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.GalileanImuFactor2(keys.node(k - 1), keys.node(k), keys.bias(0), pim))
        state = pim.predict(state, bias)
        noisy = state.retract(rng.normal(0.0, 0.05, 9))
        graph.add(gtsam.PriorFactorNavState(keys.node(k), noisy, loose(9, 0.1)))
        new.insert(keys.node(k), state)
        steps.append((0.2 * k, graph, new))
    return prior, values, steps


def test_the_lag_is_that_of_the_incremental_fixed_lag_smoother():
    prior, values, steps = chain_of_states(60)
    ours = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=False, lag=4.0)
    settings = gtsam.ISAM2Params()
    settings.setFactorization("QR")
    settings.relinearizeSkip = 1
    settings.setRelinearizeThreshold(1e-3)
    theirs = gtsam.IncrementalFixedLagSmoother(4.0, settings)
    bias = keys.bias(0)
    theirs.update(prior, values, {keys.node(0): 0.0, bias: 0.0})
    for k, (time, graph, new) in enumerate(steps, start=1):
        ours.extend(time, graph, new)
        theirs.update(graph, new, {keys.node(k): time, bias: time})
    k = len(steps)
    sigma = np.sqrt(np.diag(theirs.marginalCovariance(keys.node(k))))
    P = ours.joint_covariance()
    np.testing.assert_allclose(np.sqrt(np.diag(P))[:9], sigma, rtol=1e-3)
    apart = theirs.calculateEstimateNavState(keys.node(k)).localCoordinates(ours.state(k))
    assert np.abs(apart / sigma).max() < 0.02
    assert len(ours.times) == len(theirs.timestamps()) - 1
    old = ours.oldest + 3
    found = ours.state_covariances([old])[old]
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)),
        np.sqrt(np.diag(theirs.marginalCovariance(keys.node(old)))),
        rtol=1e-3,
    )


def test_a_range_is_linearised_where_the_position_is_found_to_be():
    """A vehicle 30 m off its reckoned place hears two beacons after a long silence."""
    sigma = 0.5

    def range_of_100_m(beacon):
        def error(this, at, jacobians):
            state = at.atNavState(keys.node(0))
            away = state.position() - beacon
            distance = np.linalg.norm(away)
            if jacobians is not None:
                J = np.zeros((1, 9))
                J[0, 3:6] = away / distance @ state.attitude().matrix()
                jacobians[0] = np.asfortranarray(J / sigma)
            return np.array([(distance - 100.0) / sigma])

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [keys.node(0)], error)

    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    bias = gtsam.imuBias.ConstantBias()
    prior, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    begun = gtsam.NavState(gtsam.Rot3(), np.array([0.0, 30.0, 0.0]), np.zeros(3))
    known = np.full(3, 1e-3)
    sigmas = np.concatenate([known, [5.0, 40.0, 1e-3], known])
    prior.add(gtsam.PriorFactorNavState(keys.node(0), begun, diagonal(sigmas)))
    prior.add(gtsam.PriorFactorConstantBias(keys.bias(0), bias, diagonal(np.full(6, 1e-3))))
    values.insert(keys.node(0), begun)
    values.insert(keys.bias(0), bias)
    smoother = Smoother(
        prior, values, node=0, time=0.0, parameters=(), walking=False, lag=30.0, ranges=True
    )
    for k in range(1, 6):
        graph, new = gtsam.NonlinearFactorGraph(), gtsam.Values()
        still = diagonal(np.full(9, 1e-3))
        graph.add(
            gtsam.BetweenFactorNavState(keys.node(k - 1), keys.node(k), gtsam.NavState(), still)
        )
        if k == 1:
            for place in ([100.0, 0.0, 0.0], [0.0, -100.0, 0.0]):
                graph.add(range_of_100_m(np.array(place)))
        new.insert(keys.node(k), smoother.state(k - 1))
        smoother.extend(float(k), graph, new)
    # Linearised at the reckoned place, it ends 4 m off.
    assert np.abs(smoother.state(5).position()).max() < sigma


def test_the_oldest_state_stays_a_leaf_when_old_states_are_corrected():
    prior, values, steps = chain_of_states(80)
    smoother = Smoother(prior, values, node=0, time=0.0, parameters=(), walking=False, lag=4.0)
    for k, (time, graph, new) in enumerate(steps, start=1):
        smoother.extend(time, graph, new)
        late = gtsam.NonlinearFactorGraph()
        old = max(smoother.oldest + k % 15, 0)
        if old <= smoother.node:
            noise = gtsam.noiseModel.Isotropic.Sigma(9, 0.5)
            late.add(gtsam.PriorFactorNavState(keys.node(old), smoother.state(old), noise))
            smoother.correct(late, old)
    assert len(smoother.times) == 21


def table(time):
    return np.column_stack([time, np.tile([0, 0, 0, 0, 0, 9.8], (time.size, 1))])


def test_samples_take_what_is_in_order_and_count_the_rest():
    samples = SampleBuffer(simulate(scenario()).imu.settings)
    time = np.arange(1, 301) * 0.01
    used, jump = samples.add(table(time))
    assert used.shape[0] == 300
    assert jump == 0.0
    broken = table(np.array([3.01, 3.02]))
    broken[0, 4] = np.nan
    used, _ = samples.add(broken)
    assert used.shape[0] == 1
    used, _ = samples.add(table(np.array([2.5])))
    assert used.shape[0] == 0
    assert samples.refused == 2


def test_a_clock_that_jumps_back_is_set_right():
    samples = SampleBuffer(simulate(scenario()).imu.settings)
    samples.add(table(np.arange(1, 301) * 0.01))
    used, jump = samples.add(table(np.arange(1, 101) * 0.01))
    assert jump == pytest.approx(3.0)
    assert used.shape[0] == 100
    np.testing.assert_allclose(used[:, 0], 3.0 + np.arange(1, 101) * 0.01)


def test_a_gap_ends_a_segment():
    samples = SampleBuffer(simulate(scenario()).imu.settings)
    time = np.arange(1, 1001) * 0.01
    samples.add(table(time[(time < 5.0) | (time > 6.0)]))
    gap = samples.gap_after(4.0)
    assert gap is not None
    assert (gap.before, gap.after) == pytest.approx((4.99, 6.01))
    seg = samples.segment_after(4.8, 0.2, np.inf, end=False)
    np.testing.assert_allclose(seg.node_time, [4.8, 4.99])
    assert samples.segment_after(4.99, 0.2, np.inf, end=False) == gap


@pytest.mark.parametrize("rate", [10.0, 73.1, 100.0, 128.0])
@pytest.mark.parametrize("interval", [0.1, 0.2, 1.0])
@pytest.mark.parametrize("decimals", [3, 6, 12])
def test_every_segment_ends_after_its_start(rate, interval, decimals):
    # Half-way between two samples, by a fast clock, and where attitudes want their own states.
    time = np.round((np.arange(1, round(20 * rate)) + 0.5) / rate * (1.0 + 25e-6), decimals)
    for wanted in (0.0, 0.07):
        samples = SampleBuffer(NOISE)
        samples.add(table(time))
        begin = now = float(time[40])
        states = 0
        while seg := samples.segment_after(now, interval, now + wanted, end=True):
            assert seg.node_time[1] > now
            assert seg.node_time[1] < now + interval + 1.6 / rate
            # Line by line the same clock.
            assert abs(seg.node_time[0] - now) < (1e-4 if now > begin + 5.0 else 6e-4)
            now, states = float(seg.node_time[1]), states + 1
        assert now == pytest.approx(time[-1], abs=1e-3)
        if not wanted:
            assert states <= (now - begin) / interval + 2.0


def test_the_gate_shuts_and_opens():
    gate = Gate()
    rng = np.random.default_rng(0)
    used, message = gate.passes("DVL", rng.normal(size=(50, 3)))
    assert used.all()
    assert not message
    used, _ = gate.passes("DVL", np.array([[7.0, 0, 0]]))
    assert not used.any()
    used, message = gate.passes("DVL", np.full((30, 3), 8.0))
    assert not used.any()
    assert "DVL" in message
    assert gate.shut == {"DVL"}
    for _ in range(60):
        used, message = gate.passes("DVL", rng.normal(size=(1, 3)))
        if message:
            break
    assert "again" in message
    assert not gate.doubted


def test_an_outlier_is_left_out_and_nothing_else():
    gate = Gate()
    rng = np.random.default_rng(0)
    gate.passes("GNSS", rng.normal(size=(50, 3)))
    used, message = gate.passes("GNSS", np.array([[200.0, 0, 0]]))
    assert not used.any()
    assert not message
    used, _ = gate.passes("GNSS", rng.normal(size=(5, 3)))
    assert used.all()
    assert not gate.doubted


def test_a_kind_that_differs_throughout_is_shut_though_none_is_beyond():
    gate = Gate()
    _, message = gate.passes("GNSS", np.full((50, 3), 4.0))
    assert gate.shut == {"GNSS"}
    assert "the last 50 differ from the prediction by 4.0 times" in message


def test_silence_is_that_of_arrivals():
    def heard(time):
        return [Innovations("GNSS", "m", ("e",), np.array([time]), *3 * (np.ones((1, 1)),))]

    silence = Silence()
    # As late as this receiver is: it is not silent.
    assert not [m for t in range(20) for m in silence.listen(t + 8.0, heard(float(t)))]
    assert silence.listen(34.0, []) == ["GNSS: nothing since 19.0 s; the estimate goes on without"]
    assert silence.listen(35.0, heard(20.0)) == ["GNSS: back after 8.0 s"]


def test_the_gate_doubts_innovations_that_are_too_large():
    gate = Gate()
    rng = np.random.default_rng(0)
    used, message = gate.passes("DVL", rng.normal(0.0, 2.0, (50, 3)))
    assert used.all()
    assert "too small" in message
    assert gate.doubted == {"DVL"}


def test_the_gate_leaves_out_echoes_one_by_one():
    gate = Gate()
    rng = np.random.default_rng(0)
    normalised = np.where(rng.random(2000) < 0.2, 40.0, rng.normal(size=2000))
    for value in normalised:
        used, message = gate.passes("range", np.array([[value]]), 3.5)
        assert used.all() == (abs(value) < 3.5)
        assert not message
    assert not gate.doubted
    # A clock that has jumped is another matter.
    messages = [gate.passes("range", np.array([[40.0]]), 3.5)[1] for _ in range(50)]
    assert any("not used until" in text for text in messages)


def test_a_missed_ping_is_no_silence():
    silence = Silence()
    heard = Innovations("range", "m", ("range",), *(np.zeros((1, 1)),) * 3, np.ones(1, dtype=bool))
    said = []
    for now in range(61):
        arrived = now % 5 == 0 and now not in (20, 25)
        each = [replace(heard, time=np.array([float(now)]))] if arrived and now < 40 else []
        said += silence.listen(float(now), each)
    assert said == ["range: nothing since 35.0 s; the estimate goes on without"]


def test_convergence_is_the_last_time_that_a_limit_is_crossed():
    time = np.arange(5.0)
    one = Estimate(
        "scale_error",
        ("scale_error",),
        *(np.array([x]) for x in (0.01, 1e-4, 0.0, 0.1)),
        np.array([True]),
    )
    values = np.array([[0.5], [0.011], [0.02], [0.0101], [0.0102]])
    std = np.array([[1.0], [1e-4], [1e-4], [1e-4], [1e-4]])
    doubted = np.array([False, False, True, False, False])
    limits = {"scale_error": 1e-3}
    truth = {"scale_error": [0.01]}
    found = convergence(time, values, std, doubted, [one], truth, limits, limits)
    (c,) = found.components
    assert (c.std_since, c.error_since, found.good_since) == (1.0, 3.0, 3.0)
    never = convergence(time, values, std + 1.0, doubted, [one], {}, limits, limits)
    assert np.isnan(never.good_since)
    assert np.isnan(never.components[0].error_since)
    assert lacking([one], {"scale_error": 1e-5}) == ("scale_error",)
    assert lacking([one], limits) == ()
    with pytest.raises(ConfigError, match=r"'speed'.*misalignment_deg, scale_error, lever_arm_m"):
        check_limits(simulate(scenario()), ["scale_error", "speed"])


def test_rows_of_a_record_are_joined_in_the_order_of_time():
    dvl = simulate(scenario()).dvl
    parts = [rows_of(dvl, [4]), rows_of(dvl, slice(0, 3)), rows_of(dvl, [1])]
    out = joined(parts)
    np.testing.assert_array_equal(out.time, dvl.time[[0, 1, 2, 4]])
    np.testing.assert_array_equal(out.velocity, dvl.velocity[[0, 1, 2, 4]])
    assert isinstance(out.observations(LocalFrame(0.0, 0.0, 0.0))[0], DvlVelocity)


def test_the_figure_has_every_beam_also_one_that_came_late():
    n = 8
    beams = Estimate(
        "beam_scale_error",
        tuple(f"beam_scale_error_{i + 1}" for i in range(n)),
        *(np.full(n, x) for x in (0.001, 1e-4, 0.0, 0.1)),
        np.full(n, True),
    )
    time = np.arange(20.0)
    values = np.where(time[:, None] < 10.0, np.nan, np.full((20, n), 0.001))
    figure = convergence_figure(time, values, 0.1 * values, [beams], {}, np.nan)
    assert [ax.get_title(loc="left") for ax in figure.axes] == list(beams.component_names)
    assert all(ax.get_ylim()[1] < 0.002 for ax in figure.axes)
