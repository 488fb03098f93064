"""Scores of what changes one record only: as those of an elimination, chi-squared, and quick."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import yaml
from freed_scores import scores
from monte_carlo import RUNS
from scipy.stats import chi2
from truth import CONFIGS

from factorgraph_dvl.sensors.dvl import CURRENT
from factorgraph_dvl.sensors.dvl_distortion import NAMES
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.known_parameters import wide, with_parameters
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise
from factorgraph_dvl.solvers.record_scores import record_scores
from factorgraph_dvl.statistics.scores import Scores

DISTORTIONS = (CURRENT, *NAMES)
# CPU of all of them on the cruise of 80 minutes, s.
ALLOWED_S = 0.5


def plan(name="seed-a-phase-90"):
    return yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))


def of_no_prior(p):
    return np.full(p.mean.size, np.inf)


def of_wide_prior(p):
    return wide(p, p.mean).sigma


def scored(trial, sigma_of):
    """Return the problem of a trial, its minimum, and scores there."""
    solved, *_ = solved_problems(trial)
    problem = solved.problem
    # Weights are those of the minimum.
    problem.weigh(solved.minimum.evaluation)
    values = solved.minimum.evaluation.values
    evaluation = minimise(problem, values, stage="test", weighed=True).evaluation
    information = factorized(problem, evaluation)[0]
    (i,) = (k for k, o in enumerate(problem.observations) if o.label == "DVL velocity")
    bound = replace(problem.bound[i], attachment=evaluation.attached[i])
    start = time.process_time()
    motion = evaluation.motions[i]
    own = [p for p in problem.all_parameters if p.name in DISTORTIONS and not p.estimated]
    candidates = {p.name: sigma_of(p) for p in own}
    found = record_scores(problem, bound, evaluation, information, candidates, motion)
    return problem, evaluation, found, time.process_time() - start


def test_they_are_those_of_an_elimination_with_these_parameters_free():
    problem, evaluation, found, _ = scored(simulate(parse_scenario(plan()), 1), of_wide_prior)
    known = [p for p in problem.all_parameters if p.name in DISTORTIONS and not p.estimated]
    names = {p.name for p in known}
    free = [wide(p, p.mean) if p.name in names else p for p in problem.all_parameters]
    freed, at = with_parameters(problem, evaluation, free)
    information, delta = factorized(freed, at)
    columns = {p.name: (freed.key(p.name), p.sigma) for p in free if p.name in names}
    expected = scores(delta, information, columns)
    for p in known:
        one, other = found.test([p.name]), expected.test([p.name])
        assert one.chi2 == pytest.approx(other.chi2, rel=1e-3)
        np.testing.assert_allclose(one.std, other.std, rtol=1e-3)


@pytest.mark.slow
def test_honest_trials_make_them_chi_squared_at_hardly_any_cost():
    sums, freedom = dict.fromkeys(DISTORTIONS, 0.0), 0
    runs = max(RUNS // 10, 5)
    for seed in range(runs):
        *_, found, _ = scored(simulate(parse_scenario(plan()), 1000 + seed), of_no_prior)
        for name in sums:
            sums[name] += found.test([name]).chi2
    for name, total in sums.items():
        freedom = runs * found.test([name]).freedom
        assert chi2.ppf(1e-4, freedom) < total < chi2.ppf(1.0 - 1e-4, freedom), name
    cruise = simulate(parse_scenario(plan("cruise")), 1)
    *_, seconds = scored(cruise, of_no_prior)
    assert seconds < ALLOWED_S


def test_what_the_data_say_nothing_of_stays_where_it_is():
    # Two components that differ by nothing, one of which there is no information on, and a third.
    information = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    found = Scores(
        {"three": slice(0, 3)}, np.array([2.0, 2.0, 0.0]), information, np.full(3, np.inf)
    )
    test = found.test(["three"])
    np.testing.assert_allclose(test.step, [0.25, 0.25, 0.0])
    assert test.chi2 == pytest.approx(1.0)
    assert np.isinf(test.std[2])
    nothing = Scores({"one": slice(0, 1)}, np.zeros(1), np.zeros((1, 1)), np.array([np.inf])).test(
        ["one"]
    )
    assert nothing.chi2 == 0.0
    assert nothing.log10_p == 0.0
