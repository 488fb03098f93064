"""Error budget: what each source of noise adds to a covariance."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Rows
from factorgraph_dvl.statistics.rows import product
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation


def error_budget(
    rows: Iterable[Rows],
    information: SquareRootInformation,
    functionals: Sequence[Mapping[int, Array]],
    use: Callable[[Iterator[Rows]], object] = iter,
) -> dict[str, Array]:
    """Return what each source adds to the covariance of linear functionals.

    Each row has unit noise of its own, so with X = P Wᵀ

        W P Wᵀ = sum over sources, sum over rows of (J X)ᵀ (J X):

    exact, and additive.

    Parameters
    ----------
    rows : iterable of Rows
        All rows of the graph.
    information : SquareRootInformation
        Information of the same rows.
    functionals : sequence of mapping of int to ndarray
        Each maps keys to (n, size) matrices; values add up over keys.
    use : callable, optional
        Called with the rows, one after another as they are added up, for another use of them.

    Returns
    -------
    dict of str to ndarray
        By source, (sum n, sum n); their sum is `information.covariance_of(functionals)`.
    """
    with_functionals = information.covariance_with(functionals)
    out: dict[str, Array] = {}

    def added() -> Iterator[Rows]:
        for each in rows:
            noise = product(each, with_functionals)
            part = np.einsum("mdi,mdj->ij", noise, noise, optimize=True)
            out[each.source] = out.get(each.source, 0.0) + part
            yield each

    passing = added()
    use(passing)
    deque(passing, maxlen=0)
    return out
