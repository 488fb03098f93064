"""Normal equations of a chain: block-tridiagonal in its nodes, with constants as a border."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from factorgraph_dvl.geometry.block_tridiagonal import banded, inverse_blocks
from factorgraph_dvl.geometry.vectors import Array

# Nodes whose rows are multiplied at once. Measured: a few MB stay in the cache, and take half to
# two thirds of the time of 50 MB.
_CHUNK = 256


@dataclass(eq=False)
class NormalEquations:
    """Information on K nodes of n states and c constants, and a gradient.

    Parameters
    ----------
    nodes : int
        Number K of nodes.
    size : int
        Number n of states of a node.
    constants : int
        Number c of constants.

    Attributes
    ----------
    diagonal, off : ndarray, shape (K, n, n) or (K - 1, n, n)
        Information on each node, and between a node and the next.
    border, corner : ndarray, shape (K, n, c) or (c, c)
        Information between nodes and constants, and on the constants.
    node_gradient, constant_gradient : ndarray, shape (K, n) or (c,)
        Of the cost.
    """

    nodes: int
    size: int
    constants: int

    def __post_init__(self) -> None:
        k, n, c = self.nodes, self.size, self.constants
        self.diagonal, self.off = np.zeros((k, n, n)), np.zeros((k - 1, n, n))
        self.border, self.corner = np.zeros((k, n, c)), np.zeros((c, c))
        self.node_gradient, self.constant_gradient = np.zeros((k, n)), np.zeros(c)

    def add(
        self, node: np.ndarray, before: Array, after: Array, constants: Array, residual: Array
    ) -> None:
        """Add rows of unit noise.

        Parameters
        ----------
        node : ndarray of int, shape (M,)
            Nodes before the rows.
        before, after : ndarray, shape (M, d, n)
            Derivatives with respect to that node and the next.
        constants : ndarray, shape (M, d, c)
            Derivatives with respect to the constants.
        residual : ndarray, shape (M, d)
            Residuals.
        """
        n = self.size
        columns = (before, after, constants, residual[:, :, None])
        own, following = slice(0, n), slice(n, 2 * n)
        shared, last = slice(2 * n, 2 * n + self.constants), 2 * n + self.constants
        for at, rows in rows_by_node(node):
            stacked = np.concatenate(_of_nodes(columns, rows), axis=2)
            product = stacked.transpose(0, 2, 1) @ stacked
            self.diagonal[at] += product[:, own, own]
            self.diagonal[at + 1] += product[:, following, following]
            self.off[at] += product[:, own, following]
            self.border[at] += product[:, own, shared]
            self.border[at + 1] += product[:, following, shared]
            self.node_gradient[at] += product[:, own, last]
            self.node_gradient[at + 1] += product[:, following, last]
        flat = constants.reshape(-1, self.constants)
        self.corner += flat.T @ flat
        self.constant_gradient += flat.T @ residual.ravel()

    def add_steps(self, before: Array, after: Array, residual: Array) -> None:
        """Add rows of unit noise between each node and the next, (K - 1, d, n) and (K - 1, d)."""
        before_t, after_t = before.transpose(0, 2, 1), after.transpose(0, 2, 1)
        self.diagonal[:-1] += before_t @ before
        self.diagonal[1:] += after_t @ after
        self.off += before_t @ after
        self.node_gradient[:-1] += (before_t @ residual[:, :, None])[:, :, 0]
        self.node_gradient[1:] += (after_t @ residual[:, :, None])[:, :, 0]

    def copy(self) -> NormalEquations:
        """Return equal equations, to which rows may be added."""
        return self.scaled(np.ones(self.size))

    def scaled(self, scale: Array) -> NormalEquations:
        """Return the equations of states (K, n) / scale (n,)."""
        out = NormalEquations(self.nodes, self.size, self.constants)
        squares = np.outer(scale, scale)
        out.diagonal, out.off = self.diagonal * squares, self.off * squares
        out.border, out.corner = self.border * scale[:, None], self.corner.copy()
        out.node_gradient = self.node_gradient * scale
        out.constant_gradient = self.constant_gradient.copy()
        return out

    def without_first(self, count: int) -> NormalEquations:
        """Return the equations of the other nodes and the constants, the first nodes eliminated.

        Parameters
        ----------
        count : int
            Number of nodes to eliminate, less than all.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the information on these nodes is not positive definite.
        """
        if not count:
            return self
        n = self.size
        following = np.zeros((count, n, n))
        following[-1] = self.off[count - 1]
        right = np.concatenate(
            [following, self.border[:count], self.node_gradient[:count, :, None]], axis=2
        )
        width = right.shape[2]
        factor = cholesky_banded(
            banded(self.diagonal[:count], self.off[: count - 1]), check_finite=False
        )
        right = right.reshape(count * n, width)
        solved = cho_solve_banded((factor, False), right, check_finite=False)
        lost = right[:, :-1].T @ solved
        out = NormalEquations(self.nodes - count, n, self.constants)
        for name in ("diagonal", "off", "border", "node_gradient"):
            setattr(out, name, getattr(self, name)[count:].copy())
        out.diagonal[0] -= lost[:n, :n]
        out.border[0] -= lost[:n, n:-1]
        out.node_gradient[0] -= lost[:n, -1]
        out.corner = self.corner - lost[n:, n:-1]
        out.constant_gradient = self.constant_gradient - lost[n:, -1]
        return out

    def first_alone(self) -> NormalEquations:
        """Return the equations of the first node and the constants, those of others dropped."""
        out = NormalEquations(1, self.size, self.constants)
        for name in ("diagonal", "border", "node_gradient"):
            setattr(out, name, getattr(self, name)[:1].copy())
        out.corner, out.constant_gradient = self.corner.copy(), self.constant_gradient.copy()
        return out

    def factorise(self) -> Factorisation:
        """Return the Cholesky factorisation.

        Raises
        ------
        numpy.linalg.LinAlgError
            If the information is not positive definite.
        """
        return Factorisation(self)


class Factorisation:
    """Cholesky factorisation of normal equations.

    Parameters
    ----------
    equations : NormalEquations
        What is factorised.

    Attributes
    ----------
    constants : ndarray, shape (c, c)
        Covariance of the constants.
    decrease : float
        Of the cost by the Gauss-Newton step, if residuals are linear.
    """

    def __init__(self, equations: NormalEquations) -> None:
        k, n, c = equations.nodes, equations.size, equations.constants
        self._equations = equations
        self._factor = cholesky_banded(
            banded(equations.diagonal, equations.off), check_finite=False
        )
        right = np.concatenate([equations.border, equations.node_gradient[:, :, None]], axis=2)
        # With A = Uᵀ U: U⁻ᵀ times the border and the gradient, (K n, c + 1).
        self._forward = self._substituted(right.reshape(k * n, c + 1), "T")
        square = self._forward.T @ self._forward
        self._root = np.linalg.cholesky(equations.corner - square[:c, :c])
        inverse = np.linalg.inv(self._root)
        self.constants = np.asarray(inverse.T @ inverse)
        # Gradient by the constants where the nodes follow them.
        self._constant_gradient = equations.constant_gradient - square[:c, c]
        whitened = inverse @ self._constant_gradient
        self.decrease = 0.5 * float(square[c, c] + whitened @ whitened)

    def _substituted(self, right: Array, transposed: str) -> Array:
        """Return U⁻¹ or, by "T", U⁻ᵀ times right-hand sides (K n, m)."""
        out, info = dtbtrs(self._factor, right, trans=transposed)
        if info:
            raise np.linalg.LinAlgError(f"element {info} of the diagonal is zero")
        return np.asarray(out)

    @cached_property
    def influence(self) -> Array:
        """A⁻¹ B, (K, n, c), with A the information on the nodes and B the border."""
        border = self._equations.border
        c = border.shape[2]
        return self._substituted(self._forward[:, :c], "N").reshape(border.shape)

    def solve_nodes(self, right: Array) -> Array:
        """Return A⁻¹ times right-hand sides (K, n, m), the constants exact."""
        k, n = right.shape[:2]
        out = cho_solve_banded((self._factor, False), right.reshape(k * n, -1), check_finite=False)
        return np.asarray(out.reshape(right.shape))

    def covariance_with(self, nodes: Array, constants: Array) -> tuple[Array, Array]:
        """Return covariances with sums of states and constants, (K, n, m) and (c, m).

        Parameters
        ----------
        nodes : ndarray, shape (K, n, m)
            Weights of the states in the sums.
        constants : ndarray, shape (c, m)
            Weights of the constants.
        """
        through = np.einsum("kic,kim->cm", self.influence, nodes)
        of_constants = self.constants @ (constants - through)
        return self.solve_nodes(nodes) - self.influence @ of_constants, of_constants

    def step(self) -> tuple[Array, Array]:
        """Return the Gauss-Newton step of nodes (K, n) and constants (c,)."""
        constants = -self.constants @ self._constant_gradient
        return self.node_step() - self.influence @ constants, constants

    def node_step(self) -> Array:
        """Return the Gauss-Newton step of the nodes (K, n), the constants exact."""
        shape = self._equations.node_gradient.shape
        return -self._substituted(self._forward[:, -1:], "N").reshape(shape)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the information."""
        return 2.0 * float(np.sum(np.log(self._factor[-1])) + np.sum(np.log(np.diag(self._root))))

    def covariances(self) -> Covariances:
        """Return the covariances of neighbouring nodes and of the constants."""
        own, across = inverse_blocks(self._factor, self.influence.shape[1])
        shared = self.influence @ self.constants
        return Covariances(
            nodes=own + shared @ self.influence.transpose(0, 2, 1),
            across=across + shared[:-1] @ self.influence[1:].transpose(0, 2, 1),
            with_constants=-shared,
            constants=self.constants,
        )


@dataclass(frozen=True)
class Covariances:
    """Covariances of a chain and its constants.

    Parameters
    ----------
    nodes : ndarray, shape (K, n, n)
        Of each node.
    across : ndarray, shape (K - 1, n, n)
        Of a node with the next.
    with_constants : ndarray, shape (K, n, c)
        Of each node with the constants.
    constants : ndarray, shape (c, c)
        Of the constants.
    """

    nodes: Array
    across: Array
    with_constants: Array
    constants: Array

    def given_constants(self) -> Covariances:
        """Return those of the nodes where the constants are exact."""
        k, n, _ = self.with_constants.shape
        gain = self.with_constants @ np.linalg.inv(self.constants)
        by_constants = self.with_constants.transpose(0, 2, 1)
        return Covariances(
            nodes=self.nodes - gain @ by_constants,
            across=self.across - gain[:-1] @ by_constants[1:],
            with_constants=np.zeros((k, n, 0)),
            constants=np.zeros((0, 0)),
        )

    def variance(self, node: np.ndarray, before: Array, after: Array, constants: Array) -> Array:
        """Return the variances (M, d) of rows by nodes (M,), the next ones and the constants.

        Parameters
        ----------
        node : ndarray of int, shape (M,)
            Nodes before the rows.
        before, after, constants : ndarray, shape (M, d, n) or (M, d, c)
            Rows.
        """
        out = np.empty(before.shape[:2])
        for at, rows in rows_by_node(node):
            b, a, c = _of_nodes((before, after, constants), rows)
            shared = b @ self.with_constants[at] + a @ self.with_constants[at + 1]
            own = b @ self.nodes[at] + 2.0 * (a @ self.across[at].transpose(0, 2, 1))
            found = np.sum(own * b, axis=2) + np.sum((a @ self.nodes[at + 1]) * a, axis=2)
            found += np.sum((2.0 * shared + c @ self.constants) * c, axis=2)
            out[rows] = found.reshape(*rows.shape, -1)
        return out

    def with_states(
        self, node: np.ndarray, before: Array, after: Array, place: slice
    ) -> tuple[Array, Array]:
        """Return covariances (M, d, p) of rows with p states of nodes (M,), and of the next.

        The rows depend on no constant.
        """
        across = self.across[node]
        return (
            before @ self.nodes[node][:, :, place] + after @ across[:, place].transpose(0, 2, 1),
            before @ across[:, :, place] + after @ self.nodes[node + 1][:, :, place],
        )

    def around(self, node: np.ndarray) -> Array:
        """Return the covariance of nodes (M,), the next ones and the constants, side by side."""
        n, c = self.nodes.shape[1], self.constants.shape[0]
        out = np.empty((node.size, 2 * n + c, 2 * n + c))
        first, second, last = slice(0, n), slice(n, 2 * n), slice(2 * n, None)
        across = self.across[node]
        out[:, first, first], out[:, second, second] = self.nodes[node], self.nodes[node + 1]
        out[:, first, second], out[:, second, first] = across, across.transpose(0, 2, 1)
        for rows, shared in (
            (first, self.with_constants[node]),
            (second, self.with_constants[node + 1]),
        ):
            out[:, rows, last], out[:, last, rows] = shared, shared.transpose(0, 2, 1)
        out[:, last, last] = self.constants
        return out


def _of_nodes(columns: Iterable[Array], rows: np.ndarray) -> list[Array]:
    """Return the rows (G, count d, n) of nodes from columns (M, d, n) by rows (G, count)."""
    return [each[rows].reshape(len(rows), -1, each.shape[2]) for each in columns]


def rows_by_node(node: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield nodes (G,) that equally many of some rows follow, and these rows, (G, count).

    Parameters
    ----------
    node : ndarray of int, shape (M,)
        Node before each row.
    """
    order = np.argsort(node, kind="stable")
    used, starts, counts = np.unique(node[order], return_index=True, return_counts=True)
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        for a in range(0, alike.size, _CHUNK):
            at = alike[a : a + _CHUNK]
            yield used[at], order[starts[at][:, None] + np.arange(count)]
