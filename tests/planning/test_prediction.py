"""Plans: predictions against solved trials, what is required, and what is proposed."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from plans import STRAIGHT, WALKING, std_of
from truth import config, merged, scenario, with_ins

from factorgraph_dvl.analysis.information.observability import observability
from factorgraph_dvl.planning import predict, propose, requirements
from factorgraph_dvl.planning.prediction import extend
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.simulation.compass import InsTruth
from factorgraph_dvl.solvers.batch import solve

# Errors that persist, as the trial states them.
CORRELATED = {
    "trial": {
        "gnss": {"correlated_std_m": [0.3] * 3, "correlation_time_s": 20, "noise": "stated"},
        "dvl": {"correlated_std_m_s": 0.01, "correlation_time_s": 8, "noise": "stated"},
    }
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [{}, WALKING, CORRELATED], ids=["constant", "walking", "correlated"]
)
def test_a_prediction_is_what_the_solver_claims(changes):
    # Of a window that is not known, a trial says more or less than is expected.
    known = {"gnss": {"velocity_averaging_std_s": 0}, "dvl": {"averaging_std_s": 0}}
    scene = scenario(**merged({"trial": known}, changes))
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


def test_correlated_noise_costs_what_it_costs_the_solver():
    white, correlated = (std_of(predict(scenario(**c)).solution) for c in ({}, CORRELATED))
    assert correlated["misalignment_z_deg"] > 1.5 * white["misalignment_z_deg"]


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


# What wanders over two parts of a plan wanders in each anew: 20 s of 120 s of it.
@pytest.mark.parametrize(
    ("changes", "equal"),
    [({}, 0.01), (WALKING, 0.01), pytest.param(CORRELATED, 0.1, marks=pytest.mark.slow)],
)
def test_going_on_is_as_good_as_starting_again(changes, equal):
    scene = scenario(current_m_s=[0.2, 0.1, 0], **changes)
    more = [{"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 20}]
    first = predict(scene)
    history, ending = extend(first.scenario, more, first.ending)
    second, ending = extend(first.scenario, [{"straight_s": 20}], ending)
    whole = predict(
        msgspec.structs.replace(scene, manoeuvres=[*scene.manoeuvres, *more, {"straight_s": 20}])
    )
    np.testing.assert_allclose(second.std[-1], whole.history.std[-1], rtol=equal)
    assert np.all(second.std[-1] <= history.std[-1] * (1.0 + 1e-9))
    assert ending.time == pytest.approx(whole.duration)
    assert ending.start.heading_deg == pytest.approx(whole.ending.start.heading_deg)
    assert ending.start.lat_deg == pytest.approx(whole.ending.start.lat_deg, abs=1e-7)


LINES = [
    {"straight_s": 270},
    {"turn_deg_s": 2, "duration_s": 90, "ramp_s": 5},
    {"straight_s": 270},
    {"turn_deg_s": -2, "duration_s": 90, "ramp_s": 5},
]
NO_SWAY = {"sway": {"roll": [], "pitch": [], "yaw": []}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "with_an_ins",
    [
        pytest.param(False, id="attitude"),
        pytest.param(True, marks=pytest.mark.study, id="ins"),
    ],
)
def test_a_prediction_without_imu_is_what_the_solver_claims(with_an_ins):
    scene = config("ship", manoeuvres=LINES)
    if with_an_ins:
        accurate = {"attitude_std_deg": (0.02, 0.02, 0.05), "white_velocity_std_m_s": 0.005}
        scene = with_ins(scene, InsTruth(rate_hz=1, **accurate))
    predicted = predict(scene).solution
    solved = solve(simulate(scene, 1), rate_hz=1.0)
    assert predicted.order == solved.order
    found, claimed = std_of(predicted), std_of(solved)
    for name in predicted.order:
        # Strengths of motion and noise are those of the plan; of a trial they are estimated.
        assert found[name] == pytest.approx(claimed[name], rel=0.3), name
    np.testing.assert_allclose(predicted.estimate("lever_arm_m").value, [5.0, -1.5, 6.0])


def test_without_imu_turns_have_most_of_the_information_on_a_lever_arm():
    turning = [{"straight_s": 60}, {"turn_deg_s": 3, "duration_s": 60}]
    prediction = predict(config("ship", manoeuvres=turning, **NO_SWAY))
    history = prediction.history
    np.testing.assert_allclose(
        history.std[0],
        np.concatenate([e.prior_std for e in prediction.solution.estimates if e.prior_std.any()]),
    )
    assert np.all(history.std[1:] < history.std[:-1] * (1.0 + 1e-6))
    known = std_of(prediction.solution)
    for name, std in zip(history.names, history.std[-1], strict=True):
        assert std == pytest.approx(known[name], rel=1e-6), name
    view = observability(prediction.solution, trial=prediction.trial, history=history)
    assert not any("along" in text for text in view.missing)
    turning = [m.segment.label == "turning" for m in view.segments]
    share = view.shares.segments[turning, view.shares.names.index("lever_arm_x_m")].sum()
    assert share > 0.6


@pytest.mark.slow
def test_a_straight_plan_without_imu_asks_for_turns():
    straight = predict(config("ship", manoeuvres=[{"straight_s": 60}], **NO_SWAY))
    wanted = {"lever_arm_m": (1.0, 1.0, 20.0)}
    required = requirements(wanted, straight.solution.estimates, "plan")
    assert not all(r.met for r in required)
    proposal = propose(straight, required)
    assert proposal is not None
    assert proposal.met
    assert any("turn" in name for name in proposal.names)
