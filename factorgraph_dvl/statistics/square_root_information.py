"""Covariances of any variables from the square root of an information matrix.

The Bayes tree that QR elimination leaves contains the square root R of the information
matrix clique by clique. Everything here is built from R: squaring it first would lose
the digits that navigation-grade gyros need.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtrs

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys

# Parts in which variables are eliminated. Chosen: GTSAM keeps all rows that went into a
# conditional, up to 60 kB for each state, of which a tenth is needed.
_PARTS = 16
# Joint covariances that are held at once. Chosen: some ten megabytes.
_AT_ONCE = 2048
# Variables from which on there are parts. Chosen: fewer need little memory.
_MANY = 500


@dataclass(frozen=True)
class _Clique:
    """Frontal variables F given separators S: R x_F + T x_S = d + noise of unit variance."""

    frontals: tuple[int, ...]
    separators: tuple[int, ...]
    R: Array
    T: Array
    d: Array


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
        self._sizes = sizes
        # From the leaves to the root; then the other way round.
        self._cliques: list[_Clique] = []
        for tree in trees:
            self._cliques += reversed(_cliques_of(tree, sizes))
        self._cliques.reverse()
        self._indices: dict[tuple[tuple[int, int], ...], Array] = {}

    @cached_property
    def _place(self) -> dict[int, int]:
        """Number of the clique in which each variable is frontal."""
        return {key: i for i, clique in enumerate(self._cliques) for key in clique.frontals}

    @cached_property
    def _parents(self) -> list[int]:
        """Number of each clique's parent, -1 where there is none."""
        # That of the separator that was eliminated first: it has all the others.
        return [
            max((self._place.get(key, -1) for key in c.separators), default=-1)
            for c in self._cliques
        ]

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the information."""
        return 2.0 * sum(float(np.log(np.abs(np.diag(c.R))).sum()) for c in self._cliques)

    @property
    def decrease(self) -> float:
        """Half the sum of squares that the minimum takes off that of the right-hand side."""
        return 0.5 * sum(float(clique.d @ clique.d) for clique in self._cliques)

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
        known = frozenset(known)
        cliques = []
        for clique in self._cliques:
            kept = [key not in known for key in clique.separators]
            frontals, R, d = clique.frontals, clique.R, clique.d
            if not known.isdisjoint(frontals):
                # The last clique may have some of both, of which the known ones come last.
                frontals = tuple(key for key in frontals if key not in known)
                if any(kept) or frontals != clique.frontals[: len(frontals)]:
                    raise ValueError("the known variables must be eliminated after all others")
                if not frontals:
                    continue
                n = sum(self._sizes[key] for key in frontals)
                R, d = R[:n, :n], d[:n]
            columns = np.repeat(np.array(kept, bool), [self._sizes[k] for k in clique.separators])
            separators = tuple(compress(clique.separators, kept))
            cliques.append(_Clique(frontals, separators, R, clique.T[: d.size, columns], d))
        out = SquareRootInformation([], self._sizes)
        out._cliques = cliques
        return out

    def solution(self) -> gtsam.VectorValues:
        """Return the minimum of the graph."""
        found: dict[int, Array] = {}
        out = gtsam.VectorValues()
        for clique in self._cliques:
            d = clique.d
            if clique.separators:
                d = d - clique.T @ np.concatenate([found[key] for key in clique.separators])
            x = _solve(clique.R, d, transposed=False)
            row = 0
            for key in clique.frontals:
                found[key] = x[row : row + self._sizes[key]]
                out.insert(key, found[key])
                row += self._sizes[key]
        return out

    def covariance_with(self, functionals: Sequence[Mapping[int, Array]]) -> dict[int, Array]:
        """Return the covariance of every variable with linear functionals of all.

        P Wᵀ = R⁻¹ R⁻ᵀ Wᵀ: from the leaves to the root, and back.

        Parameters
        ----------
        functionals : sequence of mapping of int to ndarray
            Each maps keys to (n, size) matrices; values add up over keys.

        Returns
        -------
        dict of int to ndarray
            Keys to (size, sum n) matrices.
        """
        out: dict[int, Array] = {}
        halfway = dict(self._halfway(functionals))
        width = sum(next(iter(f.values())).shape[0] for f in functionals)
        for index, clique in enumerate(self._cliques):
            z = halfway.get(index)
            if z is None:
                z = np.zeros((clique.R.shape[0], width))
            if clique.separators:
                z = z - clique.T @ np.concatenate([out[key] for key in clique.separators])
            x = _solve(clique.R, z, transposed=False)
            row = 0
            for key in clique.frontals:
                out[key] = x[row : row + self._sizes[key]]
                row += self._sizes[key]
        return out

    def following(self, known: Mapping[int, Array]) -> dict[int, Array]:
        """Return how every variable follows others, on which the trees depend.

        Parameters
        ----------
        known : mapping of int to ndarray
            How the others follow n components, (size, n) by key.
        """
        out: dict[int, Array] = {}
        for clique in self._cliques:
            above = np.concatenate(
                [out[key] if key in out else known[key] for key in clique.separators]
            )
            x = _solve(clique.R, -clique.T @ above, transposed=False)
            row = 0
            for key in clique.frontals:
                out[key] = x[row : row + self._sizes[key]]
                row += self._sizes[key]
        return out

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
        if not functionals:
            return np.zeros((0, 0))
        z = np.concatenate([rows for _, rows in self._halfway(functionals)])
        return np.asarray(z.T @ z)

    def _halfway(self, functionals: Sequence[Mapping[int, Array]]) -> Iterator[tuple[int, Array]]:
        """Yield numbers of cliques, from the leaves to the root, and the rows of z with Rᵀ z = Wᵀ.

        Cliques whose rows are zero are left out.
        """
        widths = [next(iter(f.values())).shape[0] for f in functionals]
        edges = np.cumsum([0, *widths])
        total = int(edges[-1])
        pending: dict[int, Array] = {}
        for functional, first, last in zip(functionals, edges, edges[1:], strict=False):
            for key, matrix in functional.items():
                block = pending.setdefault(key, np.zeros((self._sizes[key], total)))
                block[:, first:last] += matrix.T
        for index in reversed(range(len(self._cliques))):
            clique = self._cliques[index]
            if pending.keys().isdisjoint(clique.frontals):
                continue
            w = np.concatenate(
                [pending.pop(key, np.zeros((self._sizes[key], total))) for key in clique.frontals]
            )
            z = _solve(clique.R, w, transposed=True)
            yield index, z
            passed = -clique.T.T @ z
            row = 0
            for key in clique.separators:
                size = self._sizes[key]
                pending[key] = pending.get(key, 0.0) + passed[row : row + size]
                row += size

    def marginals(self, wanted: Sequence[int]) -> dict[int, Array]:
        """Return the marginal covariances of variables by key.

        From the root down, each clique's joint covariance follows from that of its
        separators: P_FS = -R⁻¹ T P_SS, P_FF = R⁻¹R⁻ᵀ - P_FS (R⁻¹ T)ᵀ.
        """
        left = set(wanted)
        out: dict[int, Array] = {}
        for clique, place, P in self._joint():
            for key in clique.frontals:
                if key in left:
                    own = slice(place[key], place[key] + self._sizes[key])
                    block = P[own, own]
                    out[key] = 0.5 * (block + block.T)
        return out

    def joint_covariances(self, groups: Sequence[tuple[int, ...]]) -> list[Array]:
        """Return the joint covariances of groups of variables that a factor ties together.

        Such variables share a clique: that of the one that was eliminated first.
        """
        out: list[Array] = [np.empty((0, 0))] * len(groups)
        for numbers, found in self.joint_in_parts(groups):
            for i, P in zip(numbers.tolist(), found, strict=True):
                out[i] = P
        return out

    def joint_in_parts(
        self, groups: Sequence[tuple[int, ...]]
    ) -> Iterator[tuple[IntArray, Array]]:
        """Yield numbers (B,) of groups and their `joint_covariances` (B, n, n), some at a time."""
        wanted: dict[int, list[int]] = {}
        for i, group in enumerate(groups):
            wanted.setdefault(max(self._place[key] for key in group), []).append(i)
        # Of cliques that look alike: numbers of groups, covariances of cliques, and components.
        alike: dict[tuple[int, int], tuple[list[int], list[Array], Array]] = {}
        count = 0
        for index, (_, place, P) in enumerate(self._joint()):
            for i in wanted.get(index, ()):
                rows = self._components(place, groups[i])
                kind = len(P), id(rows)
                if kind not in alike:
                    alike[kind] = [], [], rows
                numbers, cliques, _ = alike[kind]
                numbers.append(i)
                cliques.append(P)
                count += 1
            if count >= _AT_ONCE:
                yield from map(_selected, alike.values())
                alike, count = {}, 0
        yield from map(_selected, alike.values())

    def _components(self, place: Mapping[int, int], keys_: tuple[int, ...]) -> Array:
        """Return the components of variables among those of a clique: alike in most cliques."""
        shape = tuple((place[key], self._sizes[key]) for key in keys_)
        found = self._indices.get(shape)
        if found is None:
            found = np.concatenate([np.arange(start, start + size) for start, size in shape])
            self._indices[shape] = found
        return found

    def _joint(self) -> Iterator[tuple[_Clique, dict[int, int], Array]]:
        """Yield each clique, where its variables begin, and their joint covariance."""
        # Of cliques whose children are still to come.
        joint: dict[int, tuple[dict[int, int], Array]] = {}
        children = [0] * len(self._cliques)
        for parent in self._parents:
            if parent >= 0:
                children[parent] += 1
        for index, (clique, parent) in enumerate(zip(self._cliques, self._parents, strict=True)):
            f = clique.R.shape[0]
            identity = np.eye(f)
            solved = _solve(clique.R, np.hstack([identity, clique.T]), transposed=False)
            inverse, gain = solved[:, :f], solved[:, f:]
            s = clique.T.shape[1]
            P = np.empty((f + s, f + s))
            if s:
                where, above = joint[parent]
                rows = self._components(where, clique.separators)
                P_SS = above[rows[:, None], rows]
                P_FS = -gain @ P_SS
                # An asymmetry would double from one clique to the next where biases walk far.
                P_FF = inverse @ inverse.T - P_FS @ gain.T
                P[:f, :f] = 0.5 * (P_FF + P_FF.T)
                P[:f, f:], P[f:, :f], P[f:, f:] = P_FS, P_FS.T, P_SS
            else:
                P[:] = inverse @ inverse.T
            place: dict[int, int] = {}
            row = 0
            for key in (*clique.frontals, *clique.separators):
                place[key] = row
                row += self._sizes[key]
            if children[index]:
                joint[index] = place, P
            if parent >= 0:
                children[parent] -= 1
                if not children[parent]:
                    del joint[parent]
            yield clique, place, P


def _selected(some: tuple[list[int], list[Array], Array]) -> tuple[IntArray, Array]:
    """Return numbers, and components of the covariances of cliques that look alike."""
    numbers, cliques, rows = some
    return np.array(numbers), np.stack(cliques)[:, rows[:, None], rows]


def eliminated(
    gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, sizes: Mapping[int, int]
) -> SquareRootInformation:
    """Return the square-root information of a graph from QR.

    QR does not square the condition of the problem.

    Parameters
    ----------
    gaussian : gtsam.GaussianFactorGraph
        All factors.
    ordering : gtsam.Ordering
        All variables in the order of elimination.
    sizes : mapping of int to int
        Dimension of every variable by key.
    """
    trees = _trees(gaussian, ordering)
    # Factors that nobody else holds go once they are eliminated.
    del gaussian
    return SquareRootInformation(trees, sizes)


def cholesky(
    gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.GaussianBayesTree | gtsam.GaussianBayesNet | None:
    """Return what Cholesky's factorisation leaves, None where it has no digits.

    GTSAM refuses some cliques of several variables of different units, whose factors have all
    digits: then it takes one variable after another.

    Parameters
    ----------
    gaussian : gtsam.GaussianFactorGraph
        All factors.
    ordering : gtsam.Ordering
        All variables in the order of elimination.
    """
    for eliminate in (gaussian.eliminateMultifrontal, gaussian.eliminateSequential):
        try:
            return eliminate(ordering)
        except RuntimeError:
            continue
    return None


def error_of_variance(
    gaussian: gtsam.GaussianFactorGraph,
    information: SquareRootInformation,
    functional: Mapping[int, Array],
) -> float:
    """Return the relative error of a variance by rounding, to first order.

    With w the functional, x = P wᵀ from the factorisation and H the information from the factors,
    the exact variance is w x - xᵀ (H x - wᵀ), to first order in H x - wᵀ (iterative refinement:
    Golub and Van Loan, Matrix Computations, 4th ed., section 3.5.3).

    Parameters
    ----------
    gaussian : gtsam.GaussianFactorGraph
        All factors.
    information : SquareRootInformation
        Their factorisation.
    functional : mapping of int to ndarray
        The functional w, (1, size) by key.
    """
    x = gtsam.VectorValues()
    for key, column in information.covariance_with([functional]).items():
        x.insert(key, column[:, 0])
    missing = gaussian.gradient(x).subtract(gaussian.gradientAtZero())
    along = {key: float(w[0] @ x.at(key)) for key, w in functional.items()}
    variance = sum(along.values())
    return abs(x.dot(missing) - variance) / variance


def eliminated_in_turn(
    gaussian: gtsam.GaussianFactorGraph, order: Sequence[int], size: int
) -> Iterator[tuple[gtsam.GaussianBayesTree, gtsam.GaussianFactorGraph]]:
    """Yield the Bayes trees of one part of some variables after another, from QR.

    Each elimination looks through the factors of its own part alone, not through all that are
    left: that would take a time that grows with the square of their number.

    Parameters
    ----------
    gaussian : gtsam.GaussianFactorGraph
        All factors.
    order : sequence of int
        Keys of the variables in the order of elimination.
    size : int
        Number of variables of a part.

    Yields
    ------
    tree : gtsam.GaussianBayesTree
        What the elimination of a part leaves.
    left : gtsam.GaussianFactorGraph
        Factors without any of these variables: after the last part, all that are left.
    """
    part = {key: i // size for i, key in enumerate(order)}
    count = -(-len(order) // size)
    waiting = [gtsam.GaussianFactorGraph() for _ in range(count + 1)]

    def distribute(graph: gtsam.GaussianFactorGraph) -> None:
        for i in range(graph.size()):
            factor = graph.at(i)
            if factor is not None:
                own = factor.keys()
                first = min((part.get(key, count) for key in own), default=count)
                waiting[first].push_back(factor)

    distribute(gaussian)
    # Factors that nobody else holds go once they are eliminated.
    del gaussian
    for k in range(count):
        some = keys.ordering(order[k * size : (k + 1) * size])
        tree, left = waiting[k].eliminatePartialMultifrontal(some, gtsam.EliminateQR)
        waiting[k] = gtsam.GaussianFactorGraph()
        distribute(left)
        yield tree, waiting[count]


def _trees(
    gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> Iterator[gtsam.GaussianBayesTree]:
    """Return the Bayes trees of one part of the variables after another."""
    count = ordering.size()
    if count <= _MANY:
        return iter([gaussian.eliminateMultifrontal(ordering, gtsam.EliminateQR)])
    order = [ordering.at(i) for i in range(count)]
    return (tree for tree, _ in eliminated_in_turn(gaussian, order, -(-count // _PARTS)))


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


def _solve(R: Array, rhs: Array, *, transposed: bool) -> Array:
    solution, info = dtrtrs(R, rhs, trans=int(transposed))
    if info != 0:
        raise np.linalg.LinAlgError("the square root of the information matrix is singular")
    return np.asarray(solution)
