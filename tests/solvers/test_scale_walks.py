"""A scale that walks although the trial does not state it, beside noise that persists."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from monte_carlo import RUNS, nees_of
from scipy.stats import chi2
from truth import CONFIGS

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve, solve_with_problem
from factorgraph_dvl.solvers.change_along_trial import changes_at
from factorgraph_dvl.solvers.process_fit import refitted


def trial_of(seed, **dvl):
    """Return a navigation-grade trial; what its DVL does is not stated."""
    plan = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    plan["dvl"] |= dvl
    plan["trial"]["dvl"] |= {"scale_walk_std_sqrt_h": 0.0}
    return simulate(parse_scenario(plan), seed)


def test_a_walk_that_is_not_stated_is_found():
    found, solved = solve_with_problem(trial_of(2, scale_walk_sqrt_h=0.02), rate_hz=1.0)
    (reason,) = [r for r in found.verdict.reasons if r.parameter == "scale_error"]
    assert reason.code == Code.ESTIMATED_INSTEAD
    assert found.verdict.reasons[0] is reason
    assert found.verdict.grade == "doubtful"
    (process,) = [p for p in solved.problem.processes if p.walk is not None]
    assert 0.5 < process.walk.rate * 60.0 / 0.02 < 2.0
    # What walks changes anyway.
    assert "scale_error" not in {t.name for t in changes_at(solved.problem, solved.minimum)}
    # Its rate is that of the largest likelihood: another estimate stays there.
    (again,) = [
        p for p in refitted(solved.problem, solved.minimum.evaluation) if p.walk is not None
    ]
    assert again.walk.rate == pytest.approx(process.walk.rate, rel=0.1)


def test_noise_that_persists_is_no_walk():
    _, solved = solve_with_problem(
        trial_of(1, correlated_share=0.7, correlation_time_s=20), rate_hz=1.0
    )
    processes = solved.problem.processes
    assert [p.label for p in processes] == ["DVL velocity"]
    assert processes[0].walk is None


@pytest.mark.slow
def test_standard_deviations_hold_beside_a_walk():
    squares = []
    for seed in range(RUNS):
        trial = trial_of(seed, scale_walk_sqrt_h=0.02)
        squares.append(nees_of(solve(trial, rate_hz=1.0), trial))
    low, high = chi2.ppf([0.005, 0.995], 7 * RUNS)
    assert low < sum(squares) < high, np.round(np.array(squares) / 7, 2)
