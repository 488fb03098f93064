"""Leverage: how far residuals follow their own measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.statistics.rows import add_transposed_product, product
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Random vectors, at most and at least, and their numbers in all. Chosen: one pass through the
# tree costs hardly more with 32 columns than with one; a sum over n rows has a standard deviation
# below sqrt(2 n / vectors), of which few are enough where n is large.
_MOST_PROBES = 32
_LEAST_PROBES = 4
_NUMBERS = 1_000_000


def leverage(
    rows: Callable[[], Iterable[Rows]], count: int, information: SquareRootInformation
) -> Iterator[tuple[Rows, Array]]:
    """Yield rows with unbiased estimates of their leverages (M, d), for sums over many of them.

    The leverage of a row is its place on the diagonal of H = J P Jᵀ. With random signs z, z times
    H z has that expectation (Hutchinson, A stochastic estimator of the trace of the influence
    matrix, Communications in Statistics 18(3), 1989). One set of probes serves all rows: as H is
    a projection, the variance of a sum is at most twice the sum itself.

    Parameters
    ----------
    rows : callable
        Returns the rows of the graph, each time the same: it is asked twice.
    count : int
        How many numbers their vectors have.
    information : SquareRootInformation
        Information of the whole graph.
    """
    rng = np.random.default_rng(0)
    probes = int(np.clip(_NUMBERS // max(count, 1), _LEAST_PROBES, _MOST_PROBES))
    sums: dict[int, Array] = {}
    signs = []
    for each in rows():
        z = rng.choice([-1.0, 1.0], (*each.vector.shape, probes))
        signs.append(z.astype(np.int8))
        add_transposed_product(each, z, sums)
    if not sums:
        return
    with_probes = information.covariance_with([sums])
    for each, z in zip(rows(), signs, strict=True):
        yield each, np.asarray(np.mean(z * product(each, with_probes), axis=2))
