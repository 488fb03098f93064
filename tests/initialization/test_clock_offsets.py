"""Offsets of the clocks of GNSS and DVL from that of the IMU, before anything is solved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.initialization.carried_windows import carried_windows
from factorgraph_dvl.initialization.clock_offsets import clock_offset, least_misfit, noise_share
from factorgraph_dvl.initialization.dvl_windows import dvl_windows
from factorgraph_dvl.initialization.gnss_windows import gnss_windows
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate

TURNS = [
    {"straight_s": 40},
    {"turn_deg_s": -6, "duration_s": 30, "ramp_s": 4},
    {"straight_s": 50},
    {"turn_deg_s": 8, "duration_s": 30, "ramp_s": 4},
    {"straight_s": 80},
]


@pytest.fixture(scope="module")
def noisy():
    """Four minutes of a vessel that sways and turns."""
    trial = simulate(scenario(noise=True, manoeuvres=TURNS), 1)
    return trial, carried_windows(trial.imu)


def compared(noisy, sensor, late):
    trial, windows = noisy
    record = getattr(trial, sensor)
    moved = replace(record, time=record.time + late(record.time))
    return (gnss_windows if sensor == "gnss" else dvl_windows)(windows, moved)


@pytest.mark.parametrize("sensor", ["gnss", "dvl"])
@pytest.mark.parametrize("offset", [0.0, 0.37, -2.1])
def test_an_offset_is_found_within_its_standard_deviation(noisy, sensor, offset):
    found = clock_offset(compared(noisy, sensor, lambda time: offset))
    assert abs(found.offset - offset) < 5.0 * found.sigma + 0.005
    assert found.sigma < 0.05
    assert (found.rate, found.jump) == (0.0, 0.0)


def test_a_rate_is_found(noisy):
    found = clock_offset(compared(noisy, "dvl", lambda time: 0.1 + 4e-3 * time))
    assert found.rate == pytest.approx(4e-3, abs=5.0 * found.rate_sigma)
    assert found.jump == 0.0
    time = np.array([20.0, 180.0])
    np.testing.assert_allclose(found.late(time), 0.1 + 4e-3 * time, atol=0.05)


def test_a_jump_is_found_with_its_time(noisy):
    found = clock_offset(compared(noisy, "dvl", lambda time: np.where(time > 120.0, 1.0, 0.0)))
    assert found.jump == pytest.approx(1.0, abs=0.05)
    # The vessel turns from 120 to 150 s: within a turn is as well as it shows.
    assert 110.0 < found.jump_time < 150.0
    np.testing.assert_allclose(found.late(np.array([20.0, 200.0])), [0.0, 1.0], atol=0.05)


def test_a_small_jump_is_no_rate(noisy):
    """A rate would explain three quarters of it."""
    found = clock_offset(compared(noisy, "dvl", lambda time: np.where(time > 120.0, 0.3, 0.0)))
    assert found.jump == pytest.approx(0.3, abs=0.03)
    assert found.rate == 0.0
    assert 110.0 < found.jump_time < 150.0


class Sway:
    """A vessel that sways at 2 Hz and speeds up early; its record is 0.1 s late throughout."""

    noise = 0.005

    def __init__(self, lines=slice(None)):
        # A window is 12 s at 5 Hz.
        self.lines = lines
        self.time = (0.2 * np.arange(1200) + 0.05).reshape(20, 60)[lines]
        self.inside = np.ones(self.time.shape, bool)
        self.count = np.full(len(self.time), 180.0)
        self.signal = np.sum((self.velocity(self.time) ** 2), axis=(1, 2))

    def velocity(self, time):
        sway = (1.0 + 0.01 * time) * np.sin(4.0 * np.pi * time)
        speed = np.clip((time - 10.0) / 10.0, 0.0, 1.0)
        return np.stack([sway, 0.5 * sway, speed], axis=-1)

    def only(self, lines):
        return Sway(lines)

    def residual(self, offset):
        late, sooner = self.velocity(self.time - 0.1), self.velocity(self.time + 0.4)
        noise = np.random.default_rng(1).normal(0.0, 0.01, (20, 60, 3))[self.lines]
        # The swell is not quite regular: in the second half it is more as half a second before.
        measured = np.where((self.time > 120.0)[..., None], sooner, late) + noise
        return self.velocity(self.time - np.asarray(offset)) - measured


def test_a_period_of_the_sway_is_no_jump():
    found = clock_offset(Sway())
    assert found.offset == pytest.approx(0.1, abs=0.002)
    assert found.jump == pytest.approx(0.0, abs=0.002)


def test_a_record_of_seconds_says_nothing(noisy):
    trial, windows = noisy
    few = gnss_windows(windows, rows_of(trial.gnss, trial.gnss.time < 30.0))
    assert clock_offset(few) is None


def test_of_what_contradicts_much_is_left(noisy):
    trial, windows = noisy
    right = gnss_windows(windows, trial.gnss)
    swapped = replace(right, velocity=right.velocity[:, [1, 0, 2]])
    left, _ = least_misfit(right, 0.0, 1.0)
    contradicted, _ = least_misfit(swapped, 0.0, 1.0)
    assert left < noise_share(right) + 0.05
    assert contradicted > 0.3
