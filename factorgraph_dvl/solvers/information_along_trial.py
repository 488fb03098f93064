"""The information on the calibration as it grows along a trial.

A square-root information filter over the linearised graph. Its frontier is the latest
state with all constants behind it:

    rows = [R over (x_k, c); factors between x_k, x_{k+1} and c]  --QR-->  R' over (x_{k+1}, c).

x_k is eliminated first, so that the triangle that is left over c is the square root of the
information of all data so far on the constants, whatever the states were: their
marginal information. Nothing is squared (Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977, ch. VI). At the end it is what the smoother has. Residuals are one
more column, which gives the constants by the data so far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import gtsam
import numpy as np
from scipy.linalg.lapack import dgeqrf, dtrtri

from factorgraph_dvl.estimates import values_of
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, IntArray, sums_before
from factorgraph_dvl.graph.problem import FIXED_DIRECTION_STD, Evaluation, Problem
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.solvers.batch import solve_with_problem
from factorgraph_dvl.solvers.calibration import changes_of, prior_along, reported
from factorgraph_dvl.solvers.considered_errors import ConsideredError
from factorgraph_dvl.solvers.fixed_directions import SolvedProblem
from factorgraph_dvl.solvers.reported import estimates_of
from factorgraph_dvl.statistics.information_history import InformationHistory
from factorgraph_dvl.statistics.spurious_information import spurious_information
from factorgraph_dvl.statistics.undetermined_directions import (
    SPURIOUS,
    largest_spurious_share,
    undetermined_directions,
)
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class Filtered:
    """What a filter along a chain says of the constants at nodes, and its frontier at the end.

    Parameters
    ----------
    triangles : ndarray, shape (K, c, c)
        Square-root information on the constants, before any data for the first node of all.
    right_sides : ndarray, shape (K, c)
        Triangle times the step of the constants to their values by the data up to a node.
    frontier : Frontier
        Information at the last node.
    """

    triangles: Array
    right_sides: Array
    frontier: Frontier


@dataclass(frozen=True)
class Frontier:
    """Square-root information at a node over its state and all constants.

    Parameters
    ----------
    root : ndarray, shape (n, n)
        Upper triangle; columns: state, what its node has beside (a bias that walks, rates),
        constants.
    """

    root: Array


# Rate of the trajectory, Hz. Chosen: angular rates are taken from its attitudes, under sway of
# some hertz.
RATE_HZ = 20.0


def solve_with_history(
    trial: Trial,
    *,
    rate_hz: float = RATE_HZ,
    entries: int | None = None,
    anyway: bool = False,
    progress: Progress | None = None,
) -> tuple[Solution, InformationHistory]:
    """Solve a trial, and follow the information on its constants along it.

    Parameters and errors as of `solvers.batch.solve`; `entries` as of `information_history`.
    """
    solution, solved = solve_with_problem(trial, rate_hz=rate_hz, anyway=anyway, progress=progress)
    if progress:
        progress("information along the trial", 0, None)
    return solution, information_history(solved, entries=entries)


def information_history(found: SolvedProblem, *, entries: int | None = None) -> InformationHistory:
    """Return the covariance of all constants given the data up to nodes along the trial.

    Information that only the noise of the motion makes is no more accepted half-way than it
    is at the end: where it prevails, a direction stays at its prior. Directions that are
    fixed in the problem stay there all the time.

    Parameters
    ----------
    found : SolvedProblem
        Solved problem of the trial.
    entries : int, optional
        Most entries of the history; where there are more nodes, evenly among them, with the
        first and the last. By default every node has one.
    """
    problem, evaluation = found.problem, found.minimum.evaluation
    time = problem.chain.node_time
    shown = np.linspace(0, time.size - 1, min(entries or time.size, time.size)).astype(int)
    middle = int(np.searchsorted(time, 0.5 * (time[0] + time[-1]), side="right")) - 1
    shown = np.union1d(shown, [middle])
    filtered = run_filter(problem, evaluation, nodes=shown)
    undetermined = _undetermined(found, filtered.triangles, shown)
    errors = found.covariances.errors
    history = as_history(
        problem,
        evaluation,
        found.fixed,
        filtered.triangles,
        undetermined,
        nodes=shown,
        errors=errors,
    )
    at = int(np.searchsorted(shown, middle))
    triangle, right = filtered.triangles[at], filtered.right_sides[at]
    values = _values_at(problem, evaluation, triangle, right, undetermined.get(at))
    return replace(history, halfway=values)


def _values_at(
    problem: Problem,
    evaluation: Evaluation,
    triangle: Array,
    right: Array,
    undetermined: Array | None,
) -> dict[str, Array]:
    """Return the calibration by the data up to a node, by name in reported units.

    One linear step from the whole trial, with its noise and without its outliers. Directions
    (P, h) that are not determined yet stay at their prior.
    """
    if undetermined is not None:
        gain = undetermined.T @ np.linalg.inv(problem.prior_root) / FIXED_DIRECTION_STD
        beside = np.zeros((len(gain), len(right) - gain.shape[1]))
        from_prior = problem.difference(evaluation.parameters, problem.prior_values())
        rows = np.hstack([beside, gain, -(gain @ from_prior)[:, None]])
        rows = np.vstack([np.hstack([triangle, right[:, None]]), rows])
        triangle, right = np.hsplit(_triangle(rows, len(right)), [len(right)])
    step = np.linalg.solve(triangle, right.ravel())
    columns = _constants(problem)
    moved = dict(evaluation.parameters)
    for p in problem.parameters:
        at = columns[problem.key(p.name)]
        own = step[at : at + p.mean.size]
        moved[p.name] = moved[p.name] @ exp_so3(own) if p.rotation else moved[p.name] + own
    there = replace(evaluation, parameters=moved)
    rows_of = [(p, value) for p, value, _ in reported(problem, there) if p.name in moved]
    free = sum(p.mean.size for p, _ in rows_of if p.estimated)
    return values_of(estimates_of(rows_of, np.zeros((free, free)))[0])


def _undetermined(found: SolvedProblem, triangles: Array, shown: Array) -> dict[int, Array]:
    """Return the directions that the data do not determine yet, by entry of the history."""
    problem = found.problem
    size = len(problem.prior_root)
    if size == 0:
        return {}
    by_node, given = found.spurious, found.covariances.given
    if by_node is None:
        by_node = spurious_information(problem, found.minimum.evaluation, given)
    spurious = sums_before(by_node)[shown]
    # The last columns are those of the parameters: their triangle has all else eliminated.
    root = triangles[:, -size:, -size:] @ problem.prior_root
    data = np.swapaxes(root, 1, 2) @ root - np.eye(size)
    # The last entry was judged by the solver.
    doubtful = np.flatnonzero(largest_spurious_share(data, spurious)[:-1] >= SPURIOUS)
    left = {int(k): undetermined_directions(data[k], spurious[k]) for k in doubtful}
    return {k: directions for k, directions in left.items() if directions.size}


def run_filter(
    problem: Problem,
    evaluation: Evaluation,
    start: Frontier | None = None,
    *,
    nodes: IntArray | None = None,
) -> Filtered:
    """Return the triangles over the constants before any data and at each later node.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Linearised there.
    start : Frontier, optional
        Information at the first node; by default the priors in the graph. If it is given, they
        are left out: it contains them.
    nodes : ndarray of int, optional
        Those whose triangles are returned, in order; by default all.
    """
    steps = _rows_by_step(problem, evaluation, with_priors=start is None)
    # Nothing else holds the factors then, so that each goes with its step.
    problem.release()
    sizes = evaluation.values.dims()
    last = problem.chain.node_time.size - 1
    # A variable goes at the last step that depends on it, those of the last node never.
    gone_after = {key: k for k, rows in sorted(steps.items()) for row in rows for key in row.keys}
    gone_after |= dict.fromkeys(_own_keys(problem, last), last)
    columns = _constants(problem)
    c = sum(sizes[key] for key in columns)
    wanted = np.arange(last + 1) if nodes is None else nodes
    place = {k: i for i, k in enumerate(wanted.tolist())}
    out = np.empty((wanted.size, c, c + 1))
    frontier = [] if start is None else _own_keys(problem, 0)
    # The last column is the right side.
    root = np.zeros((0, c + 1)) if start is None else np.pad(start.root, ((0, 0), (0, 1)))
    for k in range(-1 if start is None else 0, last + 1):
        # Factors that nobody else holds go with their step.
        rows = steps.pop(k, [])
        present = dict.fromkeys((*frontier, *(key for row in rows for key in row.keys)))
        inner = [key for key in present if key not in columns]
        leaving = [key for key in inner if k < last and gone_after[key] <= k]
        # The states come right before the constants, so that the frontier is the end of R.
        own = _own_keys(problem, min(k + 1, last))
        others = [key for key in inner if key not in leaving and key not in own]
        staying = [*others, *(key for key in own if key in present)]
        triangle = _triangle(*_stacked(root, frontier, rows, [*leaving, *staying], columns, sizes))
        gone = sum(sizes[key] for key in leaving)
        root, frontier = triangle[gone:, gone:], staying
        # Measurements at the very last node, if any, belong to its time.
        if (at := place.get(min(k + 1, last))) is not None:
            out[at] = triangle[len(triangle) - c :, len(triangle) - c :]
    ending = len(root) - c - sum(sizes[key] for key in _own_keys(problem, last))
    return Filtered(out[:, :, :-1], out[:, :, -1], Frontier(root[ending:, ending:-1]))


def _own_keys(problem: Problem, k: int) -> list[int]:
    """Return the variables of a node: its state, and what it has beside."""
    return problem.chain.keys_of([k])


def as_history(
    problem: Problem,
    evaluation: Evaluation,
    fixed: Array,
    triangles: Array,
    undetermined: Mapping[int, Array],
    *,
    nodes: Array | None = None,
    errors: Sequence[ConsideredError] = (),
) -> InformationHistory:
    """Return triangles over the constants in reported parametrisation and units.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        Linearised there.
    fixed : ndarray, shape (P, h)
        Directions of the parameters that are fixed in the problem.
    triangles : ndarray
        Triangles of `run_filter`.
    undetermined : mapping of int to ndarray
        Further directions that are at their prior, by entry.
    nodes : ndarray of int, optional
        Nodes of the triangles; by default every node.
    errors : sequence of ConsideredError, optional
        Errors that are considered at the last of them. Before, they move a component by the share
        of its prior variance that the data have explained.
    """
    columns = _constants(problem)
    names: list[str] = []
    rows: list[Array] = []
    kept: list[dict[int, Array]] = []
    free: list[np.ndarray] = []
    priors: list[Array] = []
    for parameter, _, functional in reported(problem, evaluation):
        if functional is None or not functional.keys() <= columns.keys():
            continue
        for key, matrix in functional.items():
            wide = np.zeros((matrix.shape[0], triangles.shape[1]))
            wide[:, columns[key] : columns[key] + matrix.shape[1]] = matrix
            rows.append(wide)
        kept.append(functional)
        names += parameter.component_names
        free.append(parameter.sigma > 0.0)
        priors.append(parameter.sigma / parameter.si)
    # A track may have nothing else to estimate.
    is_free = np.concatenate([np.zeros(0, dtype=bool), *free])
    transport = np.concatenate([np.zeros((0, triangles.shape[1])), *rows])[is_free]
    whiten = np.linalg.inv(problem.prior_root)
    of_parameters = slice(triangles.shape[1] - len(whiten), None)

    def prior(directions: Array) -> Array:
        return prior_along(problem, directions, kept, {})[is_free]

    at_prior = prior(fixed)
    size = int(is_free.sum())
    root = np.empty((triangles.shape[0], size, size))
    for k, triangle in enumerate(triangles if size else ()):
        spread = at_prior
        if k in undetermined:
            rows_fixed = np.zeros((undetermined[k].shape[1], triangle.shape[0]))
            rows_fixed[:, of_parameters] = undetermined[k].T @ whiten / FIXED_DIRECTION_STD
            triangle = _triangle(np.concatenate([triangle, rows_fixed]), triangle.shape[0])
            spread = np.hstack([at_prior, prior(undetermined[k])])
        inverse, info = dtrtri(triangle)
        if info != 0:
            raise np.linalg.LinAlgError("a constant without a prior")
        root[k] = _triangle(np.hstack([transport @ inverse, spread]).T, size).T
    if errors and kept:
        changes = np.hstack([changes_of(kept, error.changes) for error in errors])[is_free]
        taken = np.concatenate(priors)[is_free] ** 2 - np.sum(root**2, axis=2)
        share = np.clip(taken / np.maximum(taken[-1], np.finfo(float).tiny), 0.0, 1.0)
        for k, moved in enumerate(np.sqrt(share)[:, :, None] * changes):
            root[k] = _triangle(np.hstack([root[k], moved]).T, size).T
    time = problem.chain.node_time
    return InformationHistory(
        time=time if nodes is None else time[nodes],
        names=tuple(name for name, is_kept in zip(names, is_free, strict=True) if is_kept),
        root=root,
    )


def _constants(problem: Problem) -> dict[int, int]:
    """Return the columns of the variables that do not belong to a time, parameters last."""
    out: dict[int, int] = {}
    at = 0
    own = {problem.key(p.name): p.mean.size for p in problem.parameters}
    for key, size in (*problem.chain.constants.items(), *own.items()):
        out[key] = at
        at += size
    return out


@dataclass(frozen=True)
class _Factor:
    """A linear factor, with its variables."""

    keys: list[int]
    factor: gtsam.GaussianFactor

    @property
    def matrix(self) -> Array:
        """Whitened rows; those of all factors at once would take as much memory as all else.

        The last column is the right side.
        """
        matrix, right = self.factor.jacobian()
        return np.column_stack([matrix, right])


def _rows_by_step(
    problem: Problem, evaluation: Evaluation, *, with_priors: bool
) -> dict[int, list[_Factor]]:
    """Return all factors of the linearised graph by the node before the last of each.

    What involves nothing but constants and the first node without a measurement, the priors, is
    under -1; noise that is correlated belongs to the node before its own, or before the first
    measurement that has it, as clocks differ.
    """
    gaussian = problem.linearize(evaluation)
    time = problem.chain.node_time
    of_states = {key: k for k in range(time.size) for key in problem.chain.keys_of([k])}
    of_errors: dict[int, int] = {}
    for p in problem.processes:
        before = np.searchsorted(time, p.time, side="right") - 1
        of_errors |= {p.key(j): int(k) for j, k in enumerate(np.clip(before, 0, time.size - 1))}
    priors = problem.graph.size()
    out: dict[int, list[_Factor]] = {}
    first_use: dict[int, int] = {}
    others: list[tuple[int, _Factor]] = []
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        involved = list(factor.keys())
        known = {of_states[key] for key in involved if key in of_states} or {
            of_errors[key] for key in involved if key in of_errors
        }
        is_prior = i < priors and known <= {0}
        if is_prior and not with_priors:
            continue
        # Attitudes may be those of other nodes: what is known of all of them comes before.
        k = -1 if is_prior else max(min(known, default=0), max(known, default=0) - 1)
        if of_errors.keys() >= set(involved):
            others.append((k, _Factor(involved, factor)))
            continue
        first_use |= {key: min(k, first_use.get(key, k)) for key in involved}
        out.setdefault(k, []).append(_Factor(involved, factor))
    for k, correlated in others:
        k = min(k, *(first_use.get(key, k) for key in correlated.keys[-1:]))
        out.setdefault(k, []).append(correlated)
    return out


def _stacked(
    root: Array,
    frontier: Sequence[int],
    factors: Sequence[_Factor],
    order: Sequence[int],
    constants: Mapping[int, int],
    sizes: Mapping[int, int],
) -> tuple[Array, int]:
    """Return rows over variables in an order, constants, and right side; number of variables."""
    column: dict[int, int] = {}
    width = 0
    for key in order:
        column[key] = width
        width += sizes[key]
    column |= {key: width + at for key, at in constants.items()}
    width += sum(sizes[key] for key in constants)
    blocks = [([*frontier, *constants], root), *((f.keys, f.matrix) for f in factors)]
    out = np.zeros((sum(len(matrix) for _, matrix in blocks), width + 1))
    row = 0
    for involved, matrix in blocks:
        at = 0
        for key in involved:
            size = sizes[key]
            out[row : row + len(matrix), column[key] : column[key] + size] = matrix[
                :, at : at + size
            ]
            at += size
        out[row : row + len(matrix), width] = matrix[:, at]
        row += len(matrix)
    return out, width


def _triangle(rows: Array, size: int) -> Array:
    """Return the upper triangle of a QR factorisation, with a positive diagonal.

    Of the first columns, (size, size); those that follow are reflected with them.
    """
    if rows.shape[0] < size:
        rows = np.concatenate([rows, np.zeros((size - rows.shape[0], rows.shape[1]))])
    # Rows of large weight first: Householder's reflections then lose no digits of the others.
    heavy = np.argsort(-np.abs(rows[:, :size]).max(axis=1), kind="stable")
    R = dgeqrf(rows[heavy])[0][:size]
    R[:, :size] *= _upper(size)
    return R * np.where(np.diag(R) < 0.0, -1.0, 1.0)[:, None]


@lru_cache(maxsize=16)
def _upper(size: int) -> Array:
    """Return ones on and above the diagonal, (size, size), zeros below it."""
    return np.triu(np.ones((size, size)))
