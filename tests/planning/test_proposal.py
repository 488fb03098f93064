from __future__ import annotations

import json
from itertools import product

import msgspec
import numpy as np
import pytest
from plans import CALM, STRAIGHT, required_of, std_of
from truth import scenario

import factorgraph_dvl.planning.proposal as proposing
from factorgraph_dvl.planning import predict, propose
from factorgraph_dvl.planning.prediction import extend
from factorgraph_dvl.planning.proposal import Item, Library, library
from factorgraph_dvl.report.files.plan import proposal_lines


def test_nothing_missed_nothing_proposed():
    prediction = predict(scenario(**STRAIGHT))
    assert propose(prediction, required_of(prediction, scale_error=0.01)) is None


def test_the_shortest_addition_is_proposed():
    prediction = predict(scenario(**STRAIGHT))
    required = required_of(prediction, lever_arm_x_m=0.2, lever_arm_y_m=0.2)
    tried = []
    found = propose(prediction, required, progress=lambda text, n, _: tried.append(text))
    assert found is not None
    assert found.met
    assert not found.missed
    assert found.tried == len(tried)
    # All that is shorter misses it, each predicted from the start.
    items = library(prediction.scenario, 4.0).items
    for item in items:
        if item.duration < found.added - 1e-9:
            whole = [*prediction.scenario.manoeuvres, *item.manoeuvres]
            other = predict(msgspec.structs.replace(prediction.scenario, manoeuvres=whole))
            assert not all(r.met for r in required_of(other, lever_arm_x_m=0.2, lever_arm_y_m=0.2))
    # And with the addition it is met.
    whole = [*prediction.scenario.manoeuvres, *found.manoeuvres]
    planned = predict(msgspec.structs.replace(prediction.scenario, manoeuvres=whole))
    again = required_of(planned, lever_arm_x_m=0.2, lever_arm_y_m=0.2)
    assert all(r.met for r in again)
    assert again == found.requirements
    assert planned.duration - prediction.duration == pytest.approx(found.added)


@pytest.mark.slow
def test_no_sequence_of_up_to_three_entries_is_shorter(monkeypatch):
    prediction = predict(scenario(manoeuvres=[{"straight_s": 30}], **CALM))
    items = (
        Item("straight", ({"straight_s": 20},), 20.0),
        Item("turn", ({"turn_deg_s": 9, "duration_s": 10},), 10.0),
        Item("stop", ({"stop_s": 5, "acceleration_m_s2": 0.8},), 15.0),
    )
    monkeypatch.setattr(proposing, "library", lambda *_: Library(items, None))
    # Computed once for all searches.
    tried, planned = {}, {}

    def remembered(scene, manoeuvres, ending):
        key = (json.dumps(manoeuvres), id(ending))
        if key not in tried:
            tried[key] = extend(scene, manoeuvres, ending)
        return tried[key]

    def predicted(scene):
        key = json.dumps(scene.manoeuvres)
        if key not in planned:
            planned[key] = predict(scene)
        return planned[key]

    monkeypatch.setattr(proposing, "extend", remembered)
    monkeypatch.setattr(proposing, "predict", predicted)
    ends, std, duration = {(): prediction.ending}, {}, {}
    for depth in (1, 2, 3):
        for parts in product(range(3), repeat=depth):
            last = items[parts[-1]]
            history, ends[parts] = remembered(
                prediction.scenario, list(last.manoeuvres), ends[parts[:-1]]
            )
            std[parts] = dict(zip(history.names, history.std[-1], strict=True))
            duration[parts] = sum(items[i].duration for i in parts)

    def shortest(required, slack):
        met = (s for s in std if all(std[s][n] <= slack * v for n, v in required.items()))
        return min(duration[s] for s in met)

    rng = np.random.default_rng(0)
    sequences = list(std)
    calibration = [n for n in prediction.history.names if not n.startswith(("gyro", "accel"))]
    several = 0
    for _ in range(10):
        goal = sequences[rng.integers(len(sequences))]
        names = rng.choice(calibration, size=3, replace=False).tolist()
        required = {n: 1.02 * std[goal][n] for n in names}
        found = propose(prediction, required_of(prediction, **required))
        if found is None:
            continue
        assert found.met
        assert found.shortest

        # Going on and starting again differ by up to 1 %.
        assert found.added <= shortest(required, 1.0 / 1.01) + 1e-6
        if len(found.names) <= 3:
            assert found.added >= shortest(required, 1.01) - 1e-6
        several += len(found.names) > 1
    assert several >= 5


def test_the_order_of_a_sequence_matters():
    # A straight run after a turn tells more than before it: the turn alone is too little, and
    # "straight, turn" is another result than "turn, straight".
    prediction = predict(scenario(**STRAIGHT))
    turn, straight = {"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 60}
    history, _ = extend(prediction.scenario, [turn, straight], prediction.ending)
    other, _ = extend(prediction.scenario, [straight, turn], prediction.ending)
    at = history.names.index("misalignment_y_deg")
    assert history.std[-1, at] < 0.9 * other.std[-1, at]
    required = required_of(prediction, misalignment_y_deg=1.005 * float(history.std[-1, at]))
    found = propose(prediction, required)
    assert found is not None
    assert found.shortest
    assert found.added <= 90.0 + 1e-6


def test_a_search_that_ends_early_says_so(monkeypatch):
    monkeypatch.setattr(proposing, "_MAX_TRIED", 20)
    prediction = predict(scenario(**STRAIGHT))
    history, _ = extend(
        prediction.scenario, [{"turn_deg_s": 3, "duration_s": 150}], prediction.ending
    )
    at = history.names.index("misalignment_y_deg")
    required = required_of(prediction, misalignment_y_deg=float(history.std[-1, at]))
    found = propose(prediction, required)
    assert found is not None
    assert found.tried <= 20
    assert not found.shortest
    assert found.limit < 150.0
    (line, *_) = proposal_lines(found)
    assert f"including all of up to {found.limit:.0f} s" in line


@pytest.mark.slow
def test_a_bias_that_walks_is_searched_for():
    walk = {"gyro_noise_deg_sqrt_h": 0.01, "gyro_bias_walk_deg_h_sqrt_h": 0.01}
    plan = STRAIGHT | {"imu": STRAIGHT["imu"] | walk}
    prediction = predict(scenario(**plan))
    assert "gyro_bias_x_deg_h" not in prediction.history.names
    before = std_of(prediction.solution)["gyro_bias_x_deg_h"]
    more = predict(scenario(**plan | {"manoeuvres": [{"straight_s": 60}] * 2}))
    after = std_of(more.solution)["gyro_bias_x_deg_h"]
    required = required_of(prediction, gyro_bias_x_deg_h=after)
    found = propose(prediction, required)
    assert found is not None
    assert found.met
    assert found.requirements[0].predicted <= after < before
    assert found.added <= 60.0 + 1e-6


def test_what_no_manoeuvre_shows_is_said_to_be_missed(monkeypatch):
    # Without sway nothing rolls or pitches: no lever arm z.
    monkeypatch.setattr(proposing, "_MAX_TRIED", 12)
    prediction = predict(scenario(**STRAIGHT))
    found = propose(prediction, required_of(prediction, lever_arm_x_m=0.3, lever_arm_z_m=0.3))
    assert found is not None
    assert not found.met
    assert found.tried <= 12
    (missed,) = found.missed
    assert missed.component == "lever_arm_z_m"
    assert missed.predicted > 9.9
