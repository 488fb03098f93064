"""Errors that nobody estimates: what they change, and what they add to standard deviations."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import yaml
from monte_carlo import RUNS
from scipy.stats import chi2
from truth import CONFIGS, TURNING, scenario

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.geometry.units import ARCSEC
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

CAUSE = "deflection of the vertical"


def turning(simulated, stated):
    """Return a short trial at navigation grade."""
    imu = {"rate_hz": 50, "gravity_deflection_std_arcsec": simulated}
    scene = scenario(noise=True, manoeuvres=TURNING[:3], imu=imu)
    claims = scene.trial.imu | {"gravity_deflection_std_arcsec": stated}
    trial = msgspec.structs.replace(scene.trial, imu=claims)
    return simulate(msgspec.structs.replace(scene, trial=trial), 0)


def test_a_deflection_tilts_the_attitude_and_its_standard_deviation_says_so():
    straight, tilted = (solve(turning(real, 10.0)) for real in (0.0, 10.0))
    without = solve(turning(0.0, 0.0))
    # The estimate is that without it.
    np.testing.assert_array_equal(straight.trajectory.rph, without.trajectory.rph)
    change = (tilted.trajectory.rph - straight.trajectory.rph)[:, :2] / ARCSEC
    assert np.hypot(*change.T).mean() > 3.0
    added = np.linalg.eigvalsh(straight.trajectory.rph_cov - without.trajectory.rph_cov)
    assert np.all(added > -1e-15)
    added = straight.trajectory.rph_cov[:, :2, :2] - without.trajectory.rph_cov[:, :2, :2]
    np.testing.assert_allclose(np.trace(added, axis1=1, axis2=2) / ARCSEC**2, 200.0, rtol=0.02)
    normalised = np.einsum("mi,mij,mj->m", change, np.linalg.inv(added / ARCSEC**2), change)
    assert normalised.max() < chi2.ppf(0.999, 2)
    moved = [np.concatenate([e.value for e in s.estimates]) for s in (straight, tilted)]
    (cause,) = (c for c in straight.error_budget if c.cause == CAUSE)
    assert cause.assumed == "10″"
    # A minimum is one within a twentieth of the standard deviation.
    sigma = np.sqrt(np.diag(straight.covariance))
    assert np.all(np.abs(moved[1] - moved[0]) <= 3.0 * cause.adds + 0.05 * sigma)
    total = np.sum([c.adds**2 for c in straight.error_budget], axis=0)
    np.testing.assert_allclose(total, np.diag(straight.covariance), rtol=1e-3)


@pytest.mark.slow
def test_attitudes_at_navigation_grade_hold_their_standard_deviations():
    plan = yaml.safe_load((CONFIGS / "data-sheet-mix-navigation.yaml").read_text(encoding="utf-8"))
    # The reference is at times of the IMU's clock.
    plan["imu"] |= {"gravity_deflection_std_arcsec": 10, "time_offset_s": 0}
    nees, of_mount = [], []
    for seed in range(RUNS):
        trial = simulate(parse_scenario(plan), seed)
        found = solve(trial)
        # An attitude's error hardly changes along a trial.
        nees.append(trajectory_errors(found, trial.reference).attitude.nees.mean())
        errors = calibration_errors(found, trial.calibration_truth)
        own = [i for i, n in enumerate(errors.names) if n.startswith(("misal", "scale", "lever"))]
        P, away = errors.covariance[np.ix_(own, own)], errors.error[own]
        of_mount.append(float(away @ np.linalg.solve(P, away)))
        assert found.verdict.grade == "good"
    for values, freedom in ((nees, 3), (of_mount, 7)):
        low, high = chi2.ppf([0.005, 0.995], freedom * RUNS)
        assert low < sum(values) < high, np.round(np.array(values) / freedom, 2)
