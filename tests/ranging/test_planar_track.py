"""Dead reckoning in the plane: how smooth the motion is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from planar import STRAIGHT, trial

from factorgraph_dvl.ranging.planar_track import track_from_records, velocity_change_psd
from factorgraph_dvl.ranging.problem import dead_reckoned


def test_a_vehicle_is_as_smooth_as_it_is_seen_to_be():
    quiet, turning = trial(**STRAIGHT), trial()
    psd = velocity_change_psd(dead_reckoned(quiet))
    root = np.sqrt(np.trace(psd, axis1=1, axis2=2))
    # Within half a minute no more than a few of the centimetres per second of the mean's noise.
    assert np.median(root[40:-40]) * np.sqrt(30.0) < 0.03
    track = dead_reckoned(turning)
    at = np.argmin(np.abs(track.time - 157.0))
    # 2 m/s turning by 2 degrees in a second: no less in any direction.
    assert np.linalg.eigvalsh(velocity_change_psd(track)[at]).min() > (2.0 * np.radians(2.0)) ** 2
    # A line of slope a, by hand: W a²; the trapezoid makes its slope larger by 2 (1 s / W)².
    line = replace(
        track,
        velocity=np.outer(track.time, [0.003, -0.004]),
        velocity_cov=np.zeros_like(track.velocity_cov),
    )
    by_hand = 60.0 * (0.005 * (1.0 + 2.0 / 60.0**2)) ** 2
    np.testing.assert_allclose(velocity_change_psd(line)[at], by_hand * np.eye(2), rtol=1e-6)


def test_a_straight_run_by_hand():
    time = np.arange(11.0)
    # 2 m/s ahead to the east, 0.5 m/s to starboard.
    track = track_from_records(
        (time, np.full(11, np.pi / 2.0), 0.01),
        (time, np.full(11, 2.0), np.full(11, 0.5), 0.1),
        (time, -2.0 * time),
        np.array([2.5]),
    )
    assert 2.5 in track.time
    np.testing.assert_allclose(track.displacement[-1], [20.0, -5.0])
    np.testing.assert_allclose(track.climb, -2.0)
    # Random walk of the speeds, 0.1² m²/s² for 10 samples of 1 s; of the heading across.
    noise = np.diag([0.1, 0.1]) + 10.0 * 1e-4 * np.outer([-0.5, -2.0], [-0.5, -2.0])
    np.testing.assert_allclose(track.noise[-1], noise + 1e-4 * np.eye(2), rtol=1e-9)
    np.testing.assert_allclose(track.at(np.array([3.25])).displacement, [[6.5, -1.625]])
