"""Water that a DVL sees for part of a trial: its span, its current, and what is said of it."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from truth import CONFIGS, config

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import faults, parse_scenario, simulate
from factorgraph_dvl.solvers import water_span
from factorgraph_dvl.solvers.batch import solve


def test_the_span_with_the_highest_score_is_found():
    """Blocks that know nothing of each other, of information 4: the third and the fourth err."""
    score = np.zeros((6, 2))
    score[2:4] = [3.0, -2.0]
    information = np.einsum("kl,ab->kalb", 4.0 * np.eye(6), np.eye(2))
    assert water_span._best(score, information) == (2, 3)


def test_the_whole_record_is_no_span():
    """A current all the time is another candidate."""
    score = np.tile([3.0, -2.0], (6, 1))
    information = np.einsum("kl,ab->kalb", 4.0 * np.eye(6), np.eye(2))
    first, last = water_span._best(score, information)
    assert last - first == 4


def test_parts_beside_a_span_are_as_long():
    np.testing.assert_array_equal(water_span._parts_beside(40, 60, 100), [0, 20, 40, 60, 80, 100])
    # Short ones are as long as what persists for seconds.
    np.testing.assert_array_equal(water_span._parts_beside(0, 5, 300)[:4], [0, 5, 15, 25])


def test_scores_elsewhere_show_how_far_noise_goes():
    """Blocks of information 4 whose scores are 6 away from the span, by hand: 36 / 4 = 9."""
    score = np.full((5, 2), 6.0)
    score[2] = 100.0
    information = np.einsum("kl,ab->kalb", 4.0 * np.eye(5), np.eye(2))
    inside = np.array([False, False, True, False, False])
    assert water_span._elsewhere(score, information, inside) == pytest.approx(9.0)
    # As little as white noise has is no less.
    assert water_span._elsewhere(0.1 * score, information, inside) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 4])
def test_noise_that_persists_for_seconds_is_no_water(seed):
    """With 70 % of the noise over 2 s, a span of 30 s fitted as a current of 5 mm/s."""
    noise = {"correlated_share": 0.7, "correlation_time_s": 2.0}
    found = solve(simulate(config("seed-a-phase-90", dvl=noise), seed), rate_hz=1.0)
    assert found.verdict.grade == "good"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.study)])
def test_a_layer_of_water_below_is_named_and_estimated(seed):
    """Without GNSS for thirteen minutes, a third of the trial looked like wrong fixes."""
    plan = yaml.safe_load((CONFIGS / "dive.yaml").read_text(encoding="utf-8"))
    next(m for m in plan["manoeuvres"] if "repeat" in m)["repeat"] = 1
    plan["gnss"]["outages_s"] = [[305, 1080]]
    del plan["dvl"]["no_lock_s"]
    plan["trial"] = {}
    trial = simulate(parse_scenario(plan), seed)
    found = solve(
        faults.with_faults(trial, [faults.dvl_water_track((0.24, 0.18, 0.0), share=1.0 / 3.0)]),
        rate_hz=1.0,
    )
    assert found.verdict.grade == "doubtful"
    reason = found.verdict.reasons[0]
    assert reason.code == Code.ESTIMATED_INSTEAD
    assert reason.parameter == "water_current_m_s"
    assert "from 400 to 800 s" in reason.text
    current = found.estimate("water_current_m_s")
    # The fault adds to what a DVL with a scale error says.
    truth = np.array([0.24, 0.18]) / (1.0 + trial.calibration_truth["scale_error"])
    assert np.all(np.abs(current.value - truth) < 4.0 * current.std)
