"""Small trials and solutions, built by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.estimates import Estimate, Trajectory
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import Dvl, DvlSettings
from factorgraph_dvl.sensors.gnss import Gnss, GnssSettings
from factorgraph_dvl.sensors.imu import Imu, ImuSettings
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.trial import (
    InitialAttitude,
    InitialPosition,
    InitialVelocity,
    Reference,
    Trial,
)

ORIGIN = LocalFrame(34.0 * DEG, 108.0 * DEG, 10.0)
_ROLL = 6.0 * DEG
_ROLL_RATE = 2.0 * np.pi * 0.2


def build_trial(*, seconds: float = 60.0, **changes: Any) -> Trial:
    """A vehicle that heads north-east at 2 m/s and rolls; every optional part is there."""
    rng = np.random.default_rng(0)
    time = np.arange(1, round(seconds * 50) + 1) / 50.0
    roll = _ROLL * np.sin(_ROLL_RATE * time)
    zero = np.zeros(time.size)
    gyro_frd = np.stack([_ROLL * _ROLL_RATE * np.cos(_ROLL_RATE * time), zero, zero], axis=1)
    force_frd = -9.8 * np.stack([zero, np.sin(roll), np.cos(roll)], axis=1)
    body = frd_from_body("RFU")
    imu = Imu(
        ImuSettings(
            gyro_noise_deg_sqrt_h=0.01,
            gyro_bias_std_deg_h=1.0,
            accel_noise_ug_sqrt_hz=100.0,
            accel_bias_std_ug=1000.0,
        ),
        time,
        gyro_frd @ body + rng.normal(0.0, 1e-4, (time.size, 3)),
        force_frd @ body + rng.normal(0.0, 1e-2, (time.size, 3)),
        source="imu.csv",
    )
    fixes = np.arange(1, round(seconds) + 1) * 1.0
    p_n = np.stack([1.2 * fixes, 1.6 * fixes, 0.0 * fixes], axis=1)
    geodetic = np.stack(ORIGIN.geodetic(p_n), axis=1)
    velocity = np.tile([1.2, 1.6, 0.0], (fixes.size, 1))
    velocity[5] = np.nan
    geodetic[7] = np.nan
    gnss = Gnss(
        GnssSettings(
            position_std_m=(0.02, 0.02, 0.04),
            velocity_std_m_s=(0.02, 0.02, 0.02),
            lever_arm_std_m=(0.0, 0.0, 0.0),
            time_offset_std_s=0.0,
        ),
        fixes,
        geodetic + rng.normal(0.0, 1e-9, geodetic.shape),
        velocity,
        np.full(geodetic.shape, np.nan),
        np.full(geodetic.shape, np.nan),
        source="gnss.csv",
    )
    pings = fixes - 0.25
    velocity_d = np.tile([0.0, 2.0, 0.0], (pings.size, 1)) + rng.normal(0, 0.002, (pings.size, 3))
    velocity_d[3] = np.nan
    dvl = Dvl(
        DvlSettings(
            misalignment_std_deg=(5.0, 5.0, 5.0),
            scale_error_std=(0.01, 0.02, 0.03),
            bias_std_m_s=(0.0, 0.0, 0.0),
            time_offset_std_s=0.0,
        ),
        pings,
        velocity_d,
        np.where(np.isnan(velocity_d), np.nan, 0.002),
        source="dvl.csv",
    )
    trial = Trial(
        name="by hand",
        imu=imu,
        gnss=gnss,
        dvl=dvl,
        body_axes="RFU",
        epoch="2022-10-12T02:00:00Z",
        initial_attitude=InitialAttitude(np.array([0.01, -0.02, 0.7]), np.array([0.1, 0.1, 0.2])),
        initial_position=InitialPosition(
            np.array([34.0 * DEG, 108.0 * DEG, 10.0]), np.array([1.0, 1.0, 2.0])
        ),
        initial_velocity=InitialVelocity(np.array([1.2, 1.6, 0.1]), np.array([0.1, 0.2, 0.3])),
        reference=Reference(
            fixes,
            np.stack(ORIGIN.geodetic(p_n), axis=1),
            np.tile([1.2, 1.6, 0.0], (fixes.size, 1)),
            np.tile([0.0, 0.0, 0.64], (fixes.size, 1)),
        ),
        calibration_truth={
            "misalignment_deg": np.array([1.0, 2.0, 3.0]),
            "scale_error": np.array([0.005]),
        },
    )
    return replace(trial, **changes)


def build_solution(*, converged: bool = True, **changes: Any) -> Solution:
    """A solution of three components, with awkward digits."""
    m = 4
    time = np.arange(m) / 3.0
    p_n = np.outer(time, [1.0, 2.0, 0.1])

    def spread(sigma: float) -> Array:
        return np.tile(sigma**2 * np.eye(3), (m, 1, 1))

    estimates = (
        Estimate(
            "misalignment_deg",
            ("misalignment_x_deg", "misalignment_y_deg", "misalignment_z_deg"),
            np.array([1.0, 2.0, 3.0]) + 1.0 / 3.0,
            np.array([0.1, 0.2, 4.0]),
            np.zeros(3),
            np.full(3, 5.0),
            np.array([True, True, False]),
        ),
        Estimate(
            "scale_error",
            ("scale_error",),
            np.array([0.00512345678901234]),
            np.array([1e-4 / 3.0]),
            np.zeros(1),
            np.array([0.1]),
            np.array([True]),
        ),
    )
    std = np.concatenate([e.std for e in estimates])
    solution = Solution(
        trial="by hand",
        solver="batch",
        body_axes="FRD",
        converged=converged,
        iterations=5,
        cost=123.456,
        estimates=estimates,
        covariance=np.outer(std, std) * (0.9 * np.eye(4) + 0.1),
        trajectory=Trajectory(
            time,
            np.stack(ORIGIN.geodetic(p_n), axis=1),
            np.tile([1.0, 2.0, 0.1], (m, 1)) / 7.0,
            np.tile([0.01, -0.02, 6.0], (m, 1)),
            spread(0.1),
            spread(0.01),
            spread(0.001),
        ),
        findings=(
            Finding(
                Code.NOT_OBSERVABLE,
                "misalignment_z_deg was not observable",
                parameter="misalignment_deg",
            ),
        ),
    )
    return replace(solution, **changes)


def write_trial(folder: Path, trial: Trial | None = None) -> Path:
    """Save a trial as `folder/trial` and return that."""
    path = folder / "trial"
    save_trial(trial if trial is not None else build_trial(), path)
    return path


def edit(file: Path, old: str, new: str) -> int:
    """Replace the first `old` in a text file; return its line."""
    text = file.read_text()
    assert old in text, f"{old!r} is not in {file}"
    file.write_text(text.replace(old, new, 1))
    return text[: text.index(old)].count("\n") + 1


def build_history(solution: Solution) -> InformationHistory:
    """Return what its information is along the trial: from the first to the last the same."""
    root = np.diag(np.sqrt(np.diag(solution.covariance)))
    time = solution.trajectory.time[[0, -1]]
    return InformationHistory(time, tuple(solution.order), np.stack([root, root]))
