"""The IMU's record carried through windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import exact_states, scenario

from factorgraph_dvl.initialization.carried_windows import carried_windows
from factorgraph_dvl.sensors.records import rows_of


def test_attitude_and_velocity_since_the_start_are_those_of_the_trial(exact):
    trial, windows = exact
    k = np.arange(windows.start.size)
    time = windows.start + 10.0
    at, origin = windows.at(k, time), windows.at(k, windows.start)
    frame = trial.frame()
    truth = exact_states(scenario(), frame, np.concatenate([windows.start, time]))
    before, after = truth.nRb[: k.size], truth.nRb[k.size :]
    turned = before.transpose(0, 2, 1) @ after
    found = origin.turn.transpose(0, 2, 1) @ at.turn
    # The Earth turns by 0.04 deg meanwhile.
    np.testing.assert_allclose(found, turned, atol=2e-3)
    # Force is carried, gravity is not taken out.
    gained = np.einsum(
        "wij,wj->wi", before @ origin.turn.transpose(0, 2, 1), at.speed - origin.speed
    )
    expected = truth.v_n[k.size :] - truth.v_n[: k.size] + [0.0, 0.0, 9.80 * 10.0]
    np.testing.assert_allclose(gained, expected, atol=0.1)


def test_windows_do_not_overlap_but_for_their_margins(exact):
    trial, windows = exact
    assert np.all(np.diff(windows.start) >= windows.length - 1e-9)
    middle = windows.start + 0.5 * windows.length
    assert windows.window_of(middle).tolist() == list(range(windows.start.size))
    assert windows.window_of(windows.start[:1] - 0.1).tolist() == [-1]
    assert windows.window_of(trial.imu.time[-1:]).tolist() == [-1]


def test_a_window_with_a_gap_is_left_out(exact):
    trial, windows = exact
    time = trial.imu.time
    inside = windows.start[0] + 0.5 * windows.length
    broken = rows_of(trial.imu, (time < inside) | (time > inside + 1.0))
    assert carried_windows(broken).start.size < windows.start.size
    assert carried_windows(rows_of(trial.imu, time < 20.0)) is None
    assert carried_windows(replace(trial.imu, time=100.0 * time)) is None
