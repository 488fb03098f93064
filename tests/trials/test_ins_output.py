"""Output of an INS stated as GNSS: standard deviations hold although its errors last."""

from __future__ import annotations

import numpy as np
import pytest
from ins_output import as_ins_output
from monte_carlo import DVL
from scipy.stats import chi2
from truth import scenario
from workers import in_two_processes

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.simulation.faults import late, with_faults
from factorgraph_dvl.solvers.batch import solve

pytestmark = pytest.mark.slow

RUNS = 5
# Two-sided probability that a mean of an honest solver leaves its band.
RARE = 0.003
TURNS = [
    {"straight_s": 25},
    {"turn_deg_s": 14, "duration_s": 14, "ramp_s": 2},
    {"straight_s": 12},
    {"accelerate_m_s2": -0.08, "to_m_s": 1.4},
    {"turn_deg_s": -12, "duration_s": 15, "ramp_s": 2},
    {"accelerate_m_s2": 0.08, "to_m_s": 2.2},
]
# The IMU is ten times better than stated, as in a recorded dive; GNSS has no noise of its own.
DIVE = {
    "noise": True,
    "start": {"speed_m_s": 2.0},
    "manoeuvres": TURNS * 3,
    "sway": {
        "roll": [{"amplitude_deg": 1, "frequency_hz": 0.3}],
        "pitch": [{"amplitude_deg": 1, "frequency_hz": 0.2}],
    },
    "imu": {"gyro_noise_deg_sqrt_h": 0.005, "accel_noise_ug_sqrt_hz": 40},
    "gnss": {
        "rate_hz": 1,
        "position_std_m": [1e-4] * 3,
        "velocity_std_m_s": [1e-5] * 3,
        "lever_arm_m": [1.77, 0.0, 0.1],
    },
    "dvl": {
        "rate_hz": 1,
        "misalignment_deg": [0.0, 0.0, 0.3],
        "scale_error": 0.001,
        "lever_arm_m": [-0.07, 0.0, 0.19],
        "velocity_std_m_s": 0.004,
        "velocity_std_fraction": 0.0,
    },
    "trial": {
        "imu": {
            "gyro_noise_deg_sqrt_h": 0.01,
            "gyro_bias_std_deg_h": 0.1,
            "accel_noise_ug_sqrt_hz": 500,
            "accel_bias_std_ug": 200,
        },
        "gnss": {
            "position_std_m": [0.3] * 3,
            "velocity_std_m_s": [0.02] * 3,
            "lever_arm_m": [0.0, 0.0, 0.0],
            "lever_arm_std_m": [5.0] * 3,
            "time_offset_std_s": 0.5,
        },
        "dvl": {
            "lever_arm_std_m": [1.0] * 3,
            "velocity_std_m_s": 0.01,
            "velocity_std_fraction": 0.002,
            "bias_std_m_s": [0.001] * 3,
            "time_offset_std_s": 0.5,
        },
    },
}
CLOCKS = [late("gnss", 0.41), late("dvl", -1.03)]


def run(seed):
    trial = with_faults(as_ins_output(simulate(scenario(**DIVE), seed), seed), CLOCKS)
    solution = solve(trial, rate_hz=1.0)
    errors = calibration_errors(solution, trial.calibration_truth)
    return solution.converged, errors.names, errors.error, errors.covariance


@pytest.fixture(scope="module")
def runs():
    return in_two_processes(run, range(RUNS))


def within(statistic, freedom):
    low, high = chi2.ppf([RARE / 2.0, 1.0 - RARE / 2.0], freedom)
    return low < statistic < high


def test_all_converge(runs):
    assert all(converged for converged, *_ in runs)


def test_standard_deviations_of_the_calibration_are_not_too_small(runs):
    # The IMU is stated ten times worse than it is: those of angles may be larger than errors.
    total = 0.0
    for _, names, error, covariance in runs:
        own = [names.index(name) for name in DVL]
        total += error[own] @ np.linalg.solve(covariance[np.ix_(own, own)], error[own])
    assert total < chi2.ppf(1.0 - RARE, len(DVL) * RUNS)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_standard_deviations_between_dvl_and_reference_point_hold(runs, axis):
    total = 0.0
    for _, names, error, covariance in runs:
        own = [names.index(f"{name}lever_arm_{axis}_m") for name in ("", "gnss_")]
        signs = np.array([1.0, -1.0])
        variance = signs @ covariance[np.ix_(own, own)] @ signs
        assert np.sqrt(variance) < 0.01
        total += (signs @ error[own]) ** 2 / variance
    assert within(total, RUNS)


@pytest.mark.parametrize("name", ["time_offset_s", "gnss_time_offset_s"])
def test_standard_deviations_of_clocks_hold(runs, name):
    rows = [(names.index(name), error, covariance) for _, names, error, covariance in runs]
    assert within(sum(e[i] ** 2 / P[i, i] for i, e, P in rows), RUNS)
