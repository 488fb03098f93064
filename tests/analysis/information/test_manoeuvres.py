"""Segments of a trial by motion, under sway."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from truth import CONING, SWELL, config, scenario

from factorgraph_dvl.analysis.information.manoeuvres import Segment, find_segments, given_segments
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.simulation import simulate

SEAS = {"calm": {}, "swell": SWELL, "2 Hz": CONING}


def segments_of(scene):
    return find_segments(simulate(scene).reference)


@pytest.mark.parametrize("sea", SEAS)
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_every_kind_of_motion_is_found(sea, noise):
    scene = scenario(
        start={"speed_m_s": 0},
        sway=SEAS[sea],
        current_m_s=[0.2, -0.2, 0],
        manoeuvres=[
            {"straight_s": 60},
            {"accelerate_m_s2": 0.1, "to_m_s": 4},
            {"straight_s": 60},
            {"turn_deg_s": -3, "duration_s": 60, "ramp_s": 4},
            {"straight_s": 60},
            {"turn_deg_s": 9, "duration_s": 20},
            {"straight_s": 60},
            {"stop_s": 40},
        ],
    )
    reference = simulate(scene).reference
    # A solution's velocity has some noise, as a reference has not.
    velocity = reference.velocity + np.random.default_rng(0).normal(
        0.0, noise, reference.velocity.shape
    )
    found = find_segments(type(reference)(**{**vars(reference), "velocity": velocity}))
    labels = ["drifting", "accelerating", "steady", "turning", "steady", "turning", "steady"]
    labels += ["accelerating", "drifting", "accelerating"]
    assert [s.label for s in found] == labels
    edges = [0, 60, 100, 160, 224, 284, 304, 364, 384, 424, 444]
    assert found[0].start == 0.0
    off = np.abs(np.array([s.end for s in found]) - edges[1:])
    # A ramp of 4 s begins and ends nowhere in particular.
    ramped = np.isin(edges[1:], [160, 224])
    assert off[ramped].max() < 3.0
    assert off[~ramped].max() < (1.2 if noise else 0.3)
    for before, after in pairwise(found):
        assert before.end == after.start


def test_a_circle_in_a_current_is_no_change_of_speed():
    turn = [{"turn_deg_s": 3, "duration_s": 240}]
    scene = scenario(manoeuvres=turn, current_m_s=[0.4, 0.3, 0])
    assert {s.label for s in segments_of(scene)} == {"turning"}


def test_mixtures():
    spiral = [{"straight_s": 60}]
    for i in range(6):
        spiral.append({"turn_deg_s": 5, "duration_s": 10})
        spiral.append({"accelerate_m_s2": -0.2, "to_m_s": 3.4 - 0.4 * i})
    labels = [s.label for s in segments_of(scenario(manoeuvres=spiral))]
    assert labels[0] == "steady"
    assert "turning and accelerating" in labels
    adrift = [{"straight_s": 60}, {"turn_deg_s": 3, "duration_s": 60}]
    scene = scenario(start={"speed_m_s": 0}, manoeuvres=adrift, current_m_s=[0.2, 0, 0])
    assert [s.label for s in segments_of(scene)] == ["drifting", "drifting and turning"]


@pytest.mark.parametrize("sea", SEAS)
def test_sway_is_no_manoeuvre(sea):
    straight = scenario(manoeuvres=[{"straight_s": 200}], sway=SEAS[sea])
    assert [s.label for s in segments_of(straight)] == ["steady"]


@pytest.mark.parametrize("seconds", [0.3, 2.0, 7.0])
def test_a_short_trial_is_one_segment(seconds):
    found = segments_of(scenario(manoeuvres=[{"straight_s": seconds}]))
    assert [s.label for s in found] == ["steady"]


def test_the_scenario_of_the_paper():
    found = segments_of(config("seed-a-phase-90"))
    kinds = ["steady", "turning"] * 3
    assert [s.label for s in found] == ["accelerating", *kinds, "accelerating"]
    np.testing.assert_allclose(
        [s.end for s in found], [4, 104, 149, 249, 299, 399, 449, 453], atol=0.3
    )


def test_given_segments_fill_the_trial():
    parts = [(-5.0, 10.0, "a"), (20.0, 30.0, "b"), (90.0, 120.0, "c")]
    assert given_segments(parts, 0.0, 100.0) == (
        Segment(0.0, 10.0, "a"),
        Segment(10.0, 20.0, "other"),
        Segment(20.0, 30.0, "b"),
        Segment(30.0, 90.0, "other"),
        Segment(90.0, 100.0, "c"),
    )
    for outside in ((200.0, 300.0, "x"), (-20.0, 0.0, "x")):
        with pytest.raises(ConfigError, match=r"segment `x`.*outside the trial.*0 and 100 s"):
            given_segments([outside], 0.0, 100.0)
