"""What is stated as known and is not: named, estimated instead, and seldom by chance."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from truth import TURNS_AND_BRAKING, merged, scenario

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, simulate
from factorgraph_dvl.solvers.batch import solve

SCENE = {
    "noise": True,
    "manoeuvres": TURNS_AND_BRAKING,
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.005},
    "gnss": {"position_std_m": [0.1, 0.1, 0.2], "velocity_std_m_s": [0.03] * 3},
    "dvl": {"velocity_std_fraction": 0.001},
    "trial": {"dvl": {"velocity_std_fraction": 0.001}},
}


def known(trial):
    """State that clocks, antenna and bias are known."""
    gnss = msgspec.structs.replace(
        trial.gnss.settings, lever_arm_std_m=(0.0,) * 3, time_offset_std_s=0.0
    )
    dvl = msgspec.structs.replace(
        trial.dvl.settings, time_offset_std_s=0.0, bias_std_m_s=(0.0,) * 3
    )
    return replace(
        trial,
        gnss=replace(trial.gnss, settings=gnss),
        dvl=replace(trial.dvl, settings=dvl),
    )


@pytest.fixture(scope="module")
def trial():
    return known(simulate(scenario(**merged({}, SCENE)), 4))


def late(trial, sensor, seconds):
    record = getattr(trial, sensor)
    return replace(trial, **{sensor: replace(record, time=record.time + seconds)})


def biased(trial, change):
    return replace(trial, dvl=replace(trial.dvl, velocity=trial.dvl.velocity + change))


def turned_too_far(trial, ppm):
    gyro = trial.imu.gyro * np.array([1.0, 1.0, 1.0 + 1e-6 * ppm])
    return replace(trial, imu=replace(trial.imu, gyro=gyro))


def test_the_wrong_sampling_is_named_beside_the_scale_that_it_looks_like():
    sway = {
        "roll": [{"amplitude_deg": 4, "frequency_hz": 2}],
        "pitch": [{"amplitude_deg": 4, "frequency_hz": 2, "phase_deg": 90}],
    }
    swaying = known(simulate(scenario(**merged({"sway": sway}, SCENE)), 4))
    solution = solve(faults.with_faults(swaying, [faults.sampling_misstated()]), rate_hz=1.0)
    (finding,) = (f for f in solution.findings if f.parameter == "gyro_scale_ppm")
    assert finding.code == Code.ESTIMATED_INSTEAD
    assert "imu.sampling would explain it about as well" in finding.text


FAULTS = {
    "time_offset_s": (lambda t: late(t, "dvl", 0.02), 0.02),
    "gnss_time_offset_s": (lambda t: late(t, "gnss", 0.08), 0.08),
    "dvl_bias_m_s": (lambda t: biased(t, np.array([0.0, 0.03, 0.0])), 0.03),
    "gyro_scale_ppm": (lambda t: turned_too_far(t, 5000.0), 5000.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_the_cause_is_named_and_estimated(trial, name):
    fault, size = FAULTS[name]
    solution = solve(fault(trial), rate_hz=1.0)
    (finding,) = (f for f in solution.findings if f.code == Code.ESTIMATED_INSTEAD)
    assert finding.parameter == name
    assert "sampling" not in finding.text
    found = solution.estimate(name)
    i = int(np.argmax(np.abs(found.value)))
    assert abs(found.value[i] - size) < 4.0 * found.std[i]
    assert solution.converged
    assert solution.verdict.grade == "doubtful"
    truth = trial.calibration_truth
    for main in ("misalignment_deg", "scale_error", "lever_arm_m"):
        e = solution.estimate(main)
        assert np.all(np.abs(e.value - truth[main]) < 4.0 * e.std)


def test_nothing_is_freed_without_a_misfit(trial):
    solution = solve(trial, rate_hz=1.0)
    codes = {f.code for f in solution.findings}
    assert not codes & {Code.ESTIMATED_INSTEAD, Code.UNEXPLAINED_MISFIT}
    assert {e.name for e in solution.estimates}.isdisjoint(FAULTS)


def test_a_prior_that_the_data_put_far_outside_is_widened(trial):
    settings = msgspec.structs.replace(trial.dvl.settings, bias_std_m_s=(0.001,) * 3)
    stated = replace(trial, dvl=replace(trial.dvl, settings=settings))
    solution = solve(biased(stated, np.array([0.0, 0.03, 0.0])), rate_hz=1.0)
    (finding,) = (f for f in solution.findings if f.code == Code.ESTIMATED_INSTEAD)
    assert "0, 0, 0 m/s ± 0.001, 0.001, 0.001 m/s" in finding.text
    bias = solution.estimate("dvl_bias_m_s")
    assert abs(bias.value[1] - 0.03) < 4.0 * bias.std[1]
    scale = solution.estimate("scale_error")
    assert abs(scale.value[0] - 0.005) < 4.0 * scale.std[0]


@pytest.mark.slow
def test_a_depth_that_is_too_large_is_named_and_no_scale_of_the_dvl():
    """By 1 %, in a dive to 40 m with fixes at the surface; and a sensor that is right."""
    down = [{"climb_m_s": -0.5, "to_height_m": -30}, {"straight_s": 60}]
    up = [{"climb_m_s": 0.5, "to_height_m": 10}, {"straight_s": 60}]
    dive = scenario(
        noise=True,
        manoeuvres=[{"straight_s": 60}, *down, *up],
        start={"lat_deg": 36, "lon_deg": 121, "height_m": 10, "speed_m_s": 1.5},
        gnss={"outages_s": [[60, 300]], "position_std_m": [0.1, 0.1, 0.1]},
        dvl={"rate_hz": 2},
        depth={"rate_hz": 1, "std_m": 0.02, "sea_surface_height_m": 11.0},
    )
    trial = simulate(dive, 0)
    (depth,) = trial.others
    for factor in (1.0, 1.01):
        wrong = replace(trial, others=(replace(depth, depth=factor * depth.depth),))
        solution = solve(wrong, rate_hz=1.0)
        named = [r for r in solution.verdict.reasons if r.code == Code.ESTIMATED_INSTEAD]
        assert [r.parameter for r in named] == ["depth_scale_error"][: int(factor > 1.0)]
        for reason in named:
            assert "depth: {scale_error_std: …}" in reason.text
            e = solution.estimate("depth_scale_error")
            assert e.value[0] == pytest.approx(0.01, abs=4.0 * e.std[0])
