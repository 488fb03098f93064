"""A minimum with its covariances, and with what the data do not determine fixed at the prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.solution import SolverStep
from factorgraph_dvl.solvers.considered_errors import considered_errors
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, factorized
from factorgraph_dvl.solvers.posterior import (
    Posterior,
    changes_with,
    considered,
    posterior,
    with_errors,
)
from factorgraph_dvl.statistics.undetermined_directions import (
    at_prior_along,
    data_information,
    parameter_information,
)

# Cosine of the largest angle between spans of directions that are the same. Chosen: 26 degrees.
_SAME_DIRECTIONS = 0.9


@dataclass(frozen=True)
class SolvedProblem:
    """A problem at its minimum, with its covariances.

    Parameters
    ----------
    problem : Problem
        What was minimised.
    minimum : Minimum
        Where it ended.
    covariances : Posterior
        Covariances there.
    fixed : ndarray, shape (P, h)
        Directions of the parameters that the data do not determine, in units of the priors'
        standard deviations.
    findings : tuple of Finding, optional
        What the user must know.
    spurious : ndarray, shape (K, P, P), optional
        Spurious information by node there, if it is known already.
    steps : tuple of SolverStep, optional
        What the solver changed of its assumptions.
    """

    problem: Problem
    minimum: Minimum
    covariances: Posterior
    fixed: Array
    findings: tuple[Finding, ...] = ()
    spurious: Array | None = None
    steps: tuple[SolverStep, ...] = ()

    def __repr__(self) -> str:
        states, parameters = self.problem.chain.node_time.size, len(self.problem.parameters)
        ended = "converged" if self.minimum.converged else "not converged"
        return f"<SolvedProblem of {states} states and {parameters} parameters: {ended}>"


def with_covariances(
    problem: Problem,
    minimum: Minimum,
    minimise_again: Callable[[gtsam.Values], Minimum],
    *,
    findings: tuple[Finding, ...] = (),
    at_truth: bool = False,
) -> SolvedProblem:
    """Return a minimum with its covariances, undetermined directions fixed at the prior.

    Parameters
    ----------
    problem : Problem
        What was minimised; directions are fixed in it.
    minimum : Minimum
        Where it ended.
    minimise_again : callable
        Returns the minimum from values on, once directions are fixed.
    findings : tuple of Finding, optional
        What the user must know.
    at_truth : bool, default False
        Whether the minimum is the truth: the parameters then stay there.
    """
    evaluation = minimum.evaluation
    covariances = posterior(problem, minimum)
    information = data_information(
        problem,
        evaluation,
        covariances.parameters,
        covariances.given,
        covariances.information,
        at_truth=at_truth,
    )
    fixed = information.undetermined_directions()
    spurious: Array | None = information.by_node
    if fixed.size:
        # How other variables change with the directions is linear here, where these belong.
        full = parameter_information(problem, evaluation)
        changes = changes_with(covariances, fixed, information.coupled(fixed, full))
        origin = evaluation.parameters
        if not at_truth:
            origin = at_prior_along(problem, origin, fixed)
        problem.fix_directions(fixed, origin)
        minimum = minimise_again(problem.values(evaluation.states, origin))
        covariances = considered(problem.chain, posterior(problem, minimum), changes)
        spurious = None
    errors = considered_errors(problem, minimum)
    covariances = with_errors(problem.chain, covariances, errors)
    return SolvedProblem(problem, minimum, covariances, fixed, findings, spurious)


def undetermined_there(solved: SolvedProblem, free: Problem) -> bool:
    """Whether the directions that are fixed, and no others, are undetermined at a minimum.

    Where descent did not end they were found short of one: along what only noise shows, it
    may go on for ever.

    Parameters
    ----------
    solved : SolvedProblem
        Solved problem with fixed directions.
    free : Problem
        The same problem without.
    """
    evaluation = solved.minimum.evaluation
    square_root, _ = factorized(free, evaluation)
    covariances = posterior(free, replace(solved.minimum, square_root=square_root))
    information = data_information(
        free, evaluation, covariances.parameters, covariances.given, covariances.information
    )
    directions = information.undetermined_directions()
    if directions.shape != solved.fixed.shape:
        return False
    cosines = np.linalg.svd(directions.T @ solved.fixed, compute_uv=False)
    return bool(cosines.min() > _SAME_DIRECTIONS)
