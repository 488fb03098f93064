"""The information on the calibration as it grows along a trial.

A square-root information filter over the linearised graph. Its frontier is the latest
state with all constants behind it:

    rows = [R over (x_k, c); factors between x_k, x_{k+1} and c]  --QR-->  R' over (x_{k+1}, c).

x_k is eliminated first, so that the triangle that is left over c is the square root of the
information of all data so far on the constants, whatever the states were: their
marginal information. Nothing is squared (Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977, ch. VI). At the end it is what the smoother has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg.lapack import dgeqrf, dtrtri

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.problem import FIXED_DIRECTION_STD, Evaluation, Problem
from factorgraph_dvl.quality.refusal import accepted_errors, explained
from factorgraph_dvl.quality.survey import survey
from factorgraph_dvl.solution import Progress, Solution, most_probable_minimum
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.calibration import prior_along, reported
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.minima import evidence_against
from factorgraph_dvl.solvers.summary import summarise
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.statistics.spurious_information import (
    SPURIOUS,
    largest_spurious_share,
    spurious_information,
    undetermined_directions,
)
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class Frontier:
    """Square-root information at a node over its state and all constants.

    Parameters
    ----------
    root : ndarray, shape (n, n)
        Upper triangle; columns: state, its bias where biases walk, constants.
    """

    root: Array


@dataclass(frozen=True)
class _Layout:
    """Columns of two consecutive nodes and of the constants behind them."""

    own: int
    constants: dict[int, int]
    width: int

    def column(self, key: int, node: dict[int, tuple[int, int]], k: int) -> int:
        if key in self.constants:
            return 2 * self.own + self.constants[key]
        index, offset = node[key]
        return (index - k) * self.own + offset


# Rate of the trajectory, Hz. Chosen: angular rates are taken from its attitudes, under sway of
# some hertz.
RATE_HZ = 20.0


def solve_with_history(
    trial: Trial, *, anyway: bool = False, progress: Progress | None = None
) -> tuple[Solution, InformationHistory]:
    """Solve a trial, and follow the information on its constants along it.

    Parameters and errors as of `solvers.batch.solve`.
    """
    errors = accepted_errors(survey(trial), anyway=anyway)
    with explained(errors):
        minima = solved_problems(trial, progress=progress)
    if progress:
        progress("information along the trial", 0, None)
    solution = most_probable_minimum(
        [summarise(trial, each, rate_hz=RATE_HZ) for each in minima],
        np.array([evidence_against(each) for each in minima]),
    )
    return solution.with_findings(errors), information_history(minima[0])


def information_history(found: SolvedProblem) -> InformationHistory:
    """Return the covariance of all constants given the data up to each node.

    Information that only the noise of the motion makes is no more believed half-way than it
    is at the end: where it prevails, a direction stays at its prior. Directions that are
    fixed in the problem stay there all the time.
    """
    problem, evaluation = found.problem, found.minimum.evaluation
    triangles, _ = run_filter(problem, evaluation)
    undetermined = _undetermined(problem, evaluation, found.covariances.given, triangles)
    return as_history(problem, evaluation, found.fixed, triangles, undetermined)


def _undetermined(
    problem: Problem, evaluation: Evaluation, nodes: Array, triangles: Array
) -> dict[int, Array]:
    """Return the directions that the data do not determine yet, by entry of the history."""
    size = len(problem.prior_root)
    if size == 0:
        return {}
    spurious = np.zeros((nodes.shape[0], size, size))
    np.cumsum(spurious_information(problem, evaluation, nodes)[:-1], axis=0, out=spurious[1:])
    # The last columns are those of the parameters: their triangle has all else eliminated.
    root = triangles[:, -size:, -size:] @ problem.prior_root
    data = np.swapaxes(root, 1, 2) @ root - np.eye(size)
    # The last entry was judged by the solver.
    doubtful = np.flatnonzero(largest_spurious_share(data, spurious)[:-1] >= SPURIOUS)
    found = {int(k): undetermined_directions(data[k], spurious[k]) for k in doubtful}
    return {k: directions for k, directions in found.items() if directions.size}


def run_filter(
    problem: Problem, evaluation: Evaluation, start: Frontier | None = None
) -> tuple[Array, Frontier]:
    """Return the triangles over the constants before any data and at each later node.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Linearised there.
    start : Frontier, optional
        Information at the first node; by default the priors in the graph. If it is given, they
        are left out: it contains them.

    Returns
    -------
    triangles : ndarray, shape (K, c, c)
        Square-root information on the constants.
    frontier : Frontier
        Information at the last node.
    """
    layout, node = _layout(problem)
    nodes = problem.chain.segments.node_time.size
    groups = _rows_by_node(problem, evaluation, layout, node, with_priors=start is None)
    c = layout.width - 2 * layout.own
    out = np.empty((nodes, c, c))
    empty = np.zeros((0, layout.width))
    if start is None:
        root = _triangle(_of_one_node(groups.get(-1, empty), layout), layout.own + c)
    else:
        root = start.root
    out[0] = _triangle(root[:, layout.own :], c)
    for k in range(nodes):
        new = groups.get(k, empty)
        rows = np.zeros((root.shape[0] + new.shape[0], layout.width))
        rows[: root.shape[0], : layout.own] = root[:, : layout.own]
        rows[: root.shape[0], 2 * layout.own :] = root[:, layout.own :]
        rows[root.shape[0] :] = new
        if k == nodes - 1:
            root = _triangle(_of_one_node(rows, layout), layout.own + c)
            # Measurements at the very last node, if any, belong to its time.
            out[k] = root[layout.own :, layout.own :]
            break
        root = _triangle(rows, layout.width)[layout.own :, layout.own :]
        out[k + 1] = root[layout.own :, layout.own :]
    return out, Frontier(root)


def _of_one_node(rows: Array, layout: _Layout) -> Array:
    """Return rows without the columns of the node after, which they do not touch."""
    return np.delete(rows, np.s_[layout.own : 2 * layout.own], axis=1)


def as_history(
    problem: Problem,
    evaluation: Evaluation,
    fixed: Array,
    triangles: Array,
    undetermined: Mapping[int, Array],
) -> InformationHistory:
    """Return triangles over the constants in reported parametrisation and units.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Linearised there.
    fixed : ndarray, shape (P, h)
        Directions of the parameters that are fixed in the problem.
    triangles : ndarray
        Of `run_filter`.
    undetermined : mapping of int to ndarray
        Further directions that are at their prior, by entry.
    """
    layout, _ = _layout(problem)
    names: list[str] = []
    rows: list[Array] = []
    kept: list[dict[int, Array]] = []
    free: list[np.ndarray] = []
    for parameter, _, functional in reported(problem, evaluation):
        if functional is None or not functional.keys() <= layout.constants.keys():
            continue
        for key, matrix in functional.items():
            wide = np.zeros((matrix.shape[0], triangles.shape[1]))
            wide[:, layout.constants[key] : layout.constants[key] + matrix.shape[1]] = matrix
            rows.append(wide)
        kept.append(functional)
        names += parameter.component_names
        free.append(parameter.sigma > 0.0)
    is_free = np.concatenate(free)
    transport = np.concatenate(rows)[is_free]
    whiten = np.linalg.inv(problem.prior_root)
    columns = slice(triangles.shape[1] - len(whiten), None)

    def prior(directions: Array) -> Array:
        return prior_along(problem, directions, kept, {})[is_free]

    at_prior = prior(fixed)
    size = int(is_free.sum())
    root = np.empty((triangles.shape[0], size, size))
    for k, triangle in enumerate(triangles):
        spread = at_prior
        if k in undetermined:
            rows_fixed = np.zeros((undetermined[k].shape[1], triangle.shape[0]))
            rows_fixed[:, columns] = undetermined[k].T @ whiten / FIXED_DIRECTION_STD
            triangle = _triangle(np.concatenate([triangle, rows_fixed]), triangle.shape[0])
            spread = np.hstack([at_prior, prior(undetermined[k])])
        inverse, info = dtrtri(triangle)
        if info != 0:
            raise np.linalg.LinAlgError("a constant without a prior")
        root[k] = _triangle(np.hstack([transport @ inverse, spread]).T, size).T
    return InformationHistory(
        time=problem.chain.segments.node_time,
        names=tuple(name for name, is_kept in zip(names, is_free, strict=True) if is_kept),
        root=root,
    )


def _layout(problem: Problem) -> tuple[_Layout, dict[int, tuple[int, int]]]:
    """Return the columns, and node and offset of every key that is not a constant."""
    walking = problem.chain.walking
    constants: dict[int, int] = {}
    at = 0
    if not walking:
        constants[keys.bias(0)] = 0
        at = BIAS_SIZE
    for p in problem.parameters:
        constants[problem.key(p.name)] = at
        at += p.mean.size
    node: dict[int, tuple[int, int]] = {}
    for k in range(problem.chain.segments.node_time.size):
        node[keys.node(k)] = (k, 0)
        if walking:
            node[keys.bias(k)] = (k, STATE_SIZE)
    own = STATE_SIZE + BIAS_SIZE * walking
    return _Layout(own, constants, 2 * own + at), node


def _rows_by_node(
    problem: Problem,
    evaluation: Evaluation,
    layout: _Layout,
    node: dict[int, tuple[int, int]],
    *,
    with_priors: bool,
) -> dict[int, Array]:
    """Return the whitened rows of all factors by the first node of each.

    What involves nothing but constants and the first node's state without a measurement,
    the priors, is under -1.
    """
    gaussian = problem.linearize(evaluation)
    sizes = evaluation.values.dims()
    priors = problem.graph.size()
    found: dict[int, list[Array]] = {}
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        involved = list(factor.keys())
        nodes = {node[key][0] for key in involved if key in node}
        first = min(nodes, default=0)
        is_prior = i < priors and nodes <= {0}
        if is_prior and not with_priors:
            continue
        found.setdefault(-1 if is_prior else first, []).append(
            _wide(factor, involved, sizes, layout, node, first)
        )
    return {k: np.concatenate(parts) for k, parts in found.items()}


def _wide(
    factor: gtsam.GaussianFactor,
    involved: list[int],
    sizes: dict[int, int],
    layout: _Layout,
    node: dict[int, tuple[int, int]],
    first: int,
) -> Array:
    A = factor.jacobian()[0]
    out = np.zeros((A.shape[0], layout.width))
    at = 0
    for key in involved:
        size, column = sizes[key], layout.column(key, node, first)
        out[:, column : column + size] = A[:, at : at + size]
        at += size
    return out


def _triangle(rows: Array, size: int) -> Array:
    """Return the upper triangle (size, size) of a QR factorisation, with a positive diagonal."""
    if rows.shape[0] < size:
        rows = np.concatenate([rows, np.zeros((size - rows.shape[0], size))])
    # Rows of large weight first: Householder's reflections then lose no digits of the others.
    heavy = np.argsort(-np.abs(rows).max(axis=1), kind="stable")
    R = np.triu(dgeqrf(rows[heavy])[0][:size])
    return R * np.where(np.diag(R) < 0.0, -1.0, 1.0)[:, None]
