r"""Likelihood of the constants with the states integrated out.

A trial has states x, of which there are more the longer it lasts, and constants c: what is to
be calibrated. With whitened residuals r(x, c), their Jacobian J with respect to x and the noise
Sigma that whitens them, Laplace's approximation of the integral over x is

.. math::

   -2 \log L(c) = \min_x |r(x, c)|^2 + \log\det\Lambda_{xx}(c) + \log\det\Sigma
                  + \text{const}, \qquad \Lambda_{xx} = J^T J,

which is exact where r is linear in x. The minimum of the first term alone, over states and
constants together, is biased where J depends on c: a smaller scale of a log makes velocities
that are not known well less certain, and their volume larger. With many states, each known from
few measurements, the second term is as steep as the first.

**Value.** With the constants eliminated last, the conditionals of the states, R x + T c = d,
contain everything. Where residuals are linear in x about the evaluation,

.. math::

   \min_x |r|^2 = |r|^2 - |d|^2, \qquad \log\det\Lambda_{xx} = 2 \sum \log |R_{ii}|.

The restricted likelihood, by which noise is estimated, integrates the constants too, about the
most probable ones: it has log det R of all conditionals, the constants' Schur complement included.
(|d|² of all would be that of the joint minimum, where log det R has another value.)

**Gradient.** With P the covariance of the states given the constants,

.. math::

   \frac{\partial}{\partial c_i} \log\det\Lambda_{xx}
     = 2 \sum_m \left\langle \frac{\partial J_m}{\partial c_i}, J_m P \right\rangle.

A row J_m depends on few variables, which share a clique: one pass through the tree gives their
covariance, exactly. ∂J_m/∂c_i is a difference of rows at two values of c_i, of the observations
that depend on it. Native factors do not depend on constants but linearly.

Half the gradient is what the term adds to the gradient of the cost, and -P_cc times that is how
far it moves the constants, P_cc their covariance.

References
----------
Kristensen, Nielsen, Berg, Skaug and Bell, TMB: Automatic differentiation and Laplace
approximation, Journal of Statistical Software 70(5), 2016.
Lindstrom and Bates, Nonlinear mixed effects models for repeated measures data, Biometrics 46(3),
1990.
Harville, Maximum likelihood approaches to variance component estimation and to related problems,
Journal of the American Statistical Association 72(358), 1977.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.statistics.rows import product, with_own_covariance
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation
from factorgraph_dvl.statistics.variance_components import log_prior

# Step of a difference, in standard deviations of the parameter, and at most, SI. Chosen: what
# the rows are not linear in is then below 1e-5 of the change, and rounding below 1e-6 in the
# gradient times the standard deviation.
_STEP = 1e-3
_LONGEST_STEP = 1e-6

# Rows of observations and their covariance with their own states, by source and number of the
# first item.
WithStates = dict[tuple[str, int], tuple[Rows, Array]]


def marginal_objective(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> float:
    """Return -2 log of the likelihood of the constants, with the states integrated out.

    At the constants of the evaluation and the best states near it. It has the squares of all
    residuals, those of priors included, log det of the states' information given the constants,
    and log det of the covariances of measurements, of their correlated errors, of walks, of a
    motion's prior and of the priors of constants. Left out are n log 2 pi, and log det of what
    no model changes, as the noise of the IMU. A rejected measurement has the cost of a gross
    error in place of its log sigma.

    Parameters
    ----------
    problem : Problem
        Weighed at the evaluation.
    evaluation : Evaluation
        Where the graph is linear.
    information : SquareRootInformation
        Square-root information from the elimination there, the constants last.
    """
    given = information.given(constants_of(problem))
    return _objective(problem, evaluation, given.decrease, given.log_determinant)


def restricted_objective(
    problem: Problem, evaluation: Evaluation, information: SquareRootInformation
) -> float:
    """Return -2 log of the likelihood of the noise, with states and constants integrated out.

    By Laplace's approximation at the constants of the evaluation, which are to be the most
    probable ones: `marginal_objective`, and log det of the constants' Schur complement. Arguments,
    and what is left out, are the same.
    """
    decrease = information.given(constants_of(problem)).decrease
    return _objective(problem, evaluation, decrease, information.log_determinant)


def _objective(
    problem: Problem, evaluation: Evaluation, decrease: float, log_determinant: float
) -> float:
    """Return the terms of an objective.

    Parameters
    ----------
    problem : Problem
        Problem with weights.
    evaluation : Evaluation
        Where the graph is linear.
    decrease : float
        What the best states take off the cost.
    log_determinant : float
        Log det of the information of what is integrated out.
    """
    log_sigma = sum(float(each.sum()) for each in problem.log_sigma(evaluation))
    correlated = sum(process.log_determinant for process in problem.processes)
    _, prior = np.linalg.slogdet(problem.prior_root)
    least = evaluation.cost - decrease
    return float(
        2.0 * (least + log_sigma + prior)
        + log_determinant
        + correlated
        + problem.chain.log_determinant
        + log_prior(problem.noise_factors, problem.observations)
        + _persisting(problem, evaluation)
    )


def _persisting(problem: Problem, evaluation: Evaluation) -> float:
    """Return what noise that persists for some measurements adds to -2 log of the likelihood.

    In place of wide white noise, which their weights have, it is that of white noise less the
    gain of their correlation.
    """
    out = -problem.gain
    for o, weight, residual in zip(
        problem.observations, problem.weights, evaluation.residuals, strict=True
    ):
        factor = problem.long_run.get(o.label)
        if factor is not None:
            used = (weight > 0.0).sum(axis=0)
            squares = np.sum(residual**2, axis=0)
            out += float(np.sum(squares * (factor**2 - 1.0) - 2.0 * used * np.log(factor)))
    return out


def log_determinant_gradient(
    problem: Problem,
    evaluation: Evaluation,
    information: SquareRootInformation,
    with_states: WithStates | None = None,
) -> Array:
    """Return the gradient (P,) of log det of the states' information by the constants.

    At fixed states and weights, in the tangent space of the estimated parameters, SI, in the
    order of `Problem.columns`. Zero by clocks: it would be that of the places of measurements
    between nodes, which mean nothing.

    Parameters
    ----------
    problem : Problem
        Problem with weights.
    evaluation : Evaluation
        Where the graph is linear.
    information : SquareRootInformation
        Square-root information from the elimination there, the constants last.
    with_states : dict, optional
        `by_place` of all rows of observations, where that is known.
    """
    constants = constants_of(problem)
    out = np.zeros(len(problem.prior_root))
    if not constants:
        return out
    sigma = np.sqrt(np.diag(information.covariance_of([every_constant(problem)])))
    if with_states is None:
        with_states = with_states_at(problem, evaluation, information.given(constants))
    wanted = {name: sigma[own] for name, own in problem.columns.items()}
    for name, slope in gradient_by_name(problem, evaluation, with_states, wanted).items():
        out[problem.columns[name]] = slope
    return out


def gradient_by_name(
    problem: Problem,
    evaluation: Evaluation,
    with_states: WithStates,
    wanted: Mapping[str, Array],
) -> dict[str, Array]:
    """Return the gradient of log det of the states' information by some constants, by name.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Those of `log_determinant_gradient`.
    with_states : dict
        `by_place` of all rows of observations.
    wanted : mapping of str to ndarray
        Standard deviations of the constants, SI, by name: how far differences go.
    """
    constants = constants_of(problem)

    def total(p: Parameter, value: Array) -> float:
        every = problem.observation_rows_at(evaluation, {p.name: value})
        found = ((rows, with_states[rows.source, rows.begin][1]) for rows in every)
        return sum(float(np.vdot(_by_states(rows, constants), own)) for rows, own in found)

    # By source: of the same rows, where the motion is that of the evaluation.
    known: dict[str, float] = {}
    for here, with_own in with_states.values():
        total_here = float(np.vdot(_by_states(here, constants), with_own))
        known[here.source] = known.get(here.source, 0.0) + total_here

    def before(p: Parameter, value: Array) -> float:
        if not problem.chain.interpolates:
            return total(p, value)
        return sum(known[b.observation.label] for b in problem.bound if p.name in b.names)

    out = {}
    for p in problem.parameters:
        if p.name not in wanted or problem.key(p.name) in problem.clock_keys:
            continue
        value = evaluation.parameters[p.name]
        steps = np.minimum(_STEP * wanted[p.name], _LONGEST_STEP)
        at_value = before(p, value)
        after = [
            total(p, value @ exp_so3(step) if p.rotation else value + step)
            for step in np.diag(steps)
        ]
        out[p.name] = 2.0 * (np.array(after) - at_value) / steps
    return out


def constants_of(problem: Problem) -> set[int]:
    """Return the keys of the constants."""
    return {problem.key(p.name) for p in problem.parameters}


def every_constant(problem: Problem) -> dict[int, Array]:
    """Return the functional (P, size) by key that is all estimated parameters side by side."""
    one = np.eye(len(problem.prior_root))
    return {problem.key(name): one[:, own] for name, own in problem.columns.items()}


def _states_of(rows: Rows, constants: set[int]) -> int:
    """Return how many of the k variables of each item are states, which come before constants."""
    return sum(key not in constants for key in rows.keys[:1].ravel().tolist())


def _by_states(rows: Rows, constants: set[int]) -> Array:
    """Return the columns of the states, (M, d, n)."""
    return rows.matrix[:, :, : sum(rows.sizes[: _states_of(rows, constants)])]


def covariance_with_states(
    every: Sequence[Rows], given: SquareRootInformation, constants: set[int]
) -> list[Array]:
    """Return the covariances J P of rows with their own states given the constants, (M, d, n)."""
    parts = [
        (rows.keys[:, : _states_of(rows, constants)], _by_states(rows, constants))
        for rows in every
    ]
    return with_own_covariance(parts, given)


def by_place(every: Sequence[Rows], with_states: Sequence[Array]) -> WithStates:
    """Return rows with their `covariance_with_states` by source and number of the first item."""
    return {(r.source, r.begin): (r, each) for r, each in zip(every, with_states, strict=True)}


def with_states_at(
    problem: Problem, evaluation: Evaluation, given: SquareRootInformation
) -> WithStates:
    """Return `by_place` of all rows of observations, from the information given the constants."""
    every, constants = list(problem.observation_rows(evaluation)), constants_of(problem)
    return by_place(every, covariance_with_states(every, given, constants))


def leverage_of(
    rows: Rows,
    with_states: Array,
    with_constants: Mapping[int, Array],
    root: Array,
    constants: set[int],
) -> Array:
    """Return the leverages (M, d) of rows, exact: by their states, and by the constants.

    Parameters
    ----------
    rows : Rows
        Rows of the graph.
    with_states : ndarray, shape (M, d, n)
        Their `covariance_with_states`.
    with_constants : mapping of int to ndarray
        Covariance (size, C) of every variable with the constants.
    root : ndarray, shape (C, C)
        Square root S of the information S Sᵀ on the constants.
    constants : set of int
        Their keys.
    """
    of_states = np.sum(with_states * _by_states(rows, constants), axis=2)
    return np.asarray(of_states + np.sum((product(rows, with_constants) @ root) ** 2, axis=2))
