"""The strapdown mechanisation against another one, and the smoother against the filter."""

from __future__ import annotations

import numpy as np
import pandas as pd
from kalman_trials import samples_of
from pyins.strapdown import Integrator
from truth import scenario

from factorgraph_dvl.baselines.ins_gnss import FilterState, Fixes, run_filter, smooth
from factorgraph_dvl.baselines.strapdown import compose
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG, MICRO_G
from factorgraph_dvl.simulation import simulate


def test_strapdown_agrees_with_pyins():
    trial = simulate(scenario(body_axes="FRD", imu={"rate_hz": 100}))
    samples = samples_of(trial)
    inc, ref = samples.increments, trial.reference
    time = np.arange(0.0, 60.01, 0.5)
    gap = np.full((time.size, 3), np.nan)
    free = run_filter(
        time,
        compose(samples, time[:-1], time[1:]),
        Fixes(gap, gap, gap, gap, gap, np.zeros(3)),
        FilterState(
            ref.geodetic[0],
            ref.velocity[0],
            rotation_from_rph(ref.rph[0], "FRD"),
            np.zeros(3),
            np.zeros(3),
            np.eye(15) * 1e-6,
        ),
        (0.0, 0.0),
    ).track

    phi, dv = inc.over(np.arange(6000))
    oracle = Integrator(
        pd.Series(
            np.concatenate(
                [
                    ref.geodetic[0, :2] / DEG,
                    ref.geodetic[0, 2:],
                    ref.velocity[0, [1, 0]],
                    -ref.velocity[0, 2:],
                    ref.rph[0] / DEG,
                ]
            ),
            index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
            name=0.0,
        )
    )
    table = pd.DataFrame(
        np.column_stack([inc.dt[:6000], phi, dv]),
        index=inc.end[:6000],
        columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
    )
    theirs = oracle.integrate(table).iloc[-1]
    ours = free.velocity[-1]
    np.testing.assert_allclose(ours, theirs[["VE", "VN", "VD"]] * [1, 1, -1], atol=1e-4)
    np.testing.assert_allclose(free.geodetic[-1, :2] / DEG, theirs[["lat", "lon"]], atol=2e-8)
    turn = rotation_from_rph(theirs[["roll", "pitch", "heading"]].to_numpy() * DEG, "FRD")
    assert np.linalg.norm(log_so3(turn.T @ free.nRb[-1])) < 1e-7


def test_the_smoother_beats_the_filter():
    trial = simulate(scenario(noise=True), 3)
    samples = samples_of(trial)
    time = trial.gnss.time
    fixes = Fixes(
        trial.gnss.geodetic,
        trial.gnss.velocity,
        trial.gnss.position_std**2,
        trial.gnss.velocity_std**2,
        np.zeros((time.size, 3)),
        np.zeros(3),
    )
    ref = trial.reference
    at = np.searchsorted(ref.time, time[0] - 1e-6)
    variances = np.repeat([1.0, 0.01, (0.1 * DEG) ** 2, (3e-7) ** 2, (100 * MICRO_G) ** 2], 3)
    start = FilterState(
        ref.geodetic[at],
        ref.velocity[at],
        rotation_from_rph(ref.rph[at], trial.body_axes),
        np.zeros(3),
        np.zeros(3),
        np.diag(variances),
    )
    forward = run_filter(time, compose(samples, time[:-1], time[1:]), fixes, start, (0.0, 0.0))
    smoothed = smooth(forward)
    filtered = forward.track
    truth = ref.velocity[np.searchsorted(ref.time, time - 1e-6)]
    before = np.sqrt(np.mean((filtered.velocity - truth) ** 2))
    after = np.sqrt(np.mean((smoothed.velocity - truth) ** 2))
    assert after < 0.8 * before
    change = np.diagonal(filtered.covariance - smoothed.covariance, axis1=1, axis2=2)
    assert np.all(change >= -1e-9 * np.diagonal(filtered.covariance, axis1=1, axis2=2))
    np.testing.assert_array_equal(smoothed.covariance[-1], filtered.covariance[-1])
