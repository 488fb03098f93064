"""Coarse alignment: exact without noise, the course where the motion determines no heading."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from kalman_trials import STILL, samples_of
from truth import SWELL, scenario

from factorgraph_dvl.baselines.coarse_alignment import coarse_attitude
from factorgraph_dvl.baselines.strapdown import compose
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.simulation import simulate


def aligned(trial, velocity=None, **settings):
    """Return the coarse attitude, and its error in level axes, rad."""
    samples, gnss, ref = samples_of(trial), trial.gnss, trial.reference
    velocity = gnss.velocity if velocity is None else velocity
    found = coarse_attitude(
        gnss.time,
        compose(samples, gnss.time[:-1], gnss.time[1:]),
        gnss.geodetic,
        velocity,
        gnss.velocity_std,
        np.zeros_like(velocity),
        msgspec.structs.replace(trial.imu.settings, **settings),
        trial.body_axes,
    )
    rph = [np.interp(gnss.time[0], ref.time, column) for column in ref.rph.T]
    truth = rotation_from_rph(np.array(rph), trial.body_axes)
    return found, log_so3(truth @ found.nRb.T)


@pytest.mark.parametrize("body_axes", ["RFU", "FRD"])
def test_without_noise_the_attitude_is_within_its_covariance(body_axes):
    found, error = aligned(simulate(scenario(body_axes=body_axes)))
    assert not found.note
    assert np.linalg.norm(error) < 0.2 * DEG
    assert np.all(np.abs(error) < 2.0 * np.sqrt(np.diag(found.covariance)))


def test_on_a_straight_run_coarse_gyros_leave_the_course():
    trial = simulate(scenario(**STILL))
    found, error = aligned(trial, gyro_bias_std_deg_h=100.0)
    assert "course over ground" in text_of(found.note)
    assert np.sqrt(found.covariance[2, 2]) == pytest.approx(15.0 * DEG)
    assert abs(error[2]) < 1.0 * DEG


def test_at_rest_coarse_gyros_leave_no_heading():
    trial = simulate(scenario(**STILL, start={"speed_m_s": 0}))
    found, error = aligned(trial, gyro_bias_std_deg_h=100.0)
    assert "do not determine the heading" in text_of(found.note)
    assert np.sqrt(found.covariance[2, 2]) == pytest.approx(60.0 * DEG)
    # Gravity levels all the same.
    assert np.linalg.norm(error[:2]) < 1.0 * DEG


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_gnss_does_not_count_as_motion(seed):
    """In ten seconds ahead in swell, velocities to 0.1 m/s leave the heading open."""
    short = scenario(noise=True, sway=SWELL, manoeuvres=[{"straight_s": 10}])
    found, error = aligned(simulate(short, seed))
    assert "course over ground" in text_of(found.note)
    assert abs(error[2]) < 2.0 * np.sqrt(found.covariance[2, 2])
