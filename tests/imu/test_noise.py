"""Noise of an IMU from its own record: white noise is found under sway, jerks and vibration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from truth import CONING, merged, scenario

from factorgraph_dvl.imu.noise import noise_findings, white_noise, with_recorded_noise
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import NoiseModel
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.trial import Trial

# Turns without ramps step the rate; 4 deg of sway at 2 Hz is 1 rad/s.
MANOEUVRES = [
    {"straight_s": 40},
    {"turn_deg_s": 9, "duration_s": 40},
    {"straight_s": 40},
]


@cache
def swaying() -> Trial:
    return simulate(scenario(noise=True, manoeuvres=MANOEUVRES, sway=CONING), seed=1)


def with_noise(imu: Imu, factor: float) -> Imu:
    """Return a record whose noise is so many times the stated one."""
    rng = np.random.default_rng(0)
    root = np.sqrt((factor**2 - 1.0) / np.median(np.diff(imu.time)))
    gyro, accel = rng.standard_normal((2, imu.time.size, 3)) * root
    s = imu.settings
    return replace(
        imu,
        gyro=imu.gyro + gyro * s.gyro_noise_root_psd,
        accel=imu.accel + accel * s.accel_noise_root_psd,
    )


def ratios(imu: Imu) -> tuple[float, float]:
    """Return the bounds over the stated noise."""
    found = white_noise(imu)
    assert found is not None
    s = imu.settings
    return found.gyro / s.gyro_noise_root_psd, found.accel / s.accel_noise_root_psd


def test_stated_noise_is_found_as_stated_under_sway() -> None:
    assert ratios(swaying().imu) == pytest.approx((1.0, 1.0), abs=0.03)
    assert with_recorded_noise(swaying().imu) is swaying().imu


def test_more_noise_is_found_and_used() -> None:
    imu = with_noise(swaying().imu, 3.0)
    assert ratios(imu) == pytest.approx((3.0, 3.0), rel=0.05)
    changed = with_recorded_noise(imu)
    assert changed.settings.gyro_noise_root_psd == pytest.approx(
        3.0 * imu.settings.gyro_noise_root_psd, rel=0.05
    )
    findings = noise_findings(imu.settings, changed.settings)
    assert [finding.code for finding in findings] == [Code.IMU_NOISE] * 2
    assert noise_findings(changed.settings, imu.settings) == ()
    assert "times the stated noise of the" in str(findings[0])


def test_quieter_noise_changes_nothing() -> None:
    imu = swaying().imu
    stated = {
        "gyro_noise_deg_sqrt_h": 5 * imu.settings.gyro_noise_deg_sqrt_h,
        "accel_noise_ug_sqrt_hz": 5 * imu.settings.accel_noise_ug_sqrt_hz,
    }
    imu = replace(imu, settings=msgspec.structs.replace(imu.settings, **stated))
    assert with_recorded_noise(imu) is imu


def test_vibration_and_jerks_are_no_noise() -> None:
    imu = swaying().imu
    lines = sum(np.sin(2.0 * np.pi * f * imu.time + f) for f in (17.0, 33.1))
    jerks = np.zeros(imu.time.size)
    jerks[::3000] = 1.0
    disturbed = (1e-3 * lines + 0.1 * jerks)[:, None]
    shaken = replace(imu, gyro=imu.gyro + disturbed, accel=imu.accel + 100.0 * disturbed)
    assert max(ratios(shaken)) < 1.1


@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_records_that_do_not_tell(jitter: float) -> None:
    imu = swaying().imu
    count = imu.time.size if jitter else 3000
    time = imu.time[:count] + jitter * np.random.default_rng(2).uniform(-1, 1, count)
    part = replace(imu, time=time, gyro=imu.gyro[:count], accel=imu.accel[:count])
    assert white_noise(part) is None
    assert with_recorded_noise(part) is part


def test_the_solver_uses_it_unless_noise_is_as_stated() -> None:
    quiet = merged({"noise": True, "manoeuvres": [{"straight_s": 60}]}, {"gnss": {"rate_hz": 1}})
    trial = simulate(scenario(**quiet), seed=3)
    trial = replace(trial, imu=with_noise(trial.imu, 3.0))

    def ended_with(noise: NoiseModel) -> tuple[float, set[str]]:
        solved, *_ = solved_problems(replace(trial, noise=noise))
        found = {str(finding.code) for finding in solved.findings}
        return solved.problem.chain.imu.gyro_noise_root_psd, found

    stated = trial.imu.settings.gyro_noise_root_psd
    used, found = ended_with("estimated")
    assert used == pytest.approx(3.0 * stated, rel=0.15)
    assert "imu_noise" in found
    used, found = ended_with("stated")
    assert used == stated
    assert "imu_noise" not in found
