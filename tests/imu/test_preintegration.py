"""Segments and the motion within them against the exact motion over a rotating Earth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from jacobians import differentiate
from scipy.stats import chi2
from truth import CONING, config, exact_motion, exact_states, scenario

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.geometry.units import DEG, HOUR
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.node_jacobian import by_node
from factorgraph_dvl.imu.gtsam_measurements import gtsam_measurements
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, segments
from factorgraph_dvl.imu.propagation import States, Transition, attach, motion_at, segment_ends
from factorgraph_dvl.sensors.protocol import Linearization
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.simulation.motion import TrueMotion as ExactMotion
from factorgraph_dvl.trial import Trial

DEG_H = DEG / HOUR
BIASES = {"gyro_bias_deg_h": [0.02, -0.03, 0.04], "accel_bias_ug": [50, -60, 70]}
CASES = {
    "swell": {},
    "south": {"start": {"lat_deg": -45.5, "heading_deg": 250}, "imu": BIASES},
    "coning": {"sway": CONING},
    "instantaneous": {"imu": {"sampling": "instantaneous"}},
    "FRD": {"body_axes": "FRD", "start": {"lat_deg": 5, "heading_deg": 170}},
}


@dataclass(frozen=True)
class Case:
    trial: Trial
    exact: ExactMotion
    frame: LocalFrame
    seg: Segments
    states: States
    gravity_n: Array

    @property
    def rate(self):
        return self.frame.earth_rate

    def smooth(self, time, margin=0.03):
        """Times away from steps of rate and force."""
        return np.min(np.abs(time[:, None] - self.exact.kinks), axis=1) > margin

    def pims(self):
        settings = self.trial.imu.settings
        return gtsam_measurements(self.seg, settings, self.gravity_n, self.rate)


def build(**changes):
    scene = scenario(**changes)
    trial = simulate(scene)
    fix = trial.gnss.geodetic[0]
    # 60 km north of the vehicle.
    frame = LocalFrame(fix[0] + 60e3 / 6.37e6, fix[1], 0.0)
    inc, _ = increments(trial.imu)
    seg = segments(inc, 1.0)
    states = exact_states(scene, frame, seg.node_time)
    middle = 0.5 * (states.p_n[seg.origin] + states.p_n[seg.origin + 1])
    gravity_n = frame.gravity_without_rotation(middle)
    return Case(trial, plan_motion(scene), frame, seg, states, gravity_n)


@pytest.fixture(scope="module")
def cases():
    return {name: build(**changes) for name, changes in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_motion_between_nodes_is_the_exact_motion(cases, name):
    case = cases[name]
    t = np.random.default_rng(0).uniform(0.01, 69.9, 2000)
    t = t[case.smooth(t, 0.05)]
    found = motion_at(attach(case.seg, t, case.rate), case.states, case.gravity_n, case.rate)
    true = exact_motion(case.exact, case.frame, t)
    worst = {
        "attitude": np.abs(log_so3(found.nRb.transpose(0, 2, 1) @ true.nRb)).max(),
        "velocity": np.abs(found.v_n - true.v_n).max(),
        "position": np.abs(found.p_n - true.p_n).max(),
        "rate": np.abs(found.omega_eb_b - true.omega_eb_b).max(),
        "acceleration": np.abs(found.a_n - true.a_n).max(),
        "alpha": np.abs(found.alpha_b - true.alpha_b).max(),
    }
    limit = {
        # 7e-15 in a swell; the polynomial's 2e-9 in coning at 2 Hz.
        "attitude": 5e-9 if name == "coning" else 1e-12,
        # Gravity turns by 3e-7 rad within the 2 m on both sides of where it was taken:
        # 3e-6 m/s², for half a second at most.
        "velocity": 1e-6,
        # Constant force within a sample, and biases that act as if the segment did not
        # turn: 1.5e-5 m where there are any.
        "position": 2e-5 if "imu" in CASES[name] and name == "south" else 6e-6,
        # Smoothed as far as noise hides it: that of a sample is 1.5e-6 rad/s and 2.5e-3 m/s²;
        # the force also over the window beside a step of it. Only slopes are made of it.
        "rate": 5e-7,
        "acceleration": 0.05,
        "alpha": 3e-4,
    }
    assert {k: v for k, v in worst.items() if v >= limit[k]} == {}


def test_the_end_of_a_segment_is_the_next_node(cases):
    case = cases["swell"]
    at = segment_ends(case.seg, case.rate)
    np.testing.assert_allclose(at.tau, case.seg.duration, atol=1e-9)
    ends = motion_at(at, case.states, case.gravity_n, case.rate)
    after = case.seg.origin + 1
    turned = log_so3(ends.nRb.transpose(0, 2, 1) @ case.states.nRb[after])
    assert np.abs(turned).max() < 1e-10
    assert np.abs(ends.v_n - case.states.v_n[after]).max() < 2e-7


def blocks(transition):
    """Attitude, position, velocity and rate at the times by node and bias, (M, 12, 15)."""
    m = transition.at.node.size
    eye, zero = np.broadcast_to(np.eye(3), (m, 3, 3)), np.zeros((m, 3))
    parts = []
    for name in ("d_theta", "d_p", "d_v", "d_omega"):
        state, bias = by_node(Linearization(zero, **{name: eye}), transition)
        parts.append(np.concatenate([*state, *bias], axis=2))
    return np.concatenate(parts, axis=1)


def retracted(states, h):
    """Return states after GTSAM's retraction of every node and bias by h, (15,)."""
    out = [
        gtsam.NavState(gtsam.Rot3(R), p, v).retract(h[:9])
        for R, p, v in zip(states.nRb, states.p_n, states.v_n, strict=True)
    ]
    bias = gtsam.imuBias.ConstantBias(states.accel_bias[0], states.gyro_bias[0]).retract(h[9:])
    zero = np.zeros_like(states.p_n)
    return States(
        np.stack([s.attitude().matrix() for s in out]),
        np.stack([s.position() for s in out]),
        np.stack([s.velocity() for s in out]),
        zero + bias.gyroscope(),
        zero + bias.accelerometer(),
    )


@pytest.mark.parametrize("name", ["south", "coning"])
def test_derivatives_by_node_and_bias(cases, name):
    case = cases[name]
    # 1 deg/h and 1 mg: large biases, for the sake of the cross terms.
    states = replace(
        case.states,
        gyro_bias=case.states.gyro_bias + np.array([1, -2, 3]) * DEG_H,
        accel_bias=case.states.accel_bias + 0.01,
    )
    at = attach(case.seg, np.linspace(3.0, 67.0, 30) + 0.0037, case.rate)
    motion = motion_at(at, states, case.gravity_n, case.rate)
    analytic = blocks(Transition(at, states, motion, case.rate))

    def perturbed(h):
        now = motion_at(at, retracted(states, h), case.gravity_n, case.rate)
        return np.concatenate(
            [
                log_so3(motion.nRb.transpose(0, 2, 1) @ now.nRb),
                now.p_n - motion.p_n,
                now.v_n - motion.v_n,
                now.omega_eb_b - motion.omega_eb_b,
            ],
            axis=1,
        )

    error = np.abs(analytic - differentiate(perturbed, 15, 1e-5))
    columns = {"theta": 0, "p": 3, "v": 6, "accel": 9, "gyro": 12}
    limits = {
        # Exact; positions of 60 km leave central differences with 1e-6. Velocity by
        # position is the centrifugal w² tau = 5e-9 per s, and is left out. Velocity by the
        # biases lacks the Earth rate times position by bias: 4e-5 of 2 m/s per rad/s.
        "theta": {"theta": 1e-10, "p": 1e-9, "v": 1e-9, "accel": 1e-9, "gyro": 1e-5},
        "p": dict.fromkeys(columns, 2e-6),
        "v": {"theta": 1e-9, "p": 1e-8, "v": 1e-9, "accel": 3e-5, "gyro": 1e-4},
        "omega": {"theta": 1e-9, "p": 1e-9, "v": 1e-9, "accel": 1e-9, "gyro": 1e-8},
    }
    for i, (row, by) in enumerate(limits.items()):
        for column, limit in by.items():
            block = error[:, 3 * i : 3 * i + 3, columns[column] : columns[column] + 3]
            assert block.max() < limit, f"{row} by {column}: {block.max():.1e}"


@pytest.mark.parametrize("name", ["swell", "coning"])
def test_biases_act_as_if_taken_from_the_samples(cases, name):
    case = cases[name]
    gyro, accel = np.array([1.0, -2.0, 3.0]) * DEG_H, np.array([1e-3, -2e-3, 1e-3])
    imu = replace(case.trial.imu, gyro=case.trial.imu.gyro + gyro)
    imu = replace(imu, accel=imu.accel + accel)
    biased = segments(increments(imu)[0], 1.0)
    zero = np.zeros_like(case.states.p_n)
    states = replace(case.states, gyro_bias=zero + gyro, accel_bias=zero + accel)
    t = np.random.default_rng(0).uniform(0.01, 69.9, 1000)
    t = t[case.smooth(t, 0.05)]
    found = motion_at(attach(biased, t, case.rate), states, case.gravity_n, case.rate)
    true = motion_at(attach(case.seg, t, case.rate), case.states, case.gravity_n, case.rate)
    # 3 deg/h are 1.5e-5 rad in a second, 2e-3 m/s² are 2e-3 m/s and 1e-3 m. The
    # approximation, rate and force constant in a segment, misses a few percent of that.
    assert np.abs(log_so3(found.nRb.transpose(0, 2, 1) @ true.nRb)).max() < 1e-6
    assert np.abs(found.v_n - true.v_n).max() < 2e-5
    assert np.abs(found.p_n - true.p_n).max() < 1e-4
    np.testing.assert_allclose(found.omega_eb_b, true.omega_eb_b, atol=1e-6)


def nav_state(states, k):
    return gtsam.NavState(gtsam.Rot3(states.nRb[k]), states.p_n[k], states.v_n[k])


def imu_errors(case):
    bias = gtsam.imuBias.ConstantBias(case.states.accel_bias[0], case.states.gyro_bias[0])
    return np.array(
        [
            gtsam.GalileanImuFactor2(0, 1, 2, pim).evaluateError(
                nav_state(case.states, k), nav_state(case.states, k + 1), bias
            )
            for k, pim in zip(case.seg.origin.tolist(), case.pims(), strict=True)
        ]
    )


@pytest.mark.parametrize("name", CASES)
def test_imu_factors_have_zero_error_at_the_truth(cases, name):
    case = cases[name]
    time = case.seg.node_time
    steady = case.smooth(0.5 * (time[1:] + time[:-1]), 0.6)
    error = imu_errors(case)[steady]
    # Attitude: the mean error per second is the gyro bias that the solver would find.
    drift = np.abs(error[:, :3].mean(axis=0)).max() / DEG_H
    assert drift < (3e-4 if name == "coning" else 1e-5)
    assert np.abs(error[:, :3]).max() < 1e-9
    # GTSAM's order is attitude, position, velocity. An accelerometer of 25 ug/sqrt(Hz)
    # leaves 1.4e-4 m and 2.5e-4 m/s in a second.
    assert np.abs(error[:, 3:6]).max() < 1e-5
    assert np.abs(error[:, 6:]).max() < 5e-7
    micro_g = np.abs(error[:, 6:].mean(axis=0)).max() / 9.8e-6
    assert micro_g < 0.02


@pytest.mark.parametrize(("name", "samples_of_a_stride"), [("coning", 4), ("south", 12)])
def test_strides_lead_where_samples_do(cases, name, samples_of_a_stride, monkeypatch):
    case = cases[name]
    assert case.seg.stride == samples_of_a_stride
    strides = case.pims()
    few = case.seg.increments.dt.size + 1
    monkeypatch.setattr("factorgraph_dvl.imu.gtsam_measurements._FEW", few)
    samples = case.pims()
    # Far more than is left of a bias: what it does is compared, too.
    bias = gtsam.imuBias.ConstantBias(np.full(3, 1e-2), np.full(3, 1e-5))
    at = gtsam.NavState()
    for one, other in zip(strides, samples, strict=True):
        apart = one.predict(at, bias).localCoordinates(other.predict(at, bias))
        assert np.abs(apart[:3]).max() < 1e-9
        assert np.abs(apart[3:6]).max() < 1e-6
        assert np.abs(apart[6:]).max() < 2e-7
        P, Q = one.preintMeasCov(), other.preintMeasCov()
        np.testing.assert_allclose(np.linalg.solve(Q, P), np.eye(9), atol=1e-3)


def test_imu_factor_residual_is_predicted_minus_state(cases):
    case = cases["swell"]
    k = 30
    bias = gtsam.imuBias.ConstantBias()
    factor = gtsam.GalileanImuFactor2(0, 1, 2, case.pims()[k])
    before, after = nav_state(case.states, k), nav_state(case.states, k + 1)
    for i in range(9):
        h = np.zeros(9)
        h[i] = 1e-3
        change = factor.evaluateError(before, after.retract(h), bias)
        change -= factor.evaluateError(before, after, bias)
        np.testing.assert_allclose(change, -h, atol=1e-6)


def test_preintegrated_covariance_is_that_of_noisy_samples():
    # MEMS noise, so that it stands out of rounding.
    noisy = {"gyro_noise_deg_sqrt_h": 0.3, "accel_noise_ug_sqrt_hz": 100}
    case = build(imu=noisy, sway=CONING)
    k = 40
    keep = (case.trial.imu.time > 39.9) & (case.trial.imu.time < 41.2)
    imu = case.trial.imu
    record = replace(imu, time=imu.time[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    first = int(np.flatnonzero(np.isclose(record.time, case.seg.node_time[k]))[0]) + 1
    last = first + 100
    rng = np.random.default_rng(0)
    sigma = (
        imu.settings.gyro_noise_root_psd / 0.1,
        imu.settings.accel_noise_root_psd / 0.1,
    )
    covariance = case.pims()[k].preintMeasCov()

    def ends(r):
        inc, _ = increments(r)
        phi, dv = inc.over(np.arange(first, last))
        pim = gtsam.PreintegratedImuMeasurementsG(gtsam.PreintegrationParams(np.zeros(3)))
        rate, mean = phi / 0.01, dv / 0.01
        once = np.cross(phi, mean)
        force = mean - once / 2.0 + np.cross(phi, once) / 12.0
        for f, w in zip(force, rate, strict=True):
            pim.integrateMeasurement(f, w, 0.01)
        return pim.deltaXij()

    true = ends(record)
    runs = 300
    errors = np.empty((runs, 9))
    for i in range(runs):
        gyro = record.gyro + rng.normal(0.0, sigma[0], record.gyro.shape)
        accel = record.accel + rng.normal(0.0, sigma[1], record.accel.shape)
        errors[i] = true.localCoordinates(ends(replace(record, gyro=gyro, accel=accel)))
    nees = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(covariance), errors)
    low, high = chi2.ppf([0.0005, 0.9995], 9 * runs) / runs
    assert low < nees.mean() < high
    ratio = errors.std(axis=0) / np.sqrt(np.diag(covariance))
    assert np.all((ratio > 0.85) & (ratio < 1.15))


def test_few_numbers_are_kept_for_each_sample(cases):
    seg = cases["swell"].seg
    imu, inc = cases["swell"].trial.imu, seg.increments
    assert np.shares_memory(inc.rate, imu.gyro)
    assert np.shares_memory(inc.force, imu.accel)
    kept = [*vars(seg.knots).values(), *vars(seg.ends).values(), seg.less]
    # A double for each of 27 numbers at every fourth sample, and of 24 at every hundredth.
    assert sum(each.nbytes for each in kept) < 60 * imu.time.size


@pytest.mark.parametrize("name", ["coning", "instantaneous"])
def test_what_adds_up_to_any_sample_is_what_samples_one_by_one_add_up_to(cases, name, monkeypatch):
    seg = cases[name].seg
    monkeypatch.setattr("factorgraph_dvl.imu.preintegration._STRIDE", 0.01)
    # Blocks of some segments each.
    monkeypatch.setattr("factorgraph_dvl.imu.preintegration._CHUNK", 450)
    each = segments(seg.increments, 1.0)
    assert (seg.spacing, each.spacing) == (4, 1)
    index = np.arange(seg.first[0], seg.last[-1])
    some, every = seg.since_start(index), each.since_start(index)
    for name_, values in vars(some).items():
        np.testing.assert_allclose(values, getattr(every, name_), atol=1e-14, err_msg=name_)
    np.testing.assert_allclose(seg.ends.dP, each.ends.dP, atol=1e-14)
    np.testing.assert_allclose(seg.less.sum(axis=0), each.less.sum(axis=0), rtol=1e-12)


def test_samples_left_open_widen_the_covariance():
    case = build(sway=CONING)
    imu = case.trial.imu
    keep = np.ones(imu.time.size, dtype=bool)
    keep[4050:4053] = False
    imu = replace(imu, time=imu.time[keep], gyro=imu.gyro[keep], accel=imu.accel[keep])
    inc, _ = increments(imu)
    seg = segments(inc, 1.0)
    wide = gtsam_measurements(seg, imu.settings, case.gravity_n, case.rate)
    narrow = case.pims()
    for k in range(len(narrow)):
        ratio = np.sqrt(np.diag(wide[k].preintMeasCov()) / np.diag(narrow[k].preintMeasCov()))
        if seg.node_time[k] < 40.51 < seg.node_time[k + 1]:
            expected = np.sqrt(np.sum((inc.open_sigma * 0.01)[:, :3] ** 2))
            found = np.sqrt(wide[k].preintMeasCov()[0, 0])
            assert found == pytest.approx(expected, rel=0.01)
            assert ratio[0] > 100.0
        else:
            np.testing.assert_allclose(ratio, 1.0, rtol=1e-6)


def test_gtsams_default_preintegration_would_not_do(cases):
    # The reason for the Galilean kind: the other one integrates in the tangent space of
    # the segment's start, with an error of first order in the sample time.
    case = cases["coning"]
    drift = []
    for k in range(40, 60):
        part = np.arange(case.seg.first[k], case.seg.last[k])
        dt, increments_over = case.seg.increments.dt[part], case.seg.increments.over(part)
        params = gtsam.PreintegrationParams(case.gravity_n[k])
        turned = {}
        for kind in (gtsam.PreintegratedImuMeasurements, gtsam.PreintegratedImuMeasurementsG):
            pim = kind(params)
            for phi, dv, h in zip(*increments_over, dt, strict=True):
                pim.integrateMeasurement(dv / h, phi / h, h)
            turned[kind] = pim.deltaRij().matrix()
        default, galilean = turned.values()
        drift.append(log_so3(galilean.T @ default) / case.seg.duration[k])
    # Measured: 6 deg/h in yaw and 5 deg/h in pitch on average.
    assert np.linalg.norm(np.mean(drift, axis=0)) / DEG_H > 1.0


def test_nodes_at_the_interval_asked_for(cases):
    inc = cases["swell"].seg.increments
    length = inc.end[-1] - inc.start[0]
    for interval, count in ((1.0, 78), (0.25, 312), (5.0, 16), (1000.0, 1)):
        seg = segments(inc, interval)
        assert seg.first.size == count
        np.testing.assert_allclose(seg.duration, length / count, atol=0.011)
        assert seg.last[-1] == inc.dt.size


def test_nodes_stand_just_before_the_epochs_asked_for():
    inc, _ = increments(simulate(config("star", manoeuvres=[{"straight_s": 20}])).imu)
    first = inc.start[0]
    # In the middle of a sample; on one but for rounding; outside.
    epochs = np.array([first + 3.2101, inc.start[400] - 1e-9, inc.start[600], 1e4])
    seg = segments(inc, 1.0, epochs)
    at = attach(seg, epochs[:3], np.zeros(3))
    assert np.abs(at.tau).max() < 0.02
    assert np.abs(at.tau[1:]).max() < 1e-8
    lengths = np.diff(seg.node_time)
    assert lengths.max() < 1.51
    assert seg.node_time.size < 25
    np.testing.assert_array_equal(
        segments(inc, 1.0, np.empty(0)).node_time.size, segments(inc, 1.0).node_time.size
    )
