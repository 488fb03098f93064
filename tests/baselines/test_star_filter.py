"""The six-state filter of gyro drift and its smoother."""

from __future__ import annotations

import numpy as np
from kalman_trials import samples_of
from truth import config

from factorgraph_dvl.baselines.star_filter import attitude_at, run_filter, smooth, star_attitudes
from factorgraph_dvl.geometry.rotations import log_so3
from factorgraph_dvl.sensors.star import Star
from factorgraph_dvl.simulation import simulate


def test_the_smoother_is_tighter_than_the_filter_and_passes_through_its_own_states():
    trial = simulate(config("star", manoeuvres=[{"straight_s": 20}]), 2)
    star = next(aid for aid in trial.others if isinstance(aid, Star))
    frame, samples = trial.frame(), samples_of(trial)
    attitudes = star_attitudes(star, trial.epoch, frame.lat, frame.lon)
    assert attitudes.within(5.0, 6.0).time.min() >= 5.0
    forward = run_filter(samples, attitudes, frame.lat, np.zeros(3), 1e-12 * np.eye(3))
    smoothed = smooth(forward)
    np.testing.assert_array_equal(smoothed.covariance[-1], forward.track.covariance[-1])
    traces = [
        np.trace(c, axis1=1, axis2=2) for c in (smoothed.covariance, forward.track.covariance)
    ]
    assert np.all(traces[0] <= traces[1] * (1.0 + 1e-9))
    assert traces[0][0] < 0.5 * traces[1][0]
    nRb, P = attitude_at(samples, smoothed, frame.lat, smoothed.time)
    assert np.linalg.norm(log_so3(nRb @ smoothed.nRb.transpose(0, 2, 1)), axis=1).max() < 1e-9
    np.testing.assert_allclose(P, 4.0 * smoothed.covariance[:, :3, :3])
