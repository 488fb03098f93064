"""Samples of the IMU as they arrive, and the segments cut from them."""

from __future__ import annotations

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import one_segment, segments
from factorgraph_dvl.imu.propagation import attach
from factorgraph_dvl.replay.samples import SampleBuffer
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.simulation import simulate

NOISE = ImuSettings(
    gyro_noise_deg_sqrt_h=0.001,
    gyro_bias_std_deg_h=0.1,
    accel_noise_ug_sqrt_hz=20,
    accel_bias_std_ug=100,
)


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
    assert samples.rejected == 2


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


@pytest.mark.parametrize("rate", [10.0, 73.1, 128.0])
@pytest.mark.parametrize("interval", [0.1, 1.0])
@pytest.mark.parametrize("decimals", [3, 12])
def test_every_segment_ends_after_its_start(rate, interval, decimals):
    # Half-way between two samples, by a fast clock, and where attitudes want their own states.
    time = np.round((np.arange(1, round(12 * rate)) + 0.5) / rate * (1.0 + 25e-6), decimals)
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
