"""Attitude by the gyros alone, velocity by GNSS alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.baselines.separate_navigation import separate_motion
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import InitialAttitude


def trial():
    """A minute of turns without noise, and the attitude at its start."""
    found = simulate(scenario(gnss={"lever_arm_m": [0.3, -1.5, 4.0]}), 0)
    start = InitialAttitude(found.reference.rph[0], np.full(3, 0.01))
    return replace(found, initial_attitude=start)


def test_without_noise_it_is_the_true_motion():
    t = trial()
    gnss = t.gnss.time[(t.gnss.time > 1.0) & (t.gnss.time < 60.0)]
    motion = separate_motion(t, gnss)
    row = np.searchsorted(t.reference.time, gnss - 1e-6)
    true = rotation_from_rph(t.reference.rph[row], t.body_axes)
    assert np.abs(log_so3(true.transpose(0, 2, 1) @ motion.nRb)).max() < 1e-6
    # The antenna is 4 m away, and the rate between samples is smooth where a turn begins.
    apart = np.abs(motion.velocity - t.reference.velocity[row])
    assert np.quantile(apart, 0.98) < 1e-5
    assert apart.max() < 2e-4
    np.testing.assert_allclose(motion.covariance[:, 6, 6], 1e-4, rtol=0.1)


def test_a_wrong_attitude_at_the_start_stays():
    t = trial()
    at = t.gnss.time[[20, 200]]
    right = separate_motion(t, at).nRb
    moved = InitialAttitude(t.reference.rph[0] + np.array([0.0, 0.0, 0.01]), np.full(3, 0.02))
    wrong = separate_motion(replace(t, initial_attitude=moved), at).nRb
    turn = log_so3(wrong @ right.transpose(0, 2, 1))
    # Heading is clockwise, the axis points up.
    np.testing.assert_allclose(turn[:, 2], -0.01, atol=1e-4)


def test_without_an_attitude_to_start_from_it_is_refused():
    with pytest.raises(DataError, match="attitude to start from"):
        separate_motion(replace(trial(), initial_attitude=None), np.array([1.0]))
