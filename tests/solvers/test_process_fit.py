"""Deviation and time of correlated noise: where the restricted likelihood is largest."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.simulation.faults import gauss_markov
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.process_fit import refitted

LEGS = [
    {"straight_s": 30},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"accelerate_m_s2": -0.2, "to_m_s": 2},
    {"straight_s": 30},
]


@pytest.fixture(scope="module")
def solved():
    """Return the problem of a trial with 0.03 m/s over 5 s in what the DVL measures."""
    scene = scenario(
        noise=True,
        manoeuvres=LEGS,
        imu={"rate_hz": 50},
        dvl={"rate_hz": 2, "velocity_std_m_s": 0.01},
        trial={"dvl": {"velocity_std_m_s": 0.01}},
    )
    trial = simulate(scene, 1)
    error = 0.03 * gauss_markov(trial.dvl.time, 5.0, 3, np.random.default_rng(2))
    dvl = replace(trial.dvl, velocity=trial.dvl.velocity + error)
    (found,) = solved_problems(replace(trial, dvl=dvl))
    assert len(found.problem.processes) == 1
    return found.problem, found.minimum.evaluation


def log_likelihood(problem, evaluation, process):
    """Return the restricted log-likelihood, up to a constant, of the linearised problem."""
    (before,) = problem.processes
    problem.processes = (process,)
    nodes = evaluation.parameters[process.name] * (before.sigma / process.sigma)
    at = problem.evaluate(
        problem.values(evaluation.states, evaluation.parameters | {process.name: nodes})
    )
    gaussian = problem.linearize(at)
    tree = gaussian.eliminateMultifrontal(problem.ordering(), gtsam.EliminateQR)
    problem.processes = (before,)
    half_determinant, stack = 0.0, list(tree.roots())
    while stack:
        clique = stack.pop()
        R = clique.conditional().R()
        half_determinant += np.log(np.abs(np.diag(R[:, : R.shape[0]]))).sum()
        stack += [clique[i] for i in range(clique.nrChildren())]
    steps = np.diff(process.time)[:, None] / process.tau
    of_prior = -0.5 * np.log(-np.expm1(-2.0 * steps)).sum()
    return of_prior - half_determinant - gaussian.error(tree.optimize())


def test_no_other_deviation_or_time_is_more_likely(solved):
    problem, evaluation = solved
    (process,) = problem.processes
    # From far off, to the same place.
    away = replace(process, sigma=process.sigma * 0.6, tau=process.tau * 2.0)
    problem.processes = (away,)
    moved = evaluation.parameters[process.name] / 0.6
    (found,) = refitted(
        problem, replace(evaluation, parameters=evaluation.parameters | {process.name: moved})
    )
    problem.processes = (process,)
    best = log_likelihood(problem, evaluation, found)
    assert best > log_likelihood(problem, evaluation, away) + 1.0
    for name in ("sigma", "tau"):
        for factor in (0.75, 1.33):
            other = replace(found, **{name: getattr(found, name) * np.array([factor, 1.0, 1.0])})
            assert log_likelihood(problem, evaluation, other) < best


def test_noise_that_is_not_estimated_stays(solved):
    problem, evaluation = solved
    (process,) = problem.processes
    factors = problem.noise_factors
    problem.noise_factors = {}
    assert refitted(problem, evaluation)[0] is process
    problem.noise_factors = factors


@pytest.mark.parametrize("factor", [3.0, 0.3])
def test_a_deviation_is_never_below_the_least_and_keeps_its_density(solved, factor):
    problem, evaluation = solved
    (process,) = problem.processes
    (free,) = refitted(problem, evaluation)
    least = process.sigma * factor
    start = replace(process, sigma=least, tau=process.tau * factor**2, least_sigma=least)
    problem.processes = (start,)
    nodes = evaluation.parameters[process.name] / factor
    (found,) = refitted(
        problem, replace(evaluation, parameters=evaluation.parameters | {process.name: nodes})
    )
    problem.processes = (process,)
    active = process.sigma > 0.0
    assert np.all(found.sigma[active] >= factor * process.sigma[active] * (1.0 - 1e-12))
    if factor < 1.0:
        # Where the data show more, it is as if nothing was stated.
        assert found.sigma[active] == pytest.approx(free.sigma[active], rel=0.1)
    density = [(p.sigma**2 / p.tau)[active] for p in (found, free)]
    assert density[0] == pytest.approx(density[1], rel=0.5)
