"""Plans: predictions against solved trials, what is required, and what is proposed."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from truth import CONFIGS, merged, scenario

import factorgraph_dvl.planning.proposal as proposing
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.planning import predict, propose, requirements
from factorgraph_dvl.planning.library import Item, Library, library
from factorgraph_dvl.planning.prediction import extend
from factorgraph_dvl.report.files.plan import proposal_lines
from factorgraph_dvl.simulation import load_scenario, parse_scenario, plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve

CALM = {"sway": {}, "current_m_s": [0.2, 0, 0]}
STRAIGHT = {"manoeuvres": [{"straight_s": 60}], **CALM}
WALKING = {"imu": {"gyro_noise_deg_sqrt_h": 0.1, "gyro_bias_walk_deg_h_sqrt_h": 1.0}}


def std_of(solution):
    return dict(zip(solution.order, np.sqrt(np.diag(solution.covariance)), strict=True))


def required_of(prediction, **required):
    values = {k: v if isinstance(v, tuple) else (v,) for k, v in required.items()}
    return requirements(values, prediction.solution.estimates, "plan.yaml")


@pytest.mark.parametrize("changes", [{}, WALKING], ids=["constant", "walking"])
def test_a_prediction_is_what_the_solver_claims(changes):
    scene = scenario(**changes)
    predicted = predict(scene).solution
    solved = solve(simulate(msgspec.structs.replace(scene, noise=True), 1))
    assert predicted.order == solved.order
    found, claimed = std_of(predicted), std_of(solved)
    for name in predicted.order:
        # The σ of a ping depends on the measured speed, the rest on where one linearises.
        assert found[name] == pytest.approx(claimed[name], rel=0.02), name
    # Values are the truth: nothing is drawn.
    assert predicted.estimate("lever_arm_m").value == pytest.approx([1.0, 1.2, 1.4])
    assert predicted.estimate("misalignment_deg").value == pytest.approx([2.0, 2.0, 30.0])


def test_a_prediction_claims_nothing_that_noise_would_feign():
    predicted = predict(scenario(**STRAIGHT)).solution
    solved = solve(simulate(scenario(noise=True, **STRAIGHT), 1))
    for name in ("misalignment_deg", "lever_arm_m", "scale_error"):
        expected = solved.estimate(name).observable.tolist()
        assert predicted.estimate(name).observable.tolist() == expected, name


def test_one_scale_for_an_instrument_that_has_three():
    scene = scenario(dvl={"scale_error": [0.005, 0.006, 0.004]})
    predicted = predict(scene)
    assert predicted.solution.estimate("scale_error").value == pytest.approx([0.005])
    solved = solve(simulate(msgspec.structs.replace(scene, noise=True), 1))
    claimed = std_of(solved)["scale_error"]
    assert std_of(predicted.solution)["scale_error"] == pytest.approx(claimed, rel=0.02)
    history, _ = extend(predicted.scenario, [{"straight_s": 10}], predicted.ending)
    assert np.isfinite(history.std).all()


def test_going_on_is_as_good_as_starting_again():
    scene = scenario(current_m_s=[0.2, 0.1, 0])
    more = [{"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 20}]
    first = predict(scene)
    history, ending = extend(first.scenario, more, first.ending)
    second, ending = extend(first.scenario, [{"straight_s": 20}], ending)
    whole = predict(
        msgspec.structs.replace(scene, manoeuvres=[*scene.manoeuvres, *more, {"straight_s": 20}])
    )
    np.testing.assert_allclose(second.std[-1], whole.history.std[-1], rtol=0.01)
    assert np.all(second.std[-1] <= history.std[-1] * (1.0 + 1e-9))
    assert ending.time == pytest.approx(whole.duration)
    assert ending.start.heading_deg == pytest.approx(whole.ending.start.heading_deg)
    assert ending.start.lat_deg == pytest.approx(whole.ending.start.lat_deg, abs=1e-7)


def test_figure_eight_and_stop():
    parts = [{"figure_eight_deg_s": 6, "ramp_s": 3}, {"stop_s": 10, "acceleration_m_s2": 0.4}]
    motion = plan_motion(scenario(manoeuvres=parts, **CALM))
    circle = 360.0 / 6.0 + 3.0
    assert motion.duration == pytest.approx(2 * circle + 10.0 + 10.0 + 10.0)
    start = float(motion.course(0.0))
    time = np.linspace(0.0, circle, 200)
    assert float(motion.course(circle)) - start == pytest.approx(2 * np.pi)
    assert np.all(np.diff(motion.course(time)) >= 0.0)
    assert float(motion.course(2 * circle)) == pytest.approx(start)
    assert motion.speed(2 * circle + np.array([0.0, 10.0, 15.0, 20.0, 30.0])) == pytest.approx(
        [4.0, 0.0, 0.0, 0.0, 4.0], abs=1e-9
    )
    at_rest = scenario(start={"speed_m_s": 0}, manoeuvres=[{"stop_s": 10}])
    assert plan_motion(at_rest).duration == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("manoeuvre", "message"),
    [
        ({"figure_eight_deg_s": 0}, "must not be 0"),
        ({"figure_eight_deg_s": 90, "ramp_s": 5}, "must not exceed"),
        ({"stop_s": -1}, ">= 0"),
        ({"stop_s": 1, "acceleration_m_s2": 0}, "> 0"),
    ],
)
def test_wrong_manoeuvres(manoeuvre, message):
    with pytest.raises(ConfigError, match=r"manoeuvres\[0\]") as caught:
        scenario(manoeuvres=[manoeuvre])
    assert message in str(caught.value)


def test_requirements():
    prediction = predict(scenario(**STRAIGHT))
    found = required_of(
        prediction, misalignment_deg=(0.1, 0.2, 0.3), lever_arm_m=0.5, lever_arm_z_m=20.0
    )
    assert {r.component: r.required for r in found} == {
        "misalignment_x_deg": 0.1,
        "misalignment_y_deg": 0.2,
        "misalignment_z_deg": 0.3,
        "lever_arm_x_m": 0.5,
        "lever_arm_y_m": 0.5,
        "lever_arm_z_m": 20.0,
    }
    assert [r.component for r in found if r.met] == ["lever_arm_z_m"]
    with pytest.raises(ConfigError, match=r"required\.lever_arm: .* is not estimated"):
        required_of(prediction, lever_arm=0.1)
    with pytest.raises(ConfigError, match="2 numbers are given; expected 1, or 3"):
        required_of(prediction, lever_arm_m=(0.1, 0.1))


@pytest.mark.parametrize("value", ["0", "-1", "[]", "much", "[1, x]", "{a: 1}", ".nan"])
def test_wrong_requirements(value, tmp_path):
    text = (CONFIGS / "plans" / "harbour.yaml").read_text()
    file = tmp_path / "plan.yaml"
    file.write_text(text.partition("required:")[0] + f"required:\n  scale_error: {value}\n")
    with pytest.raises(ConfigError, match=r"plan.yaml.*required"):
        load_scenario(file)


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


def test_a_bias_that_walks_is_searched_for():
    changes = {"imu": {"gyro_noise_deg_sqrt_h": 0.01, "gyro_bias_walk_deg_h_sqrt_h": 0.01}}
    prediction = predict(scenario(**changes, **STRAIGHT))
    assert "gyro_bias_x_deg_h" not in prediction.history.names
    before = std_of(prediction.solution)["gyro_bias_x_deg_h"]
    more = predict(scenario(**changes, **{**STRAIGHT, "manoeuvres": [{"straight_s": 60}] * 2}))
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


def test_every_entry_of_the_library_is_feasible_from_its_end():
    for start in (0.0, 3.0):
        scene = scenario(start={"speed_m_s": start}, manoeuvres=[{"straight_s": 10}], **CALM)
        found = library(scene, start)
        assert (found.under_way is None) == (start > 0.0)
        before = [] if found.under_way is None else list(found.under_way.manoeuvres)
        for item in found.items:
            twice = [*scene.manoeuvres, *before, *item.manoeuvres, *item.manoeuvres]
            motion = plan_motion(msgspec.structs.replace(scene, manoeuvres=twice))
            extra = 0.0 if found.under_way is None else found.under_way.duration
            assert motion.duration == pytest.approx(10.0 + extra + 2.0 * item.duration)


def run_cli(capsys, *args):
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    text = capsys.readouterr()
    return caught.value.code, text.out, text.err


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, out = tmp_path / "plan.yaml", tmp_path / "out"
    text = (CONFIGS / "plans" / "harbour.yaml").read_text().partition("required:")[0]
    plan.write_text(text + "required: {misalignment_z_deg: 0.02, scale_error: 0.001}\n")
    code, text, _ = run_cli(capsys, "plan", plan, "--out", out)
    assert code == 0
    found = json.loads((out / "plan.json").read_text())
    assert found["missed"] == ["misalignment_z_deg"]
    proposal = found["proposal"]
    assert proposal["met"]
    assert f"Add {proposal['added_s']:.0f} s" in text
    for name in ("observability.json", "history.csv", "std_along_trial.png", "directions.png"):
        assert (out / name).exists()
    assert json.loads((out / "observability.json").read_text())["kind"] == "plan"
    # What is proposed can be put into the plan as it stands.
    data = yaml.safe_load(plan.read_text())
    data["manoeuvres"] += proposal["manoeuvres"]
    del data["required"]
    assert plan_motion(parse_scenario(data)).duration == pytest.approx(
        found["duration_s"] + proposal["added_s"]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"required": {"lever_arm": 1}}, "required.lever_arm: lever_arm is not estimated"),
        ({"required": [1]}, "required is [1]"),
        ({"manoeuvres": [{"loop_s": 1}]}, "exactly one of"),
        ({"nonsense": 1}, "nonsense"),
    ],
)
def test_wrong_plans(change, message, tmp_path: Path, capsys) -> None:
    file, out = tmp_path / "plan.yaml", tmp_path / "out"
    data = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text())
    file.write_text(yaml.safe_dump(merged(data, change)))
    if isinstance(change.get("required"), dict):
        file.write_text(yaml.safe_dump({**data, **change}))
    code, _, err = run_cli(capsys, "plan", file, "--out", out, "--quiet")
    assert code == 2
    assert "plan.yaml" in err
    assert message in err
    assert not out.exists()


@pytest.mark.parametrize("name", ["no gnss", "no dvl", "adrift", "two seconds"])
def test_plans_that_tell_nothing(name, tmp_path: Path, capsys) -> None:
    changes = {
        "no gnss": {"gnss": None, "trial": {"initial": {"position_std_m": [1, 1, 1]}}},
        "no dvl": {"dvl": None, "required": None},
        "adrift": {"manoeuvres": [{"straight_s": 20}], "required": None},
        "two seconds": {"manoeuvres": [{"straight_s": 2}], "required": None},
    }[name]
    data = yaml.safe_load((CONFIGS / "plans" / "harbour.yaml").read_text())
    data = merged({**data, "required": None}, {**changes, "required": None})
    file = tmp_path / "plan.yaml"
    file.write_text(yaml.safe_dump(data))
    code, _, err = run_cli(capsys, "plan", file, "--out", tmp_path / "out", "--no-figures")
    assert code == 0, err
    found = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert found["proposal"] is None
    for component in found["predicted"].values():
        assert component["std"] is not None


def test_a_plan_is_simulated_like_any_scenario():
    trial = simulate(CONFIGS / "plans" / "harbour.yaml", seed=3)
    assert trial.dvl is not None
    assert set(load_scenario(CONFIGS / "plans" / "harbour.yaml").required) == {
        "misalignment_deg", "scale_error", "lever_arm_m",
    }  # fmt: skip
