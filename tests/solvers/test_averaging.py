"""A DVL, or velocities of GNSS, that average: stated, found, or not there."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import yaml
from monte_carlo import DVL, RUNS, nees_of
from scipy.stats import chi2
from truth import CONFIGS, scenario

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.initialization.clock_offsets import ClockOffset
from factorgraph_dvl.plausibility.clocks import clock_findings
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.results import windows_left_out
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.faults import with_faults
from factorgraph_dvl.simulation.instrument_faults import dvl_averages
from factorgraph_dvl.solvers.averaging import without_hidden
from factorgraph_dvl.solvers.batch import solve, solved_problems
from factorgraph_dvl.solvers.record_scores import by_lengths, by_square

SWELL_HZ = 0.3


def plan_in_swell():
    """Return the scenario of a navigation-grade trial in swell."""
    plan = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    for axis in ("roll", "pitch"):
        plan["sway"][axis][0]["frequency_hz"] = SWELL_HZ
    return plan


def trial_of(length_s, seed, **claims):
    """Return a trial in swell whose DVL averages."""
    plan = plan_in_swell()
    plan["dvl"]["averaging_s"] = length_s
    plan["trial"]["dvl"] |= claims
    return simulate(parse_scenario(plan), seed)


def sigma_of(solution, name):
    i = solution.order.index(name)
    return float(np.sqrt(solution.covariance[i][i]))


@pytest.mark.slow
def test_a_stated_window_costs_no_precision_and_a_window_of_none_is_left_alone():
    trial = trial_of(0.5, 1, averaging_s=0.5)
    stated = solve(trial)
    assert nees_of(stated, trial) < chi2.ppf(0.999, 7)
    none = trial_of(0.0, 1, averaging_s=0.0, averaging_std_s=0.0)
    certain = solve(none)
    for found in (stated, certain):
        assert "averaging_s" not in found.order
    for name in DVL:
        assert sigma_of(stated, name) < 1.1 * sigma_of(certain, name)


@pytest.mark.slow
def test_a_window_that_is_not_stated_is_found():
    trial = trial_of(0.5, 2)
    found = solve(trial)
    length = found.estimate("averaging_s")
    assert abs(length.value[0] - 0.5) < 4.0 * length.std[0] < 0.1
    assert nees_of(found, trial) < chi2.ppf(0.999, 7)


@pytest.mark.slow
@pytest.mark.parametrize("grade", ["tactical", "mems"])
def test_noise_of_gyros_hides_no_window(grade):
    """Their noise was most of the curvature by which a window shows, and hid half a second."""
    plan = plan_in_swell()
    mix = yaml.safe_load((CONFIGS / f"data-sheet-mix-{grade}.yaml").read_text(encoding="utf-8"))
    plan["imu"] = {k: v for k, v in mix["imu"].items() if not k.startswith("time_offset")}
    del plan["trial"]["imu"]
    plan["dvl"]["averaging_s"] = 0.5
    trial = simulate(parse_scenario(plan), 1)
    found = solve(trial)
    assert found.verdict.grade == "good"
    assert abs(found.estimate("averaging_s").value[0] - 0.5) < 0.05
    assert nees_of(found, trial) < chi2.ppf(0.999, 7)


@pytest.mark.slow
def test_noise_of_an_imu_is_no_window_and_moves_none():
    """Of a consumer IMU, whose noise a longer window averages: a DVL without and with one."""
    off = []
    for length, noise in ((0.0, 300.0), *[(0.5, 150.0)] * max(RUNS // 4, 3)):
        plan = yaml.safe_load((CONFIGS / "cruise.yaml").read_text(encoding="utf-8"))
        plan["manoeuvres"][2]["repeat"] = 1
        plan["imu"] |= {"gyro_noise_deg_sqrt_h": 0.1, "accel_noise_ug_sqrt_hz": noise}
        plan["dvl"]["averaging_s"] = length
        plan["trial"]["dvl"]["averaging_s"] = 0
        trial = simulate(parse_scenario(plan), len(off))
        found = solve(trial, rate_hz=1.0)
        assert found.verdict.grade == "good"
        assert nees_of(found, trial) < chi2.ppf(0.999, 7)
        if length > 0.0:
            (e,) = (e for e in found.estimates if e.name == "averaging_s")
            off.append((e.value[0] - length) / e.std[0])
    # It was 4 standard deviations.
    assert np.abs(np.mean(off)) < 1.0 + 3.0 / np.sqrt(len(off)), off


@pytest.mark.slow
def test_a_long_window_is_no_contradiction():
    found = solve(trial_of(2.0, 1))
    assert found.estimate("averaging_s").value[0] == pytest.approx(2.0, abs=0.02)
    assert not {Code.FAR_FROM_PRIOR} & {f.code for f in found.findings}


@pytest.mark.slow
@pytest.mark.parametrize("length_s", [1.0, 3.0])
def test_a_mean_of_pings_is_found_by_its_shape(length_s):
    """Its noise persists, which is more of the misfit than what the window hides of the swell."""
    trial = with_faults(trial_of(0.0, 3), [dvl_averages(length_s)])
    found = solve(trial, rate_hz=1.0)
    length = found.estimate("averaging_s")
    truth = trial.calibration_truth["averaging_s"][0]
    assert abs(length.value[0] - truth) < 4.0 * length.std[0] + 0.002
    assert length.std[0] < 0.05
    assert nees_of(found, trial) < chi2.ppf(0.999, 7)
    assert found.verdict.grade != "do not use"
    (noise,) = (f for f in found.findings if f.code == Code.SMALL_RESIDUALS)
    assert noise.severity == "note"


def estimated_window(length_s):
    one = np.ones(1)
    name = ("averaging_s",)
    return Estimate(*name, name, length_s * one, 0.01 * one, 0.0 * one, one, one > 0.0)


def test_what_a_window_hides_is_no_clock():
    """Sway of 0.4 Hz is nearly gone in a mean over two seconds: a delay of 0.2 s seemed to be."""
    trial = trial_of(2.0, 1, averaging_s=2.0, averaging_std_s=0.0)
    clock = ClockOffset(0.2, 0.03, 0.0, 0.0, 0.0, 0.0, np.nan, 0.0, 100.0, 0.1)
    assert not [*clock_findings(trial.dvl, clock, 450.0)]
    unstated = trial_of(2.0, 1)
    found = [*clock_findings(unstated.dvl, clock, 450.0)]
    assert [f.code for f in found] == [Code.CLOCK_OFFSET]
    length = estimated_window(2.0)
    assert without_hidden(found, unstated.aids, [length]) == ()
    assert without_hidden(found, unstated.aids, [replace(length, value=np.array([0.3]))])


@pytest.mark.slow
@pytest.mark.parametrize("length_s", [0.0, 0.1, 0.2, 0.5, 1.0, 2.0])
def test_standard_deviations_hold_whatever_the_window(length_s):
    nees, of_length = [], []
    for seed in range(RUNS):
        trial = trial_of(length_s, seed)
        found = solve(trial)
        nees.append(nees_of(found, trial))
        if "averaging_s" in found.order:
            length = found.estimate("averaging_s")
            of_length.append((length.value[0] - length_s) / length.std[0])
    low, high = chi2.ppf([0.005, 0.995], 7 * RUNS)
    assert low < sum(nees) < high, np.round(np.array(nees) / 7, 2)
    if length_s > 0.1:
        assert len(of_length) == RUNS
        assert np.square(of_length).sum() < chi2.ppf(0.995, RUNS), np.round(of_length, 1)


def test_a_stamp_at_the_end_is_half_a_window_late():
    trial = trial_of(1.0, 1, averaging_s=1.0, stamp="end", time_offset_std_s=0.0)
    late = replace(trial, dvl=replace(trial.dvl, time=trial.dvl.time + 0.5))
    assert late.dvl.settings.stamp == "middle"
    found = solve(late)
    assert nees_of(found, late) < chi2.ppf(0.999, 7)
    assert found.verdict.grade == "good"


@pytest.mark.slow
def test_single_beams_average_too():
    plan = plan_in_swell()
    del plan["dvl"], plan["trial"]["dvl"]
    plan["dvl_beams"] = {
        "rate_hz": 5,
        "slant_azimuth_deg": [[30, bearing] for bearing in (45, 135, 225, 315)],
        "lever_arm_m": [1.0, 1.2, 1.4],
        "velocity_std_m_s": 0.003,
        "averaging_s": 0.5,
    }
    plan["trial"]["dvl_beams"] = {"time_offset_std_s": 0}
    trial = simulate(parse_scenario(plan), 1)
    found = solve(trial)
    length, arm = found.estimate("averaging_s"), found.estimate("lever_arm_m")
    assert abs(length.value[0] - 0.5) < 4.0 * length.std[0] < 0.2
    assert np.all(np.abs(arm.value - [1.0, 1.2, 1.4]) < 4.0 * arm.std)
    assert np.all(arm.std < 0.02)


ANTENNA = tuple(f"gnss_lever_arm_{axis}_m" for axis in "xyz")
SEA = {
    "roll": [{"amplitude_deg": 6, "frequency_hz": 0.15}],
    "pitch": [{"amplitude_deg": 3, "frequency_hz": 0.2, "phase_deg": 60}],
    "heave": [{"amplitude_m": 0.3, "frequency_hz": 0.17}],
}


def trial_of_gnss(length_s, delay_s, seed, **claims):
    """Return a trial in a seaway whose GNSS velocities are means, six metres above the IMU."""
    gnss = {
        "velocity_averaging_s": length_s,
        "velocity_delay_s": delay_s,
        "velocity_std_m_s": [0.02] * 3,
        "lever_arm_m": [0.5, -2.0, 6.0],
        "rate_hz": 1,
    }
    claims = {"gnss": {"lever_arm_std_m": [0.1] * 3, **claims}}
    return simulate(scenario(noise=True, sway=SEA, gnss=gnss, trial=claims), seed)


@pytest.mark.parametrize("delay_s", [0.0, 0.5])
def test_a_window_of_gnss_velocities_that_is_not_stated_is_found(delay_s):
    trial = trial_of_gnss(1.0, delay_s, 4, time_offset_std_s=0.5)
    found = solve(trial, rate_hz=1.0)
    expected = {"gnss_velocity_averaging_s": 1.0, "gnss_velocity_delay_s": delay_s}
    for name, value in expected.items():
        if value:
            e = found.estimate(name)
            assert abs(e.value[0] - value) < 4.0 * e.std[0] < 0.4
        else:
            assert name not in found.order
    assert nees_of(found, trial, ANTENNA) < chi2.ppf(0.999, 3)
    named = {f.parameter for f in found.findings if f.code == Code.AVERAGING}
    assert named == {name for name, value in expected.items() if value}
    assert found.verdict.grade == "good"


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("length_s", [0.0, 0.5, 1.0, 2.0])
def test_standard_deviations_hold_whatever_the_window_of_gnss(length_s, late):
    """Without the window, the antenna is 9 sigma off in height after 1 s, and 25 after 2 s."""
    delay_s = 0.5 * length_s if late else 0.0
    truth = {"gnss_velocity_averaging_s": length_s, "gnss_velocity_delay_s": delay_s}
    nees, of_antenna, of_times = [], [], []
    for seed in range(RUNS):
        trial = trial_of_gnss(length_s, delay_s, seed)
        found = solve(trial, rate_hz=1.0)
        nees.append(nees_of(found, trial))
        of_antenna.append(nees_of(found, trial, ANTENNA))
        times = [found.estimate(name) for name in truth if name in found.order]
        of_times += [((e.value[0] - truth[e.name]) / e.std[0]) ** 2 for e in times]
        if length_s >= 1.0:
            assert len(times) == 1 + late
    for squares, freedom in ((nees, 7), (of_antenna, 3)):
        low, high = chi2.ppf([0.005, 0.995], freedom * RUNS)
        assert low < sum(squares) < high, np.round(np.array(squares) / freedom, 2)
    if length_s >= 1.0:
        assert sum(of_times) < chi2.ppf(0.995, len(of_times)), np.round(of_times, 1)


def test_the_square_of_a_window_changes_what_is_predicted_as_the_window_does():
    trial = trial_of_gnss(0.0, 0.0, 1)
    solved, *_ = solved_problems(trial)
    problem, evaluation = solved.problem, solved.minimum.evaluation
    checked = 0
    for bound, motion in zip(problem.bound, evaluation.motions, strict=True):
        name = bound.observation.averaging
        if name is None:
            continue
        own = problem.processes_of(bound)
        means = []
        for length in (0.0, 0.3):
            values = evaluation.parameters | {name: np.array([length])}
            there = bound.motion(bound.attached(values), evaluation.states, values)
            means.append(bound.residual(there, values, own))
        inside = slice(2, -2)
        found = by_square(problem, bound, motion, evaluation)[inside, :, 0]
        expected = ((means[1] - means[0]) / 0.3**2)[inside]
        # Of noise, both have a share of their own; of a mean in n, products of rates are left out.
        assert np.vdot(found, expected) == pytest.approx(np.vdot(expected, expected), rel=0.04)
        assert np.linalg.norm(found - expected) < 0.2 * np.linalg.norm(expected)
        checked += 1
        lengths, changes = by_lengths(problem, bound, motion, evaluation, 0.3)
        i = int(np.argmin(np.abs(lengths - 0.3)))
        assert lengths[i] == pytest.approx(0.3)
        whole = means[1] - means[0]
        assert changes[inside, :, i] == pytest.approx(
            whole[inside], abs=0.1 * float(np.abs(whole).max())
        )
    assert checked == 2


def test_a_window_that_is_left_out_is_said_of_single_beams_too():
    plan = yaml.safe_load((CONFIGS / "cruise-beams.yaml").read_text(encoding="utf-8"))
    plan["manoeuvres"] = [{"straight_s": 5}]
    trial = simulate(parse_scenario(plan), 1)
    assert windows_left_out(trial.aids) == []
    settings = msgspec.structs.replace(trial.beams.settings, averaging_s=0.5)
    averaging = replace(trial.beams, settings=settings)
    aids = [averaging if aid is trial.beams else aid for aid in trial.aids]
    (found,) = windows_left_out(aids)
    assert found.code == Code.ERROR_LEFT_OUT
    assert "dvl_beams.averaging_s" in found.text


def test_a_window_of_gnss_that_is_left_out_is_said():
    trial = trial_of_gnss(0.0, 0.0, 1)
    assert windows_left_out(trial.aids) == []
    averaging = trial_of_gnss(0.0, 0.0, 1, velocity_averaging_s=1.0)
    (found,) = windows_left_out(averaging.aids)
    assert found.sensor == averaging.gnss.label
    assert "gnss.velocity_averaging_s" in found.text
