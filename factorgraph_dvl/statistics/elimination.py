"""Elimination of Gaussian graphs with GTSAM: by QR, by Cholesky, and part by part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import gtsam

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Parts in which variables are eliminated. Chosen: GTSAM keeps all rows that went into a
# conditional, up to 60 kB for each state, of which a tenth is needed.
_PARTS = 16
# Variables from which on there are parts. Chosen: fewer need little memory.
_MANY = 500


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


def _trees(
    gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> Iterator[gtsam.GaussianBayesTree]:
    """Return the Bayes trees of one part of the variables after another."""
    count = ordering.size()
    if count <= _MANY:
        return iter([gaussian.eliminateMultifrontal(ordering, gtsam.EliminateQR)])
    order = [ordering.at(i) for i in range(count)]
    return _in_turn(gaussian, order, -(-count // _PARTS))


def _in_turn(
    gaussian: gtsam.GaussianFactorGraph, order: Sequence[int], size: int
) -> Iterator[gtsam.GaussianBayesTree]:
    """Yield the Bayes trees of so many variables after the others, from QR.

    Each elimination looks through the factors of its own part alone, not through all that are
    left: that would take a time that grows with the square of their number.
    """
    part = {key: i // size for i, key in enumerate(order)}
    waiting = [gtsam.GaussianFactorGraph() for _ in range(-(-len(order) // size))]

    def distribute(graph: gtsam.GaussianFactorGraph) -> None:
        for i in range(graph.size()):
            factor = graph.at(i)
            own = [] if factor is None else factor.keys()
            if own:
                waiting[min(part[key] for key in own)].push_back(factor)

    distribute(gaussian)
    # Factors that nobody else holds go once they are eliminated.
    del gaussian
    for k in range(len(waiting)):
        some = keys.ordering(order[k * size : (k + 1) * size])
        tree, left = waiting[k].eliminatePartialMultifrontal(some, gtsam.EliminateQR)
        waiting[k] = gtsam.GaussianFactorGraph()
        distribute(left)
        yield tree
