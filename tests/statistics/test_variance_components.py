"""Noise of sensors from their residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stated_noise import stated
from truth import CONING, merged, scenario

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve

SCENE = {
    "noise": True,
    "sway": merged({}, CONING),
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.01},
    "dvl": {"rate_hz": 5, "velocity_std_m_s": 0.002},
    "trial": {"dvl": {"velocity_std_m_s": 0.002}},
}


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(**SCENE), 1)


@pytest.fixture(scope="module")
def honest(trial):
    return solve(trial, rate_hz=1.0)


def factors(solution):
    return {n.name: n.factor for n in solution.noise}


def test_noise_as_stated_stays_as_stated(trial, honest):
    assert set(factors(honest)) == {"gnss_position", "gnss_velocity", "dvl_velocity"}
    assert all(np.all(np.abs(f - 1.0) < 0.15) for f in factors(honest).values())
    exact = solve(replace(trial, noise="stated"), rate_hz=1.0)
    assert not exact.noise
    ratio = np.sqrt(np.diag(honest.covariance) / np.diag(exact.covariance))
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [5.0, 0.2])
@pytest.mark.parametrize("sensor", ["dvl", "gnss"])
def test_stated_noise_wrong_by_five_is_recovered(trial, honest, sensor, wrong):
    solution = solve(stated(trial, **{f"factor_{sensor}": wrong}), rate_hz=1.0)
    assert solution.converged
    for name, found in factors(solution).items():
        np.testing.assert_allclose(found, 1.0 / wrong if sensor in name else 1.0, rtol=0.15)
    ratio = np.sqrt(np.diag(solution.covariance) / np.diag(honest.covariance))
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)
    large = {f.sensor for f in solution.findings if f.code == Code.LARGE_RESIDUALS}
    assert bool(large) == (wrong < 1.0)


def test_a_sensor_whose_noise_is_stated_keeps_it(trial):
    solution = solve(stated(trial, factor_dvl=0.2, noise="stated"), rate_hz=1.0)
    assert "dvl_velocity" not in factors(solution)
    (finding,) = (f for f in solution.findings if f.code == Code.LARGE_RESIDUALS)
    assert "too small until you correct it" in finding.text


# Beams and depth beside GNSS and DVL: more than 100 residuals of each kind are redundant.
ALL_KINDS = merged(
    SCENE,
    {
        "dvl_beams": {
            "rate_hz": 5,
            "slant_azimuth_deg": [[30, 45], [30, 315], [30, 225], [30, 135]],
            "lever_arm_m": [1, 1.2, 1.4],
            "velocity_std_m_s": 0.005,
        },
        "depth": {"rate_hz": 5, "std_m": 0.05, "sea_surface_height_m": 17.3},
    },
)
# The stated noise of each kind, as simulated.
STATED = {
    "dvl_velocity": ("dvl", {"velocity_std_m_s": 0.002, "velocity_std_fraction": 0.002}),
    "gnss_position": ("gnss", {"position_std_m": [0.5, 0.5, 1.0]}),
    "gnss_velocity": ("gnss", {"velocity_std_m_s": [0.1, 0.1, 0.1]}),
    "beam_velocity": ("dvl_beams", {"velocity_std_m_s": 0.005, "velocity_std_fraction": 0.0}),
    "depth": ("depth", {"std_m": 0.05}),
}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [5.0, 0.2])
@pytest.mark.parametrize("kind", STATED)
def test_noise_of_every_kind_is_recovered(kind, wrong):
    section, keys = STATED[kind]
    claims = {name: np.multiply(wrong, value).tolist() for name, value in keys.items()}
    misstated = merged(ALL_KINDS, {"trial": {section: claims}})
    solution = solve(simulate(scenario(**misstated), 1), rate_hz=1.0)
    assert solution.converged
    found = factors(solution)
    assert set(found) == set(STATED)
    for name, factor in found.items():
        np.testing.assert_allclose(factor, 1.0 / wrong if name == kind else 1.0, rtol=0.15)
