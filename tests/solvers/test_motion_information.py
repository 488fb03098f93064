"""Information without IMU: along a trial, and of a plan."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from truth import CONFIGS, with_ins

from factorgraph_dvl.analysis.information.observability import observability
from factorgraph_dvl.planning import predict, propose
from factorgraph_dvl.planning.requirements import requirements
from factorgraph_dvl.simulation import load_scenario, simulate
from factorgraph_dvl.simulation.compass import InsTruth
from factorgraph_dvl.simulation.scenario import SwaySettings
from factorgraph_dvl.solvers.information_along_trial import solve_with_history


def scenario(repeat=1, manoeuvres=None):
    made = load_scenario(CONFIGS / "ship.yaml")
    legs = made.manoeuvres[0]["manoeuvres"] if manoeuvres is None else manoeuvres
    return msgspec.structs.replace(made, manoeuvres=[{"repeat": repeat, "manoeuvres": legs}])


def std_of(solution):
    return dict(zip(solution.order, np.sqrt(np.diag(solution.covariance)), strict=True))


@pytest.fixture(scope="module")
def ship():
    return simulate(scenario(), 1)


@pytest.fixture(scope="module")
def solved(ship):
    return solve_with_history(ship, rate_hz=1.0, entries=50)


def test_information_grows_to_that_of_the_solution(ship, solved):
    solution, history = solved
    assert history.time.size == 50
    assert ship.gnss.time[0] - 3.0 < history.time[0] < history.time[-1]
    assert np.all(history.std[1:] < history.std[:-1] * (1.0 + 1e-6))
    known = std_of(solution)
    for name, std in zip(history.names, history.std[-1], strict=True):
        assert std == pytest.approx(known[name], rel=1e-4)
    priors = np.concatenate([e.prior_std[e.prior_std > 0.0] for e in solution.estimates])
    np.testing.assert_allclose(history.std[0], priors, rtol=0.05)


def test_halfway_it_is_that_of_half_the_records(ship, solved):
    _, history = solved
    middle = history.time.size // 2
    half, _ = solve_with_history(ship.until(history.time[middle]), rate_hz=1.0)
    known = std_of(half)
    for name, std in zip(history.names, history.std[middle], strict=True):
        # Noise and motion are those of the whole.
        assert std == pytest.approx(known[name], rel=0.3), name


def calm(*manoeuvres):
    made = scenario(manoeuvres=manoeuvres)
    return msgspec.structs.replace(made, sway=SwaySettings())


def test_turns_have_most_of_the_information_on_a_lever_arm():
    prediction = predict(calm({"straight_s": 60}, {"turn_deg_s": 3, "duration_s": 60}))
    history = prediction.history
    view = observability(prediction.solution, trial=prediction.trial, history=history)
    assert not any("along" in text for text in view.missing)
    turning = [m.segment.label == "turning" for m in view.segments]
    share = view.shares.segments[turning, view.shares.names.index("lever_arm_x_m")].sum()
    assert share > 0.6


def check_plan(made, solution):
    predicted = predict(made).solution
    assert predicted.order == solution.order
    found, claimed = std_of(predicted), std_of(solution)
    for name in predicted.order:
        # Strength of motion and noise are those of the plan; of a trial they are estimated.
        assert found[name] == pytest.approx(claimed[name], rel=0.3), name
    np.testing.assert_allclose(predicted.estimate("lever_arm_m").value, [5.0, -1.5, 6.0])


def test_a_plan_is_what_the_solver_claims(solved):
    check_plan(scenario(), solved[0])


@pytest.mark.slow
def test_a_plan_with_an_ins_is_what_the_solver_claims():
    ins = InsTruth(rate_hz=1, attitude_std_deg=(0.02, 0.02, 0.05), white_velocity_std_m_s=0.005)
    made = with_ins(scenario(), ins)
    check_plan(made, solve_with_history(simulate(made, 1), rate_hz=1.0)[0])


@pytest.mark.slow
def test_a_straight_plan_asks_for_turns():
    straight = predict(calm({"straight_s": 60}))
    wanted = {"lever_arm_m": (1.0, 1.0, 20.0)}
    required = requirements(wanted, straight.solution.estimates, "plan")
    assert not all(r.met for r in required)
    proposal = propose(straight, required)
    assert proposal is not None
    assert proposal.met
    assert any("turn" in name for name in proposal.names)
