"""Scores of parameters that are taken as known, against an elimination in which they are free."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from freed_scores import scores
from truth import TURNS_AND_BRAKING, config, merged, scenario

from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import known_parameters
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.known_parameters import freed, wide, with_parameters
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise
from factorgraph_dvl.statistics.marginal_likelihood import constants_of
from factorgraph_dvl.statistics.rows import product, rows_by_source
from factorgraph_dvl.statistics.scores import Scores

SCENE = {
    "noise": True,
    "manoeuvres": TURNS_AND_BRAKING,
    "imu": {"rate_hz": 50, "gyro_noise_deg_sqrt_h": 0.005},
    "gnss": {
        "position_std_m": [0.1, 0.1, 0.2],
        "velocity_std_m_s": [0.03] * 3,
    },
    "dvl": {"velocity_std_fraction": 0.001},
    "trial": {
        "gnss": {"lever_arm_std_m": [0.0] * 3, "time_offset_std_s": 0.0},
        "dvl": {"velocity_std_fraction": 0.001, "time_offset_std_s": 0.0},
    },
}


def known_of(problem):
    return [
        p
        for p in problem.all_parameters
        if not (p.estimated or p.spec.usual or p.spec.searched) and p.spec.plausible is not None
    ]


def at_its_minimum(trial):
    """Return a problem whose weights are those of its minimum, and what is known of that."""
    found, *_ = solved_problems(trial)
    problem = found.problem
    problem.weigh(found.minimum.evaluation)
    values = found.minimum.evaluation.values
    evaluation = minimise(problem, values, stage="test", weighed=True).evaluation
    return problem, evaluation, factorized(problem, evaluation)[0]


@pytest.fixture(scope="module", params=["constant", "walking", "ship"])
def solved(request):
    """Return a problem at its minimum, and one in which what it takes as known is free."""
    if request.param == "ship":
        lines = [{"straight_s": 40}, {"turn_deg_s": 3, "duration_s": 30}, {"straight_s": 20}]
        trial = simulate(config("ship", manoeuvres=lines), 1)
    else:
        trial = simulate(scenario(**merged({}, SCENE)), 4)
        if request.param == "walking":
            walk = {"gyro_bias_walk_deg_h_sqrt_h": 0.1, "accel_bias_walk_ug_sqrt_h": 20.0}
            settings = msgspec.structs.replace(trial.imu.settings, **walk)
            trial = replace(trial, imu=replace(trial.imu, settings=settings))
        # A gap, in which a part ends somewhere.
        silent = (trial.imu.time > 40.0) & (trial.imu.time < 43.0)
        trial = replace(trial, imu=rows_of(trial.imu, ~silent))
    problem, evaluation, information = at_its_minimum(trial)
    known = known_of(problem)
    assert request.param == "ship" or {p.name for p in known} > {*ERRORS}
    names = {p.name for p in known}
    free = [wide(p, p.mean) if p.name in names else p for p in problem.all_parameters]
    test, at = with_parameters(problem, evaluation, free)
    columns = {p.name: (test.key(p.name), p.sigma) for p in free if p.name in names}
    return problem, evaluation, information, known, (test, at, columns)


def slopes_of(test, at, columns):
    """Return half the change of log det of the states' information by each candidate, by name.

    By differences of the determinant itself.
    """
    constants = constants_of(test)
    out = {}
    for name, (key, sigma) in columns.items():
        if key in test.clock_keys:
            continue
        slope = []
        for step in np.diag(np.minimum(1e-3 * sigma, 1e-6)):
            ends = []
            for sign in (1.0, 0.0):
                moved = {**at.parameters, name: at.parameters[name] + sign * step}
                there = test.evaluate(test.values(at.states, moved))
                ends.append(factorized(test, there)[0].given(constants).log_determinant)
            slope.append((ends[0] - ends[1]) / (2.0 * step.max()))
        out[name] = np.array(slope)
    return out


@pytest.mark.parametrize("longest", [7, 1000])
def test_they_are_those_of_an_elimination(solved, monkeypatch, longest):
    problem, evaluation, information, known, (test, at, columns) = solved
    of_test, delta = factorized(test, at)
    expected = scores(delta, of_test, columns)
    if problem.chain.interpolates:
        slopes = slopes_of(test, at, columns)
        assert max(np.abs(slopes[name] * columns[name][1]).max() for name in slopes) > 0.1
        expected = expected.with_slopes(slopes)
    monkeypatch.setattr(known_parameters, "_LONGEST", longest)
    free = freed(problem, evaluation, information, known)
    parts = len(list(free.parts()))
    assert parts == (1 if problem.processes else -(-problem.chain.count // longest))
    for name in columns:
        one, other = free.scores.test([name]), expected.test([name])
        assert one.chi2 == pytest.approx(other.chi2, rel=2e-3, abs=2e-3), name
        np.testing.assert_allclose(one.std, other.std, rtol=1e-3)
        np.testing.assert_allclose(one.step / other.std, other.step / other.std, atol=0.02)


@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_they_have_the_variance_that_residuals_scatter_by(solved, ratio):
    problem, evaluation, information, known, (test, at, columns) = solved
    free = freed(problem, evaluation, information, known)
    ratios = {"DVL velocity": np.full(3, ratio)}
    found, scatter = free.scattered(problem.chain.node_time, ratios, {})
    # What all else does as each component moves, from the elimination: J P_ab P_bb^-1.
    of_test, _ = factorized(test, at)
    scaled = [{key: np.diag(1.0 / sigma)} for key, sigma in columns.values()]
    gain = np.linalg.inv(of_test.covariance_of(scaled))
    following = {key: P @ gain for key, P in of_test.covariance_with(scaled).items()}
    size = len(gain)
    variance, nominal = np.zeros((2, size, size))
    candidates = {key for key, _ in columns.values()}
    for rows in rows_by_source(test, at):
        if candidates.issuperset(rows.keys[0].tolist()):
            continue
        J = product(rows, following).reshape(-1, size)
        nominal += J.T @ J
        variance += (ratio**2 if rows.source == "DVL velocity" else 1.0) * (J.T @ J)
    for name, place in free.scores.places.items():
        known_there, M = nominal[place, place], variance[place, place]
        sigma = columns[name][1]
        step = free.scores.information[place, place]
        np.testing.assert_allclose(
            known_there / np.outer(sigma, sigma), step, rtol=1e-2, atol=1e-3 * step.max()
        )
        expected = known_there @ np.linalg.pinv(M, 1e-9) @ known_there / np.outer(sigma, sigma)
        np.testing.assert_allclose(
            found.information[place, place], expected, rtol=0.02, atol=1e-2 * expected.max()
        )
    assert all(each >= 1.0 for each in scatter.values())


def test_parts_scatter_by_what_one_number_does_not_explain(solved):
    problem, evaluation, information, known, _ = solved
    p = problem.parameters[0]
    others = {p.name: (problem.key(p.name), p.sigma)}
    free = freed(problem, evaluation, information, known)
    _, scatter = free.scattered(problem.chain.node_time, {}, others)
    assert scatter.keys() == {p.name, *(each.name for each in known)}
    # Twenty parts of what is white.
    assert all(1.0 <= each < 3.0 for each in scatter.values())


def test_scores_of_another_variance_have_the_same_step():
    # One number: S = 6 and I = 4, whose variance is 9 in place of 4: 1.5 ± 3/4.
    found = Scores({"a": slice(0, 1)}, np.array([6.0]), np.array([[4.0]]), np.full(1, np.inf))
    test = found.with_variance(np.array([[9.0]])).test(["a"])
    assert test.step[0] == pytest.approx(1.5)
    assert test.std[0] == pytest.approx(0.75)
    assert test.chi2 == pytest.approx(4.0)
