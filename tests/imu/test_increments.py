"""Increments between IMU samples: coning and sculling, clocks, lost samples, gaps, steps."""

from __future__ import annotations

import numpy as np
import pytest
from findings import of_code
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG, HOUR
from factorgraph_dvl.geometry.vectors import rotate
from factorgraph_dvl.imu.increments import increments, unbroken_increments
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.imu import Imu, ImuSettings

GRAVITY = np.array([0.0, 0.0, -9.8])
DEG_H = DEG / HOUR
AMPLITUDE = 4.0 * DEG
FREQUENCY = 2.0 * np.pi * 2.0
# Linear and angular vibration in phase, with a mean force of its own: sculling.
SURGE = np.array([2.0, 0.0, 0.0])


def attitude(t):
    """Roll and pitch of 4 deg in quadrature at 2 Hz."""
    roll, pitch = AMPLITUDE * np.sin(FREQUENCY * t), AMPLITUDE * np.cos(FREQUENCY * t)
    return Rotation.from_euler("ZYX", np.stack([0.0 * t, pitch, roll], axis=1)).as_matrix()


def rate(t):
    """The kinematic equation of these angles; the yaw does not turn."""
    roll = AMPLITUDE * np.sin(FREQUENCY * t)
    roll_rate = AMPLITUDE * FREQUENCY * np.cos(FREQUENCY * t)
    pitch_rate = -AMPLITUDE * FREQUENCY * np.sin(FREQUENCY * t)
    return np.stack([roll_rate, pitch_rate * np.cos(roll), -pitch_rate * np.sin(roll)], axis=1)


def force(t):
    accelerated = GRAVITY + SURGE * np.sin(FREQUENCY * t)[:, None]
    return rotate(attitude(t).transpose(0, 2, 1), accelerated)


def velocity(t):
    return t[:, None] * GRAVITY - SURGE * np.cos(FREQUENCY * t)[:, None] / FREQUENCY


def mean_over(signal, edges):
    nodes, weights = np.polynomial.legendre.leggauss(8)
    width = np.diff(edges)
    t = edges[:-1, None] + 0.5 * width[:, None] * (nodes + 1.0)
    return 0.5 * np.einsum("q,mqi->mi", weights, signal(t.ravel()).reshape(*t.shape, 3))


def settings(**changes):
    return ImuSettings(
        **{
            "gyro_noise_deg_sqrt_h": 0.0005,
            "gyro_bias_std_deg_h": 0.05,
            "accel_noise_ug_sqrt_hz": 25.0,
            "accel_bias_std_ug": 100.0,
        }
        | changes
    )


def record(edges, sampling="mean", gyro=rate, accel=force):
    """Return the IMU whose samples end at edges[1:]."""
    edges = np.asarray(edges, dtype=float)
    if sampling == "mean":
        data = mean_over(gyro, edges), mean_over(accel, edges)
    else:
        data = gyro(edges[1:]), accel(edges[1:])
    return Imu(settings(sampling=sampling), edges[1:], *data)


def without(imu, lost):
    keep = np.ones(imu.time.size, dtype=bool)
    keep[lost] = False
    return Imu(imu.settings, imu.time[keep], imu.gyro[keep], imu.accel[keep])


def integrate(phi, dv, R, V):
    for turn, step in zip(exp_so3(phi), dv, strict=True):
        V = V + R @ step
        R = R @ turn
    return R, V


def errors_over(inc):
    """Return attitude (rad) and velocity errors (m/s) over the first arc, and its length.

    From its second interval on: the length of the first is nowhere in a record of means.
    """
    a, b = inc.arcs[0] + [1, 0]
    phi, dv = inc.over(np.arange(a, b))
    ends = np.array([inc.start[a], inc.end[b - 1]])
    R, V = integrate(phi, dv, attitude(ends[:1])[0], velocity(ends[:1])[0])
    turned = log_so3(R @ attitude(ends[1:])[0].T)
    return turned, V - velocity(ends[1:])[0], float(ends[1] - ends[0])


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
@pytest.mark.parametrize(("hertz", "drift"), [(50, 0.015), (100, 3e-4), (200, 5e-6)])
def test_coning_and_sculling_vanish(sampling, hertz, drift):
    imu = record(np.arange(30 * hertz + 1) / hertz, sampling)
    inc, findings = increments(imu)
    assert findings == ()
    turned, drifted, length = errors_over(inc)
    # Measured at 100 Hz: 1.6e-4 deg/h; it falls with the sixth power of the interval, as
    # the error of polynomials through five or six samples does.
    assert np.abs(turned).max() / length / DEG_H < drift
    # Sculling and coning of a 2 m/s² surge: 1e-8 m/s² is a thousandth of a micro-g.
    assert np.abs(drifted).max() / length < 2e-7 * drift / 3e-4 + 1e-10


def test_coning_left_alone_is_seventeen_degrees_per_hour():
    imu = record(np.arange(3001) / 100.0)
    R, _ = integrate(imu.gyro * 0.01, imu.accel * 0.01, attitude(np.zeros(1))[0], np.zeros(3))
    yaw = log_so3(R @ attitude(imu.time[-1:])[0].T)[2] / 30.0 / DEG_H
    # Half the solid angle that is swept between two samples: 17 deg/h.
    assert 16.0 < abs(yaw) < 18.0


@pytest.mark.parametrize(("sampling", "drift"), [("mean", 2e-3), ("instantaneous", 2e-3)])
def test_irregular_samples(sampling, drift):
    rng = np.random.default_rng(0)
    edges = np.arange(3001) / 100.0
    edges[1:-1] += rng.uniform(-0.003, 0.003, 2999)
    inc, findings = increments(record(edges, sampling))
    assert findings == ()
    assert np.all(inc.open_sigma == 0.0)
    turned, drifted, length = errors_over(inc)
    assert np.abs(turned).max() / length / DEG_H < drift
    assert np.abs(drifted).max() / length < 1e-6


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
def test_motion_within_an_interval(sampling):
    inc, _ = increments(record(np.arange(1001) / 100.0, sampling))
    t = np.random.default_rng(1).uniform(0.1, 9.9, 2000)
    index, since, covered = inc.locate(t)
    assert covered.all()
    part = inc.partial(index, since)
    start = attitude(inc.start[index])
    turned = log_so3(exp_so3(part.phi).transpose(0, 2, 1) @ start.transpose(0, 2, 1) @ attitude(t))
    # Polynomials of degree four between samples of a 2 Hz motion: 2e-9 rad, 2e-7 rad/s.
    assert np.abs(turned).max() < 1e-8
    assert np.abs(part.omega - rate(t)).max() < 5e-7
    step = 1e-5
    alpha = (rate(t + step) - rate(t - step)) / (2.0 * step)
    assert np.abs(part.alpha - alpha).max() < 5e-4
    # The force is smoothed as far as its noise of 2.5e-3 m/s² hides what that takes away.
    assert np.abs(part.force - force(t)).max() < 2.5e-3
    gained = rotate(start.transpose(0, 2, 1), velocity(t) - velocity(inc.start[index]))
    assert np.abs(part.dv - gained).max() < 2e-8


def test_what_was_smoothed_and_freed_is_the_same(monkeypatch):
    inc, _ = increments(record(np.arange(1001) / 100.0))
    index, since = np.arange(100, 900), np.full(800, 0.004)
    expected = inc.partial(index, since)
    rates, forces = inc.smoothed[0]
    if rates.spline is not None and forces.spline is not None:
        assert forces.spline.t is rates.spline.t
    monkeypatch.setattr("factorgraph_dvl.imu.increments._KEPT", 0)
    inc.release()
    assert "smoothed" not in vars(inc)
    found = inc.partial(index, since)
    np.testing.assert_array_equal(found.omega, expected.omega)
    np.testing.assert_array_equal(found.force, expected.force)


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
def test_a_part_is_smoothed_with_what_is_beside_it(sampling):
    imu = record(np.arange(101) / 100.0, sampling)
    samples = imu.settings, imu.time, imu.gyro, imu.accel, (11, 25)
    whole, part = (unbroken_increments(*samples, rows) for rows in (slice(None), slice(40, 70)))
    time = np.random.default_rng(1).uniform(imu.time[48], imu.time[61], 20)
    expected, found = (inc.partial(*inc.locate(time)[:2]) for inc in (whole, part))
    known = {name: values for name, values in vars(expected).items() if values is not None}
    assert known.keys() == {name for name, values in vars(found).items() if values is not None}
    for name, values in known.items():
        np.testing.assert_allclose(getattr(found, name), values, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
@pytest.mark.parametrize("at", [1.0, 1.003, 1.0099])
def test_a_step_of_the_rate_does_not_ring(sampling, at):
    def stepping(t):
        return np.where(t > at, 0.1, 0.0)[:, None] * [0.0, 0.3, 1.0]

    def still(t):
        return np.zeros((t.size, 3)) + GRAVITY

    edges = np.arange(201) / 100.0
    imu = record(edges, sampling, stepping, still)
    if sampling == "mean":
        # Exact means over the interval that holds the step.
        inside = np.clip((edges[1:] - at) / 0.01, 0.0, 1.0)
        imu = Imu(imu.settings, imu.time, 0.1 * inside[:, None] * [0.0, 0.3, 1.0], imu.accel)
    inc, _ = increments(imu)
    middle = inc.start + 0.5 * inc.dt
    away = np.abs(middle - at) > 0.0151
    part = inc.partial(np.flatnonzero(away), 0.5 * inc.dt[away])
    # Centred polynomials of degree four are off by 5 % of the step two intervals away.
    assert np.abs(part.omega - stepping(middle[away])).max() < 1e-12
    assert np.abs(part.omega_sigma).max() < 0.1
    phi, _ = inc.over(np.arange(inc.dt.size))
    swept = 0.1 * max(inc.end[-1] - at, 0.0)
    miss = abs(phi[:, 2].sum() - swept)
    if sampling == "mean":
        assert miss < 1e-13
    else:
        # Nobody knows when, between two samples, it happened. The polynomial from the
        # smoother side puts two thirds of the step into the interval; the increments admit
        # to the spread of a uniform distribution.
        assert miss < 0.1 * 0.01 * 0.67
        worst = float((inc.open_sigma[:, 2] * inc.dt).max())
        assert worst == pytest.approx(0.1 * 0.01 / np.sqrt(12.0), rel=1e-6)


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
def test_the_rate_is_continuous_over_the_edges(sampling):
    def rough(t):
        return rate(t) + np.where(t > 1.003, 0.1, 0.0)[:, None]

    inc, _ = increments(record(np.arange(201) / 100.0, sampling, rough))
    inner = np.arange(1, inc.dt.size)
    step = 1e-9
    before = inc.partial(inner - 1, inc.dt[inner - 1] - step)
    after = inc.partial(inner, np.full(inner.size, step))
    # At the step the slope reaches 0.1 rad/s in half an interval: 2e-8 rad/s in 2 ns.
    assert np.abs(after.omega - before.omega).max() < 1e-6
    # The derivative that goes with it is that of this rate.
    index = np.repeat(np.arange(5, 195), 4)
    since = np.tile([0.0021, 0.0043, 0.0061, 0.0087], 190)
    h = 1e-7
    slope = (inc.partial(index, since + h).omega - inc.partial(index, since - h).omega) / (2.0 * h)
    assert np.abs(slope - inc.partial(index, since).alpha).max() < 1e-5


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
@pytest.mark.parametrize("lost", [[1000], [1000, 1001], [1000, 1001, 1002]])
def test_a_few_lost_samples_are_interpolated(sampling, lost):
    imu = record(np.arange(2001) / 100.0, sampling)
    inc, findings = increments(without(imu, [*lost, 1500]))
    assert len(inc.arcs) == 1
    assert inc.dt.size == (2000 if sampling == "mean" else 1999)
    (text,) = of_code(findings, Code.LOST_SAMPLES)
    assert f"{len(lost) + 1} lost samples in 2 places" in text
    first = lost[0] if sampling == "mean" else lost[0] - 1
    opened = np.flatnonzero(inc.open_sigma.any(axis=1))
    expected = [*range(first, first + len(lost)), 1500 if sampling == "mean" else 1499]
    assert opened.tolist() == expected
    turned, _, _ = errors_over(inc)
    sigma = np.linalg.norm(inc.open_sigma[:, :3] * inc.dt[:, None])
    assert np.linalg.norm(turned) < 3.0 * sigma
    # What is lost of a 2 Hz motion in 30 ms, and no more.
    assert np.linalg.norm(turned) < 0.05 * DEG


@pytest.mark.parametrize("sampling", ["mean", "instantaneous"])
def test_a_gap_breaks_the_chain_and_says_where(sampling):
    imu = record(np.arange(2001) / 100.0, sampling)
    inc, findings = increments(without(imu, range(1000, 1004)))
    assert len(inc.arcs) == 2
    (text,) = of_code(findings, Code.IMU_GAP)
    # The last sample before is that at 10.00 s; the mean at 10.05 s begins at 10.04 s.
    length = 0.04 if sampling == "mean" else 0.05
    assert text == f"IMU: gap of {length:.3f} s at 10.000 s: the inertial chain breaks there"
    index, _, covered = inc.locate(np.array([9.995, 10.02, 10.06, 19.99, 20.5]))
    assert covered.tolist() == [True, False, True, True, False]
    assert inc.arc_of[index].tolist() == [0, 0, 1, 1, 1]
    # Polynomials do not reach over the gap.
    part = inc.partial(index[[0, 2]], np.array([0.005, 0.005]))
    t = inc.start[index[[0, 2]]] + 0.005
    assert np.abs(part.omega - rate(t)).max() < 1e-4


def test_samples_between_two_gaps_are_dropped_and_said_so():
    imu = record(np.arange(2001) / 100.0)
    inc, findings = increments(without(imu, [*range(500, 600), *range(605, 700)]))
    assert len(inc.arcs) == 2
    assert [f.code for f in findings] == [Code.UNUSED, Code.IMU_GAP]
    assert findings[0].text.startswith("5 samples at 6.010 s")
    assert "at 5.000 s" in findings[1].text


def test_records_that_are_too_short_are_refused():
    imu = record(np.arange(6) / 100.0)
    with pytest.raises(DataError, match="only 5 samples"):
        increments(imu)
    long = record(np.arange(101) / 100.0)
    sparse = without(long, [i for i in range(100) if i % 20 >= 5])
    with pytest.raises(DataError, match="no stretch without gaps"):
        increments(sparse)


@pytest.mark.parametrize(("rate_hz", "decimals", "epoch"), [(128.0, 3, 0.0), (100.0, 9, 1.7e9)])
def test_rounded_time_stamps_are_not_taken_for_jitter(rate_hz, decimals, epoch):
    edges = np.arange(0.0, 20.0, 1.0 / rate_hz)
    exact = record(edges)
    stamped = Imu(exact.settings, np.round(exact.time + epoch, decimals), exact.gyro, exact.accel)
    found, true = increments(stamped)[0], increments(exact)[0]
    every = np.arange(true.start.size)
    # Each increment to the noise of a good gyro in a sample; by milliseconds it is 2e-4 rad.
    np.testing.assert_allclose(found.over(every)[0], true.over(every)[0], atol=2e-8)
    assert np.ptp(found.dt) < 1e-3 / rate_hz
