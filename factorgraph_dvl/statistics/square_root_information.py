"""Covariances of any variables from the square root of an information matrix.

The Bayes tree that QR elimination leaves contains the square root R of the information
matrix clique by clique. Everything here is built from R: squaring it first would lose
the digits that navigation-grade gyros need. Cliques of one depth do not depend on each other, so
those that look alike are treated together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray

# Cliques whose joint covariances are there at once. Chosen: some ten megabytes.
_AT_ONCE = 512


class ByKey(Mapping[int, Array]):
    """Rows (size, n) of variables by key, all in one table.

    Parameters
    ----------
    keys : ndarray of int, shape (K,)
        Keys in ascending order.
    first : ndarray of int, shape (K + 1,)
        Row at which those of each variable begin.
    table : ndarray, shape (N, n)
        Rows of all variables.
    """

    def __init__(self, keys: IntArray, first: IntArray, table: Array) -> None:
        self._keys, self._first, self._table = keys, first, table

    def __getitem__(self, key: int) -> Array:
        i = int(_places(self._keys, np.array(key)))
        return self._table[self._first[i] : self._first[i + 1]]

    def __iter__(self) -> Iterator[int]:
        return iter(self._keys.tolist())

    def __len__(self) -> int:
        return self._keys.size

    def stacked(self, keys: IntArray, size: int) -> Array:
        """Return the rows (M, size, n) of variables of one size."""
        rows = self._first[_places(self._keys, keys)]
        return np.asarray(self._table[rows[:, None] + np.arange(size)])

    def times(self, factor: float) -> ByKey:
        """Return all rows times a factor."""
        return ByKey(self._keys, self._first, factor * self._table)

    def after(self, functional: Mapping[int, Array]) -> Array:
        """Return a linear functional of all, (m, size) by key, of the rows, (m, n)."""
        parts = [
            matrix @ self._table[begin : begin + matrix.shape[1]]
            for begin, matrix in zip(
                self._first[_places(self._keys, np.array(list(functional)))],
                functional.values(),
                strict=True,
            )
        ]
        return np.asarray(sum(parts))


@dataclass(frozen=True)
class _Cliques:
    """Cliques of one depth that look alike: R x_F + T x_S = d + noise of unit variance.

    Parameters
    ----------
    numbers, parents : ndarray of int, shape (M,)
        Numbers of the cliques, ascending, and of their parents.
    frontals, separators : ndarray of int, shapes (M, f) and (M, s)
        Components of x_F and x_S among all.
    R, T, d : ndarray, shapes (M, f, f), (M, f, s) and (M, f)
        Conditionals.
    """

    numbers: IntArray
    parents: IntArray
    frontals: IntArray
    separators: IntArray
    R: Array
    T: Array
    d: Array


@dataclass(frozen=True)
class _Joint:
    """Joint covariances of cliques that look alike.

    Parameters
    ----------
    numbers : ndarray of int, shape (M,)
        Numbers of the cliques, ascending.
    inside : ndarray of int, shape (M, w)
        Their components among all.
    P : ndarray, shape (M, w, w)
        Their covariances.
    """

    numbers: IntArray
    inside: IntArray
    P: Array

    @cached_property
    def _sorted(self) -> tuple[IntArray, int, IntArray]:
        """Components of all cliques one after another, ascending, by what; where they stand."""
        order = np.argsort(self.inside, axis=1)
        base = int(self.inside.max(initial=0)) + 1
        lines = np.take_along_axis(self.inside, order, axis=1)
        return (lines + base * np.arange(len(lines))[:, None]).ravel(), base, order.ravel()

    def of(self, number: IntArray, wanted: IntArray) -> Array:
        """Return the covariances (B, n, n) of components (B, n), each of one of the cliques."""
        lines, base, order = self._sorted
        i = np.searchsorted(self.numbers, number)
        at = order[np.searchsorted(lines, wanted + base * i[:, None])]
        return np.asarray(self.P[i[:, None, None], at[:, :, None], at[:, None]])


class SquareRootInformation:
    """Square-root information of a Gaussian graph.

    Parameters
    ----------
    trees : iterable of gtsam.GaussianBayesTree or gtsam.GaussianBayesNet
        What the elimination of all variables leaves, or of one part after another.
    sizes : mapping of int to int
        Dimension of every variable by key.
    """

    def __init__(
        self,
        trees: Iterable[gtsam.GaussianBayesTree | gtsam.GaussianBayesNet],
        sizes: Mapping[int, int],
    ) -> None:
        every: list[_Clique] = []
        for tree in trees:
            every += reversed(_cliques_of(tree, sizes))
        used = {key for clique in every for key in (*clique.frontals, *clique.separators)}
        self._keys = np.array(sorted(used), dtype=int)
        self._sizes = np.array([sizes[key] for key in self._keys.tolist()], dtype=int)
        self._first = np.concatenate([[0], np.cumsum(self._sizes)])
        # From the root to the leaves: cliques of each depth that look alike.
        parts = {key: np.arange(own.start, own.stop) for key, own in self._rows.items()}
        self._levels = _levels(every[::-1], parts)

    @cached_property
    def _rows(self) -> dict[int, slice]:
        """Components of each variable among all, by key."""
        slices = map(slice, self._first[:-1].tolist(), self._first[1:].tolist())
        return dict(zip(self._keys.tolist(), slices, strict=True))

    @property
    def _cliques(self) -> list[_Cliques]:
        return [cliques for level in self._levels for cliques in level]

    @cached_property
    def _place(self) -> IntArray:
        """Number of the clique in which each component is frontal, -1 where it is in none."""
        out = np.full(self._first[-1], -1)
        for each in self._cliques:
            out[each.frontals] = each.numbers[:, None]
        return out

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the information."""
        diagonals = (each.R.diagonal(axis1=1, axis2=2) for each in self._cliques)
        return 2.0 * sum(float(np.log(np.abs(diagonal)).sum()) for diagonal in diagonals)

    @property
    def decrease(self) -> float:
        """Half the sum of squares that the minimum takes off that of the right-hand side."""
        return 0.5 * sum(float(np.vdot(each.d, each.d)) for each in self._cliques)

    def given(self, known: Collection[int]) -> SquareRootInformation:
        """Return the information of the other variables where some stay as they are.

        The rows of the others do not change: R x_F + T x_S = d with the known part of x zero.

        Parameters
        ----------
        known : collection of int
            Keys of variables that were eliminated after all the others.

        Raises
        ------
        ValueError
            If others were eliminated after them.
        """
        is_known = np.repeat(np.isin(self._keys, list(known)), self._sizes)
        out = copy(self)
        vars(out).pop("_place", None)
        out._levels = [
            [kept for each in level for kept in _without(each, is_known)] for level in self._levels
        ]
        return out

    def solution(self) -> gtsam.VectorValues:
        """Return the minimum of the graph."""
        x = np.zeros((self._first[-1], 1))
        for each in self._cliques:
            x[each.frontals] = _upper(each.R, each.d[..., None] - each.T @ x[each.separators])
        out = gtsam.VectorValues()
        for i in np.flatnonzero(self._place[self._first[:-1]] >= 0).tolist():
            out.insert(int(self._keys[i]), x[self._first[i] : self._first[i + 1], 0])
        return out

    def covariance_with(self, functionals: Sequence[Mapping[int, Array]]) -> ByKey:
        """Return the covariance of every variable with linear functionals of all.

        P Wᵀ = R⁻¹ R⁻ᵀ Wᵀ: from the leaves to the root, and back.

        Parameters
        ----------
        functionals : sequence of mapping of int to ndarray
            Each maps keys to (n, size) matrices; values add up over keys.

        Returns
        -------
        ByKey
            Keys to (size, sum n) matrices.
        """
        halfway = {int(each.numbers[0]): z for each, z in self._halfway(functionals)}
        x = np.zeros((self._first[-1], _width(functionals)))
        for each in self._cliques:
            z = halfway.pop(int(each.numbers[0]), 0.0) - each.T @ x[each.separators]
            x[each.frontals] = _upper(each.R, z)
        return ByKey(self._keys, self._first, x)

    def covariance_of(self, functionals: Sequence[Mapping[int, Array]]) -> Array:
        """Return the joint covariance of linear functionals of the variables.

        With W the functionals, W P Wᵀ = zᵀz with Rᵀ z = Wᵀ, from the leaves to the root.

        Parameters
        ----------
        functionals : sequence of mapping of int to ndarray
            The same as for `covariance_with`.

        Returns
        -------
        ndarray, shape (sum n, sum n)
            Covariance.
        """
        width = _width(functionals)
        out = np.zeros((width, width))
        for _, z in self._halfway(functionals):
            rows = z.reshape(-1, width)
            out += rows.T @ rows
        return out

    def _halfway(
        self, functionals: Sequence[Mapping[int, Array]]
    ) -> Iterator[tuple[_Cliques, Array]]:
        """Yield cliques, from the leaves to the root, and their rows (M, f, n) of z, Rᵀ z = Wᵀ.

        Cliques whose rows are all zero are left out.
        """
        w = np.zeros((self._first[-1], _width(functionals)))
        column = 0
        for functional in functionals:
            for key, matrix in functional.items():
                if key in self._rows:
                    w[self._rows[key], column : column + len(matrix)] += matrix.T
            column += len(next(iter(functional.values())))
        for each in reversed(self._cliques):
            own = w[each.frontals]
            if own.any():
                z = _lower(each.R.transpose(0, 2, 1), own)
                yield each, z
                _subtract(w, each.separators, each.T.transpose(0, 2, 1) @ z)

    def marginals(self, wanted: Sequence[int]) -> dict[int, Array]:
        """Return the marginal covariances of variables by key."""
        every = self.joint_covariances([(key,) for key in wanted])
        return {key: 0.5 * (P + P.T) for key, P in zip(wanted, every, strict=True)}

    def joint_covariances(self, groups: Sequence[tuple[int, ...]]) -> list[Array]:
        """Return the joint covariances of groups of variables that a factor ties together."""
        alike: defaultdict[tuple[int, ...], list[int]] = defaultdict(list)
        for i, group in enumerate(groups):
            own = [self._rows[key] for key in group]
            alike[tuple(each.stop - each.start for each in own)].append(i)
        numbers = list(alike.values())
        keys = [np.array([groups[i] for i in some]) for some in numbers]
        out: list[Array] = [np.empty((0, 0))] * len(groups)
        for part, items, found in self.joint_in_parts(keys):
            for i, P in zip(items.tolist(), found, strict=True):
                out[numbers[part][i]] = P
        return out

    def joint_in_parts(self, parts: Sequence[IntArray]) -> Iterator[tuple[int, IntArray, Array]]:
        """Yield the joint covariances of groups of variables, some groups at a time.

        The variables of a group share a clique, as those of a factor do: that of the one that was
        eliminated first.

        Parameters
        ----------
        parts : sequence of ndarray of int, shape (M, k)
            Keys of the variables of M groups: in each part of the same sizes.

        Yields
        ------
        part : int
            Number of the part.
        items : ndarray of int, shape (B,)
            Numbers of groups of the part.
        P : ndarray, shape (B, n, n)
            Covariances.
        """
        wanted = [self._by_clique(keys) for keys in parts]
        for joint in self._joint():
            for part, (own, clique, order) in enumerate(wanted):
                first = np.searchsorted(clique, joint.numbers)
                count = np.searchsorted(clique, joint.numbers, side="right") - first
                if count.any():
                    behind = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
                    items = np.repeat(first, count) + behind
                    yield part, order[items], joint.of(clique[items], own[items])

    def _by_clique(self, keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Return groups in the order of their cliques: components, cliques, and numbers."""
        if not len(keys):
            return np.zeros((0, 0), int), np.zeros(0, int), np.zeros(0, int)
        place = _places(self._keys, keys)
        sizes = self._sizes[place[0]]
        within = np.concatenate([np.arange(size) for size in sizes.tolist()])
        own = self._first[place].repeat(sizes, axis=1) + within
        # The one that was eliminated first has the greatest number.
        clique = self._place[own].max(axis=1)
        order = np.argsort(clique, kind="stable")
        return own[order], clique[order], order

    def _joint(self) -> Iterator[_Joint]:
        """Yield the joint covariances of some cliques that look alike, from the root down."""
        count = 1 + max((int(each.numbers[-1]) for each in self._cliques), default=-1)
        is_parent = np.zeros(count, bool)
        # Which of those above has each clique.
        place = np.zeros(count, int)
        above: list[_Joint] = []
        for level, below in zip(self._levels, [*self._levels[1:], []], strict=True):
            for each in below:
                is_parent[each.parents] = True
            here = []
            for each in level:
                for start in range(0, len(each.R), _AT_ONCE):
                    joint = _joint_of(each, slice(start, start + _AT_ONCE), above, place)
                    if is_parent[joint.numbers].any():
                        here.append(joint)
                    yield joint
            above = here
            for i, joint in enumerate(above):
                place[joint.numbers] = i


def _joint_of(each: _Cliques, some: slice, above: Sequence[_Joint], place: IntArray) -> _Joint:
    """Return the joint covariances of some cliques from those of their parents.

    P_FS = -R⁻¹ T P_SS and P_FF = R⁻¹R⁻ᵀ - P_FS (R⁻¹ T)ᵀ, with P_SS that of the separators.
    """
    R, T, separators = each.R[some], each.T[some], each.separators[some]
    count, f, s = T.shape
    identity = np.broadcast_to(np.eye(f), R.shape)
    solved = _upper(R, np.concatenate([identity, T], axis=2))
    inverse, gain = solved[:, :, :f], solved[:, :, f:]
    P = np.empty((count, f + s, f + s))
    P_FF = inverse @ inverse.transpose(0, 2, 1)
    if s:
        P_SS = P[:, f:, f:]
        parents = each.parents[some]
        which = place[parents]
        for i in np.unique(which).tolist():
            own = np.flatnonzero(which == i)
            P_SS[own] = above[i].of(parents[own], separators[own])
        P_FS = -gain @ P_SS
        P_FF = P_FF - P_FS @ gain.transpose(0, 2, 1)
        P[:, :f, f:], P[:, f:, :f] = P_FS, P_FS.transpose(0, 2, 1)
    # An asymmetry would double from one clique to the next where biases walk far.
    P[:, :f, :f] = 0.5 * (P_FF + P_FF.transpose(0, 2, 1))
    return _Joint(each.numbers[some], np.hstack([each.frontals[some], separators]), P)


def _without(each: _Cliques, is_known: BoolArray) -> Iterator[_Cliques]:
    """Yield cliques, alike again, in which what is known (N,) is zero."""
    left = ~is_known[each.frontals]
    kept = ~is_known[each.separators]
    patterns = np.hstack([left, kept])
    if (patterns == patterns[0]).all():
        alike = [np.arange(len(patterns))]
    else:
        _, number = np.unique(patterns, axis=0, return_inverse=True)
        alike = [np.flatnonzero(number == i) for i in range(int(number.max()) + 1)]
    for own in alike:
        f, columns = left[own[0]], np.flatnonzero(kept[own[0]])
        n = int(f.sum())
        # The last clique may have some of both, of which the known ones come last.
        if n < f.size and (columns.size or f[n:].any()):
            raise ValueError("the known variables must be eliminated after all others")
        if n:
            yield _Cliques(
                each.numbers[own],
                each.parents[own],
                each.frontals[own, :n],
                each.separators[own][:, columns],
                each.R[own, :n, :n],
                each.T[own, :n][:, :, columns],
                each.d[own, :n],
            )


def _places(every: IntArray, keys: IntArray) -> IntArray:
    """Return where keys stand among all, ascending; KeyError if one of them does not."""
    place = np.searchsorted(every, keys)
    found = place < every.size
    missing = ~found | (every[np.where(found, place, 0)] != keys) if every.size else ~found
    if missing.any():
        raise KeyError(f"variables that are not in the graph: {keys[missing].tolist()}")
    return np.asarray(place)


def _width(functionals: Sequence[Mapping[int, Array]]) -> int:
    return sum(len(next(iter(functional.values()))) for functional in functionals)


def _upper(R: Array, rhs: Array) -> Array:
    """Return R⁻¹ rhs of upper triangles: their elimination with pivots is substitution."""
    try:
        return np.asarray(np.linalg.solve(R, rhs))
    except np.linalg.LinAlgError:
        message = "the square root of the information matrix is singular"
        raise np.linalg.LinAlgError(message) from None


def _lower(L: Array, rhs: Array) -> Array:
    """Return L⁻¹ rhs of lower triangles: upper ones from the last row to the first."""
    return _upper(L[:, ::-1, ::-1], rhs[:, ::-1])[:, ::-1]


def _subtract(w: Array, rows: IntArray, by: Array) -> None:
    """Subtract (M, s, n) from rows (M, s) of a table, of which some may be the same."""
    if len(rows) == 1:
        w[rows[0]] -= by[0]
        return
    flat = rows.ravel()
    order = np.argsort(flat, kind="stable")
    first = np.flatnonzero(np.diff(flat[order], prepend=-1))
    if first.size:
        sums = np.add.reduceat(by.reshape(flat.size, -1)[order], first, axis=0)
        w[flat[order[first]]] -= sums


@dataclass(frozen=True)
class _Clique:
    """Frontal variables F given separators S: R x_F + T x_S = d + noise of unit variance."""

    frontals: tuple[int, ...]
    separators: tuple[int, ...]
    R: Array
    T: Array
    d: Array


def _levels(every: Sequence[_Clique], components: Mapping[int, IntArray]) -> list[list[_Cliques]]:
    """Return cliques of each depth that look alike, from cliques after their parents."""
    place = {key: i for i, clique in enumerate(every) for key in clique.frontals}
    # The parent is that of the separator that was eliminated first: it has all the others.
    parents = [max((place.get(key, -1) for key in c.separators), default=-1) for c in every]
    depths: list[int] = []
    alike: list[defaultdict[tuple[int, ...], list[int]]] = []
    for i, (clique, parent) in enumerate(zip(every, parents, strict=True)):
        depths.append(depths[parent] + 1 if parent >= 0 else 0)
        if depths[i] == len(alike):
            alike.append(defaultdict(list))
        alike[depths[i]][clique.T.shape].append(i)

    def together(numbers: list[int]) -> _Cliques:
        some = [every[i] for i in numbers]
        none = np.zeros(0, int)

        def stacked(keys: Iterable[tuple[int, ...]]) -> IntArray:
            rows = [np.concatenate([none, *map(components.__getitem__, own)]) for own in keys]
            return np.stack(rows)

        return _Cliques(
            np.array(numbers),
            np.array([parents[i] for i in numbers]),
            stacked(clique.frontals for clique in some),
            stacked(clique.separators for clique in some),
            # GTSAM may leave something below the diagonal.
            np.triu(np.stack([clique.R for clique in some])),
            np.stack([clique.T for clique in some]),
            np.stack([clique.d for clique in some]),
        )

    return [[together(numbers) for numbers in level.values()] for level in alike]


def _cliques_of(
    tree: gtsam.GaussianBayesTree | gtsam.GaussianBayesNet, sizes: Mapping[int, int]
) -> list[_Clique]:
    """Return the cliques of a tree, each after its parent; of a net, one for each variable."""
    if isinstance(tree, gtsam.GaussianBayesNet):
        return [_clique_of(tree.at(i), sizes) for i in reversed(range(tree.size()))]
    out = []
    stack = list(tree.roots())
    while stack:
        clique = stack.pop()
        out.append(_clique_of(clique.conditional(), sizes))
        stack += [clique[i] for i in range(clique.nrChildren())]
    return out


def _clique_of(conditional: gtsam.GaussianConditional, sizes: Mapping[int, int]) -> _Clique:
    own = conditional.keys()
    R = np.array(conditional.R())
    n = count = 0
    while n < R.shape[0]:
        n += sizes[own[count]]
        count += 1
    frontals, separators = tuple(own[:count]), tuple(own[count:])
    return _Clique(frontals, separators, R, np.array(conditional.S()), np.array(conditional.d()))
