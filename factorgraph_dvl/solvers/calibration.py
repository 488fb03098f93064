"""The calibration at a minimum, with its joint covariance, in the order and units of reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.reported import estimates_of, in_order, in_unit


def reported(
    problem: Problem, evaluation: Evaluation
) -> list[tuple[Parameter, Array, dict[int, Array] | None]]:
    """Return all calibration parameters in the order in which they are reported.

    Each with its value in reported units and the derivatives of that with respect to the
    variables of the graph, by key; None for one that is fixed. What walks or varies is reported
    as its mean over the trial.
    """
    rows: list[tuple[Parameter, Array, dict[int, Array] | None]] = [
        *problem.chain.mean_constants(evaluation.states)
    ]
    for p in problem.all_parameters:
        row = in_unit(p, evaluation.parameters[p.name])
        own = {problem.key(p.name): row.derivative} if p.estimated else None
        value = row.value
        for process in problem.processes:
            if own is not None and process.parameter == p.name:
                change, by_node = process.mean(evaluation.parameters[process.name])
                value = value + change / p.si
                own |= {key: d / p.si for key, d in by_node.items()}
            if own is not None and process.walk is not None and process.walk.parameter == p.name:
                mean, by_node = process.mean_walk(evaluation.parameters[process.name])
                value = value + mean
                own |= {key: np.repeat(d, p.mean.size, axis=0) for key, d in by_node.items()}
        rows.append((p, value, own))
    return in_order(rows, lambda r: r[0])


def calibration(found: SolvedProblem) -> tuple[tuple[Estimate, ...], Array]:
    """Return the calibration with its joint covariance, in reported units."""
    problem, covariances = found.problem, found.covariances
    rows = reported(problem, found.minimum.evaluation)
    free = [(p, derivatives) for p, _, derivatives in rows if derivatives is not None]
    functionals = [derivatives for _, derivatives in free]
    joint = covariances.information.covariance_of(functionals)
    spread = _spread(found, free, joint)
    joint = joint + spread @ spread.T
    for error in covariances.errors:
        change = changes_of(functionals, error.changes)
        joint = joint + change @ change.T
    return estimates_of([(p, value) for p, value, _ in rows], joint)


def spread_of_fixed(found: SolvedProblem) -> Array:
    """Return a root (n, h) of what fixed directions add to the covariance of what is estimated.

    In the order of `reported`, and in its units.
    """
    rows = reported(found.problem, found.minimum.evaluation)
    free = [(p, derivatives) for p, _, derivatives in rows if derivatives is not None]
    functionals = [derivatives for _, derivatives in free]
    return _spread(found, free, found.covariances.information.covariance_of(functionals))


def _spread(
    found: SolvedProblem, free: Sequence[tuple[Parameter, dict[int, Array]]], joint: Array
) -> Array:
    problem, covariances = found.problem, found.covariances
    functionals = [derivatives for _, derivatives in free]
    spread = prior_along(problem, found.fixed, functionals, covariances.considered)
    if covariances.considered:
        # Linear over a hundred degrees, a bias would change by more than its prior allows.
        prior = np.concatenate([p.sigma / p.si for p, _ in free])
        room = np.sqrt(np.maximum(prior**2 - np.diag(joint), 0.0))
        size = np.maximum(np.linalg.norm(spread, axis=1), room)
        of_sensors = np.concatenate(
            [np.full(p.mean.size, p.name in problem.columns) for p, _ in free]
        )
        allowed = room / np.maximum(size, np.finfo(float).tiny)
        spread *= np.where(of_sensors, 1.0, allowed)[:, None]
    return spread


def prior_along(
    problem: Problem,
    fixed: Array,
    functionals: Sequence[dict[int, Array]],
    considered: Mapping[int, Array],
) -> Array:
    """Return a root (n, h) of the prior covariance of functionals along fixed directions.

    Parameters
    ----------
    problem : Problem
        Its parameters have the priors.
    fixed : ndarray, shape (P, h)
        Directions of the parameters, in units of the priors' standard deviations.
    functionals : sequence of dict of int to ndarray
        Derivatives of the functionals with respect to variables, by key.
    considered : mapping of int to ndarray
        Change of other variables with the directions, as of `Posterior`.
    """
    spread = problem.prior_root @ fixed
    by_key = {problem.key(name): spread[place] for name, place in problem.columns.items()}
    by_key |= considered
    if not by_key:
        return np.zeros((sum(next(iter(f.values())).shape[0] for f in functionals), 0))
    return changes_of(functionals, by_key)


def changes_of(functionals: Sequence[dict[int, Array]], changes: Mapping[int, Array]) -> Array:
    """Return how functionals change with components, (n, h), from how variables do.

    Parameters
    ----------
    functionals : sequence of dict of int to ndarray
        Derivatives of the functionals with respect to variables, by key.
    changes : mapping of int to ndarray
        Change of variables, (size, h) by key; what has none does not change.
    """
    width = next(iter(changes.values())).shape[1]
    parts = []
    for functional in functionals:
        part = np.zeros((next(iter(functional.values())).shape[0], width))
        for key, matrix in functional.items():
            if key in changes:
                part += matrix @ changes[key]
        parts.append(part)
    return np.concatenate(parts)
