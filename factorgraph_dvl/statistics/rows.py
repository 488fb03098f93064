"""Rows of the linearised graph by source of noise, and products with them.

Each whitened row has unit noise of its own, so the covariance of all variables is a sum over
rows: P = P (sum JᵀJ) P. Whatever asks what a source of noise does starts from these rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.priors import PRIOR
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.statistics.square_root_information import ByKey, SquareRootInformation

CORRELATED = "correlated noise of {}"
# Stands for the sources that the chain names.
_OF_CHAIN = ""

# Native factors whose rows are taken at once. Chosen: some ten megabytes.
_CHUNK = 4096


def rows_by_source(problem: Problem, evaluation: Evaluation) -> Iterator[Rows]:
    """Yield all rows of the linearised graph: of the IMU, of priors, of observations.

    The source of an observation is its label; those of others are words. Those of one source may
    come in several parts.
    """
    yield from native_rows(problem, evaluation)
    yield from problem.observation_rows(evaluation)


def rows_with_times(
    problem: Problem, every: Iterable[Rows], priors: list[Rows] | None = None
) -> Iterator[tuple[Rows, Array]]:
    """Yield those of the rows by source that belong to times, with these: all but priors.

    Parameters
    ----------
    problem : Problem
        What they are rows of.
    every : iterable of Rows
        The rows.
    priors : list of Rows, optional
        Gets the others.
    """
    when = {o.label: o.time for o in problem.observations}
    processes = {keys.letter_of(p.key(0)): p.time for p in problem.processes}
    node_time = problem.chain.node_time
    for rows in every:
        if rows.source in when:
            yield rows, when[rows.source][rows.begin : rows.begin + len(rows.vector)]
            continue
        first = rows.keys[:, 0]
        letter = keys.letter_of(int(first[0]))
        if rows.keys.shape[1] > 1 and (letter in keys.OF_NODES or letter in processes):
            yield rows, processes.get(letter, node_time)[keys.indices_of(first)]
        elif priors is not None:
            priors.append(rows)


def product(rows: Rows, columns: Mapping[int, Array]) -> Array:
    """Return the Jacobian times columns (size, n) of its variables by key, (M, d, n)."""
    total: Array | float = 0.0
    for own, matrix in _by_variable(rows):
        if isinstance(columns, ByKey):
            total = total + matrix @ columns.stacked(own, matrix.shape[2])
            continue
        first = _runs(own)
        known = np.stack([columns[key] for key in own[first].tolist()])
        lengths = np.diff(first, append=own.size)
        total = total + matrix @ (known[0] if first.size == 1 else known.repeat(lengths, 0))
    return np.asarray(total)


def add_transposed_product(rows: Rows, factors: Array, sums: dict[int, Array]) -> None:
    """Add factorsᵀ times the Jacobian to sums (n, size) by key.

    Parameters
    ----------
    rows : Rows
        M items of d rows.
    factors : ndarray, shape (M, d, n)
        Factors of each row.
    sums : dict of int to ndarray
        Sums by key, which are changed.
    """
    variables: dict[bytes, tuple[IntArray, list[tuple[IntArray, Array]]]] = {}
    for own, matrix in _by_variable(rows):
        first = _runs(own)
        variables.setdefault(first.tobytes(), (first, []))[1].append((own, matrix))
    width = factors.shape[2]
    for first, together in variables.values():
        lengths = np.diff(first, append=len(factors))
        for length in np.unique(lengths).tolist():
            begins = first[lengths == length]
            items = begins[:, None] + np.arange(length)
            turned = factors[items].reshape(begins.size, -1, width).transpose(0, 2, 1)
            for own, matrix in together:
                added = turned @ matrix[items].reshape(begins.size, -1, matrix.shape[2])
                for key, part in zip(own[begins].tolist(), added, strict=True):
                    sums[key] = sums[key] + part if key in sums else part


def with_own_covariance(
    parts: Sequence[tuple[IntArray, Array]], information: SquareRootInformation
) -> list[Array]:
    """Return the covariance J P of rows with their own variables, (M, d, n) for each part.

    Zero where a row is. The variables of an item share a clique, as those of a factor do.

    Parameters
    ----------
    parts : sequence of tuple of ndarray
        Keys (M, k) of the variables of each item, and its rows J by these (M, d, n).
    information : SquareRootInformation
        Square-root information of all variables.
    """
    out = [np.zeros_like(matrix) for _, matrix in parts]
    # What is not used need not be in the graph.
    used = [np.flatnonzero(np.any(matrix, axis=(1, 2))) for _, matrix in parts]
    groups = [own[some] for (own, _), some in zip(parts, used, strict=True)]
    for part, items, P in information.joint_in_parts(groups):
        some = used[part][items]
        out[part][some] = parts[part][1][some] @ P
    return out


def _runs(keys_: IntArray) -> IntArray:
    """Return where each run of equal keys begins: in the order of time few keys come again."""
    return np.flatnonzero(np.diff(keys_, prepend=keys_[0] - 1))


def _by_variable(rows: Rows) -> Iterator[tuple[IntArray, Array]]:
    """Yield keys (M,) and Jacobian (M, d, size) of each variable."""
    edges = np.cumsum([0, *rows.sizes])
    for i in range(len(rows.sizes)):
        yield rows.keys[:, i], rows.matrix[:, :, edges[i] : edges[i + 1]]


def native_rows(problem: Problem, evaluation: Evaluation, every: int = 1) -> Iterator[Rows]:
    """Yield the rows of the factors that GTSAM linearises itself, some of one source together.

    Parameters
    ----------
    problem : Problem
        Problem with weights.
    evaluation : Evaluation
        Where the graph is linear.
    every : int, default 1
        The factors of one of so many nodes are taken, from the first on.
    """
    yield from problem.chain_rows(evaluation)
    gaussian = problem.native(evaluation)
    sizes = evaluation.values.dims()
    names = {problem.key(p.name): p.name for p in problem.parameters}
    of_chain = ", ".join(p.name for p, _, _ in problem.chain.mean_constants(evaluation.states))
    names |= {p.key(j): p.label for p in problem.processes for j in range(p.time.size)}
    found: dict[tuple[str, tuple[int, ...]], list[tuple[list[int], Array]]] = {}
    for i in range(gaussian.size()):
        factor = gaussian.at(i)
        own = list(factor.keys())
        if keys.index_of(own[0]) % every:
            continue
        kind = (_source(own, names, of_chain), tuple(sizes[key] for key in own))
        items = found.setdefault(kind, [])
        items.append((own, np.array(factor.augmentedJacobian())))
        if len(items) == _CHUNK:
            yield from _together(problem, *kind, found.pop(kind))
    for kind, items in found.items():
        yield from _together(problem, *kind, items)


def _together(
    problem: Problem, source: str, shape: tuple[int, ...], items: list[tuple[list[int], Array]]
) -> Iterator[Rows]:
    """Yield the rows of factors of one source: their variables, and their augmented Jacobians."""
    variables = np.array([own for own, _ in items])
    matrix = np.stack([augmented for _, augmented in items])
    parts = {source: slice(None)}
    if source == _OF_CHAIN:
        parts = problem.chain.sources("".join(map(keys.letter_of, items[0][0])))
    for name, own_rows in parts.items():
        part = matrix[:, own_rows]
        yield Rows(name, ("",) * part.shape[1], variables, shape, part[..., :-1], -part[..., -1])


def _source(own: list[int], names: Mapping[int, str], of_chain: str) -> str:
    """Return the source of a factor's noise, from its variables."""
    if keys.is_process(own[0]):
        return CORRELATED.format(names[own[0]])
    if keys.letter_of(own[0]) == "x":
        return _OF_CHAIN
    calibration = [names[key] for key in own if key in names]
    if not calibration:
        return _OF_CHAIN
    if len(calibration) < len(own):
        calibration.insert(0, of_chain)
    return PRIOR.format(", ".join(calibration))
