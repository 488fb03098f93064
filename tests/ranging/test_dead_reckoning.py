"""Dead reckoning in the plane: how smooth the motion is, and what a straight run gives."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from planar import STRAIGHT, changed, trial

from factorgraph_dvl.ranging.dead_reckoning import _velocity_change_density, dead_reckoned


def test_a_vehicle_is_as_smooth_as_it_is_seen_to_be():
    quiet, turning = dead_reckoned(trial(**STRAIGHT)), dead_reckoned(trial())
    root = np.sqrt(np.trace(quiet.density, axis1=1, axis2=2))
    # Within half a minute no more than a few of the centimetres per second of the mean's noise.
    assert np.median(root[40:-40]) * np.sqrt(30.0) < 0.03
    at = np.argmin(np.abs(turning.time - 157.0))
    # 2 m/s turning by 2 degrees in a second: no less in any direction.
    assert np.linalg.eigvalsh(turning.density[at]).min() > (2.0 * np.radians(2.0)) ** 2
    # A line of slope a, by hand: W a²; the trapezoid makes its slope larger by 2 (1 s / W)².
    line = np.outer(turning.time, [0.003, -0.004])
    found = _velocity_change_density(turning.time, line, np.zeros((len(line), 2, 2)))
    by_hand = 60.0 * (0.005 * (1.0 + 2.0 / 60.0**2)) ** 2
    np.testing.assert_allclose(found[at], by_hand * np.eye(2), rtol=1e-6)


def test_a_straight_run_by_hand():
    t = trial(**STRAIGHT)
    heading, log, depth, *_ = t.records
    time = np.arange(0.0, 301.0)
    # 2 m/s ahead to the east, 0.5 m/s to starboard.
    t = changed(
        t,
        replace(heading, time=time, heading=np.full(301, np.pi / 2.0)),
        replace(log, time=time, speed=np.full(301, 2.0), starboard=np.full(301, 0.5)),
        replace(depth, time=time, depth=2.0 * time),
    )
    track = dead_reckoned(t)
    np.testing.assert_allclose(track.displacement[10], [20.0, -5.0])
    np.testing.assert_allclose(track.climb, -2.0)
    # Random walk of two speeds, and of the heading across, per second.
    std, turn = log.settings.speed_std_m_s, heading.settings.std_rad
    by_hand = 2.0 * std**2 + turn**2 * (2.0**2 + 0.5**2)
    np.testing.assert_allclose(track.spread[10], 10.0 * by_hand)
    # A current of 0.1 m/s to the east, and a heading that is 90 degrees too large: it goes north.
    zero = {p.name: p.mean for p in track.parameters}
    values = zero | {
        "heading_bias_deg": np.array([np.pi / 2.0]),
        "current_m_s": np.array([0.1, 0]),
    }
    moved, velocity = track.over_ground(np.array([10.0]), values)
    np.testing.assert_allclose(moved, [[6.0, 20.0]], atol=1e-12)
    np.testing.assert_allclose(velocity, [[0.6, 2.0]], atol=1e-12)


def test_a_log_slower_than_the_compass_has_more_noise_at_each_heading():
    t = trial()
    log = t.records[1]
    every = slice(None, None, 4)
    slow = replace(log, time=log.time[every], speed=log.speed[every],
                   starboard=log.starboard[every])  # fmt: skip
    track = dead_reckoned(changed(t, slow))
    np.testing.assert_allclose(np.diff(track.time), 1.0)
    assert track.log.settings.speed_std_m_s == pytest.approx(2.0 * log.settings.speed_std_m_s)
    assert track.heading_std == pytest.approx(t.records[0].settings.std_rad)
    quick = msgspec.structs.replace(log.settings, speed_std_m_s=0.1)
    assert dead_reckoned(changed(t, replace(log, settings=quick))).log.settings == quick
