"""SINS/GNSS navigation: exact without noise, honest with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from findings import of_code
from kalman_trials import VARIED, angle_between
from truth import scenario

from factorgraph_dvl.analysis.error_statistics import (
    trajectory_errors,
)
from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.navigation import motion_at, navigate
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"gnss": {"lever_arm_m": [0.5, -1.5, 4]}},
        {"gnss": {"velocity_std_m_s": None}},
        {"body_axes": "FRD", "start": {"heading_deg": 190}},
        {"gnss": {"rate_hz": 1, "phase_s": 0.37, "jitter_s": 0.1}},
        {"gnss": {"outages_s": [[20, 35]]}},
        {"trial": {"initial": {"attitude_std_deg": [0.5, 0.5, 2], "velocity_std_m_s": [0.1] * 3}}},
    ],
    ids=["plain", "antenna", "no velocity", "axes", "clock", "outage", "prior"],
)
def test_without_noise_navigation_is_exact(changes):
    trial = simulate(scenario(**changes))
    solution = kalman(trial, "wahba")
    errors = trajectory_errors(solution, trial.reference)
    for vector in (errors.position, errors.velocity, errors.attitude):
        assert np.sqrt(np.mean(vector.normalised**2)) < 0.1


def test_navigation_is_honest():
    nees = []
    for seed in range(6):
        trial = simulate(scenario(noise=True, manoeuvres=VARIED), seed)
        navigation = navigate(trial, trial.dvl.time)
        motion = motion_at(navigation, trial.reference.time[10:-10])
        at = motion.covered
        truth = rotation_from_rph(trial.reference.rph[10:-10][at], trial.body_axes)
        error = np.hstack(
            [
                trial.reference.velocity[10:-10][at] - motion.velocity[at],
                log_so3(truth @ motion.nRb[at].transpose(0, 2, 1)),
            ]
        )
        P = motion.covariance[at, 3:, 3:]
        nees.append(np.mean(np.sum(error * np.linalg.solve(P, error[..., None])[..., 0], axis=1)))
    assert 3.0 < np.mean(nees) < 10.0  # 6, of a few independent errors for each seed


def test_after_a_gap_the_filter_starts_again():
    trial = simulate(scenario(imu={"gaps_s": [[25.0, 40.0]]}))
    solution = kalman(trial)
    (text,) = of_code(solution.findings, Code.FILTER_RESTARTED)
    assert "starts again at 40" in text
    assert angle_between(solution, [2, 2, 30]) < 0.01
    assert not np.any((solution.trajectory.time > 25.01) & (solution.trajectory.time < 39.9))


def test_without_velocities_fixes_may_cross_180_degrees():
    def solved(lon):
        start = {"lat_deg": 36, "lon_deg": lon, "heading_deg": 90, "speed_m_s": 4}
        trial = simulate(scenario(noise=True, start=start), 1)
        assert lon == 121 or np.ptp(trial.gnss.geodetic[:, 1]) > 6
        nothing = np.full_like(trial.gnss.velocity, np.nan)
        return kalman(replace(trial, gnss=replace(trial.gnss, velocity=nothing)))

    across, elsewhere = solved(179.9995), solved(121)
    assert np.abs(across.trajectory.geodetic[:, 1]).max() <= np.pi
    std = elsewhere.estimate("misalignment_deg").std
    values = [s.estimate("misalignment_deg").value for s in (across, elsewhere)]
    assert np.all(np.abs(values[0] - values[1]) < 0.1 * std)
