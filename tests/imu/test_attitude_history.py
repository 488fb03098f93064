"""Attitude and turn rate between the epochs of a source."""

from __future__ import annotations

import numpy as np
import pytest
from inertial import constant_imu

from factorgraph_dvl.geometry.earth import RATE
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.trial import Reference

# FLU: z is up, so that a heading grows where the rate about z is negative.
TURN = -0.1


def source(time, lat=0.0, drift=0.0):
    """Epochs of a turn to starboard that is `drift` rad/s faster than the gyros say."""
    zero = np.zeros((time.size, 3))
    rph = zero.copy()
    rph[:, 2] = 1.0 + (drift - TURN) * time
    return Reference(time, zero + np.array([lat, 0.0, 0.0]), zero, rph)


def history(time, **options):
    imu = constant_imu(10.0, gyro=(0.0, 0.0, TURN), accel=(0.0, 0.0, 9.8))
    return AttitudeHistory(imu, source(time, **options), "FLU", np.zeros(3))


@pytest.mark.parametrize("drift", [0.0, 1e-3])
def test_the_gyros_fill_in_and_what_they_miss_grows_in_proportion_to_time(drift):
    found = history(np.arange(1.0, 9.1), drift=drift).at(np.array([2.0, 2.3, 7.77]))
    assert found.covered.all()
    expected = source(np.array([2.0, 2.3, 7.77]), drift=drift).rph
    apart = rotation_from_rph(expected, "FLU").transpose(0, 2, 1) @ found.nRb
    np.testing.assert_allclose(log_so3(apart), 0.0, atol=1e-7)


def test_the_rate_is_that_relative_to_the_earth():
    found = history(np.arange(1.0, 9.1), lat=np.pi / 2).at(np.array([5.0]))
    # At the pole the Earth turns about the vertical.
    np.testing.assert_allclose(found.omega_eb_b, [[0.0, 0.0, TURN - RATE]], atol=1e-12)


def test_outside_the_epochs_and_the_record_nothing_is_known():
    found = history(np.arange(2.0, 8.1)).at(np.array([1.0, 5.0, 9.0, 40.0]))
    assert found.covered.tolist() == [False, True, False, False]
    assert not history(np.array([5.0])).at(np.array([5.0])).covered.any()
