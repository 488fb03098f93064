"""A DVL whose axes, mount or water are not those of the model: stated, named, estimated."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from monte_carlo import DVL
from scipy.stats import chi2
from truth import CONFIGS

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, instrument_faults, parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

SWELL_HZ = 0.3
# Rows are what each axis of the DVL sees.
SCALES = np.diag([1.005, 0.995, 1.0])
SKEWED = np.array([[1.0, 0.0, 0.0], [np.radians(0.5), 1.0, 0.0], [0.0, 0.0, 1.0]])


def trial_in(seed, frequency_hz=SWELL_HZ, **claims):
    plan = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    for axis in ("roll", "pitch"):
        plan["sway"][axis][0]["frequency_hz"] = frequency_hz
    plan["trial"] = {"imu": plan["trial"]["imu"], "dvl": {"velocity_std_m_s": 0.001} | claims}
    return simulate(parse_scenario(plan), seed)


FAULTS = {
    "dvl_scale_difference": faults.axes_changed("dvl", SCALES.tolist()),
    "dvl_flex_by_tilt": instrument_faults.dvl_flexes((0.0, 0.0, 0.1 / 3.0)),
    "dvl_scale_by_speed_s_m": instrument_faults.dvl_scale_by_speed(0.002),
    "dvl_scale_by_time_1_h": faults.dvl_scale_drift(0.002),
    "dvl_truncation_m_s": instrument_faults.truncated("dvl", 0.01),
    "current_m_s": faults.dvl_water_track((0.1, 0.0, 0.0), np.inf),
    "gyro_delay_s": instrument_faults.gyros_late(0.01),
    "dvl_sawtooth_delay_s": instrument_faults.saw_of_delays("dvl", 0.01),
    "compass_deviation_deg": instrument_faults.compass_deviates((1.0, 0.5, 0.3, 0.2)),
}
EXPECTED = {
    "dvl_scale_by_speed_s_m": 0.002,
    "dvl_scale_by_time_1_h": 0.002 * 3600.0 / 450.0,
    # Half a digit.
    "dvl_truncation_m_s": 0.005,
    "current_m_s": (0.1, 0.0),
    "gyro_delay_s": 0.01,
    # By a clock that is late itself.
    "dvl_sawtooth_delay_s": 0.01 / 1.001,
    "compass_deviation_deg": (1.0, 0.5, 0.3, 0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", FAULTS)
def test_the_cause_is_named_and_estimated(name, seed):
    found = solve(faults.with_faults(trial_in(seed), [FAULTS[name]]), rate_hz=1.0)
    assert found.converged
    assert found.verdict.grade == "doubtful"
    first = found.verdict.reasons[0]
    assert first.code == Code.ESTIMATED_INSTEAD
    assert first.parameter == name
    e = found.estimate(name)
    if name in EXPECTED:
        # A delay of the gyros is taken to first order.
        assert np.all(np.abs(e.value - EXPECTED[name]) < np.maximum(4.0 * e.std, 1e-4))


@pytest.mark.slow
def test_velocities_that_are_levelled_are_named():
    """Of a DVL that takes roll and pitch out of them, whole turns of the mount by its tilt."""
    plan = yaml.safe_load((CONFIGS / "cruise.yaml").read_text(encoding="utf-8"))
    plan["manoeuvres"][2]["repeat"] = 1
    honest = simulate(parse_scenario(plan), 0)
    trial = faults.with_faults(honest, [instrument_faults.dvl_levelled()])
    found = solve(trial, rate_hz=1.0)
    first = found.verdict.reasons[0]
    assert first.parameter == "dvl_flex_by_tilt"
    assert "corrected by roll and pitch" in first.text
    e = found.estimate("dvl_flex_by_tilt")
    assert np.abs(e.value[[1, 2]]) == pytest.approx([1.0, 1.0], abs=0.01)


def test_an_honest_trial_is_told_of_none_of_these():
    found = solve(trial_in(2), rate_hz=1.0)
    assert found.verdict.grade == "good"
    assert not {e.name for e in found.estimates} & FAULTS.keys()


def test_a_whole_matrix_is_estimated_where_a_trial_says_so():
    claims = {"scale_error_std": [0.1] * 3, "axes_std_deg": [1.0] * 3}
    changes = [faults.axes_changed("dvl", (SKEWED @ SCALES).tolist())]
    trial = faults.with_faults(trial_in(3, **claims), changes)
    found = solve(trial, rate_hz=1.0)
    assert found.verdict.grade in ("good", "doubtful")
    assert not any(r.code == Code.ESTIMATED_INSTEAD for r in found.verdict.reasons)
    # The whole matrix: scales, axes and mounting make what was measured of body velocities.
    e = {name: found.estimate(name).value for name in ("scale_error", "dvl_axes_deg")}
    std = found.estimate("dvl_axes_deg").std
    # 0.5 deg of y alone are 0.25 deg of both axes, and a turn of the mount.
    assert abs(e["dvl_axes_deg"][0] - 0.5) < 4.0 * std[0] < 2.0
    truth = trial.calibration_truth["scale_error"][0]
    expected = (1.0 + truth) * np.diag(SCALES) - 1.0
    std = found.estimate("scale_error").std
    assert np.all(np.abs(e["scale_error"] - expected) < 4.0 * std)


def test_a_matrix_that_is_stated_costs_precision_and_no_honesty():
    trial = trial_in(4)
    settings = msgspec.structs.replace(trial.dvl.settings, axes_std_deg=(0.05,) * 3)
    stated = solve(replace(trial, dvl=replace(trial.dvl, settings=settings)), rate_hz=1.0)
    errors = calibration_errors(stated, trial.calibration_truth)
    rows = [errors.names.index(name) for name in DVL]
    P = errors.covariance[np.ix_(rows, rows)]
    nees = errors.error[rows] @ np.linalg.solve(P, errors.error[rows])
    assert nees < chi2.ppf(0.999, len(DVL))
