"""Velocities of a sensor in the windows of the carried IMU."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.initialization.carried_windows import CarriedWindows
from factorgraph_dvl.initialization.velocity_windows import VelocityWindows, sorted_into, steady


@pytest.fixture
def windows() -> CarriedWindows:
    """Two windows of 20 s with a gap between them, at rest in axes of the start."""
    n = 50
    zero = np.zeros((2, n, 3))
    turn = np.tile(np.eye(3), (2, n, 1, 1))
    start = np.array([5.0, 40.0])
    return CarriedWindows(start, 20.0, start - 2.0, 0.5, turn, zero, zero, zero)


def of(windows: CarriedWindows, time: np.ndarray, velocity: np.ndarray) -> VelocityWindows:
    table = sorted_into(windows, time)
    assert table is not None
    return VelocityWindows(windows, time, velocity, np.full(time.size, 0.1), *table)


def test_times_go_into_their_window(windows):
    time = np.arange(0.0, 50.0)
    rows, inside, window = sorted_into(windows, time)
    assert window.tolist() == [0, 1]
    assert time[rows[0][inside[0]]].tolist() == list(range(5, 25))
    assert time[rows[1][inside[1]]].tolist() == list(range(40, 50))
    # The shorter one is filled up with what is in it.
    assert rows.shape == (2, 20)
    assert set(rows[1]) == set(range(40, 50))


def test_a_window_with_few_is_left_out(windows):
    rows, inside, window = sorted_into(windows, np.arange(0.0, 49.0))
    assert window.tolist() == [0]
    assert inside.all()
    assert rows.shape == (1, 20)
    assert sorted_into(windows, np.arange(25.0, 40.0)) is None


def test_a_parabola_is_taken_out_of_each_window_and_nothing_else(windows):
    time = np.arange(0.0, 50.0)
    t = time[:, None]
    parabola = np.where(t < 30.0, 1.0 + 0.2 * t - 0.01 * t**2, -3.0 + 0.05 * t**2)
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 1.0, (time.size, 3))
    there = of(windows, time, noise)
    left = there.without_trend(there.velocity[there.rows])
    again = of(windows, time, parabola + noise)
    kept = again.without_trend(again.velocity[again.rows])
    np.testing.assert_allclose(kept, left, atol=1e-9)
    assert not kept[~again.inside].any()
    # Three unknowns for each component.
    squares = np.sum(left**2) / there.freedom(9).sum()
    assert 0.6 < squares < 1.5


def test_some_of_the_windows(windows):
    whole = of(windows, np.arange(0.0, 50.0), np.zeros((50, 3)))
    part = whole.only(np.array([1]))
    assert part.window.tolist() == [1]
    np.testing.assert_array_equal(part.time, whole.time[1:])
    np.testing.assert_array_equal(part.freedom(9), whole.freedom(9)[1:])
    assert part.noise == whole.noise == 0.1


def test_a_late_stamp_is_carried_to_its_true_time(windows):
    """A surge, on top of the mean force of gravity."""
    time = 0.5 * np.arange(50.0)
    surge = 3.0 * np.sin(2.0 * np.pi * time / 24.5)
    speed = np.tile((9.8 * time + surge)[:, None], (2, 1, 3))
    zero = np.zeros_like(speed)
    carried = CarriedWindows(
        windows.start, 20.0, windows.begin, 0.5, windows.turn, speed, zero, zero
    )
    there = of(carried, np.arange(0.0, 50.0), np.zeros((50, 3)))
    shift = there.carried(0.0).speed - there.carried(0.5).speed
    since = there.time - there.windows.begin[there.window][:, None]
    expected = np.interp(since, time, surge) - np.interp(since - 0.5, time, surge)
    np.testing.assert_allclose(shift, np.repeat(expected[..., None], 3, axis=2), atol=1e-9)


def test_gravity_makes_no_step_where_a_clock_jumps(windows):
    """Neither in the velocity, nor in its mean between two stamps."""
    time = 0.5 * np.arange(50.0)
    fallen = np.tile((9.8 * time)[:, None], (2, 1, 3))
    place = np.tile((4.9 * time**2)[:, None], (2, 1, 3))
    carried = CarriedWindows(
        windows.start, 20.0, windows.begin, 0.5, windows.turn, fallen, place, 0.0 * fallen
    )
    stamp = np.arange(0.0, 50.0)
    there = of(carried, stamp, np.zeros((50, 3)))
    jump = np.where(there.time > 12.0, 1.0, 0.0)
    np.testing.assert_allclose(there.carried(jump).speed, there.carried(0.0).speed, atol=1e-9)
    means = [
        there.carried(late, stamp + 0.5).place - there.carried(late, stamp).place
        for late in (0.0, jump)
    ]
    np.testing.assert_allclose(means[0], means[1], atol=1e-9)


def test_an_outlier_is_no_steady_velocity_and_sway_is():
    time = np.arange(0.0, 20.0, 0.2)
    velocity = np.stack([np.sin(time), np.cos(time), 0.1 * time], axis=1)
    velocity += np.random.default_rng(0).normal(0.0, 0.01, velocity.shape)
    assert steady(velocity).all()
    velocity[40] += 3.0
    assert np.flatnonzero(~steady(velocity)).tolist() == [40]
    assert steady(velocity[:3]).all()


def test_outliers_are_left_out_by_a_clock_that_changes(windows):
    """A window that has too few left goes, and with it its offsets."""

    class Still(VelocityWindows):
        def residual(self, offset):
            assert np.shape(offset) in ((), self.rows.shape)
            return self.velocity[self.rows]

    time = np.arange(0.0, 60.0)
    velocity = np.random.default_rng(0).normal(0.0, 0.01, (time.size, 3))
    velocity[52:60] = 9.0
    velocity[10] = 9.0
    there = Still(windows, time, velocity, np.full(time.size, 0.01), *sorted_into(windows, time))
    for offset in (0.0, np.zeros(there.rows.shape)):
        kept = there.without_outliers(offset)
        assert kept.window.tolist() == [0, 1]
        assert 10 not in time[kept.rows[kept.inside]]
    velocity[48:60] = 9.0
    there = Still(windows, time, velocity, np.full(time.size, 0.01), *sorted_into(windows, time))
    assert there.without_outliers(np.zeros(there.rows.shape)).window.tolist() == [0]
