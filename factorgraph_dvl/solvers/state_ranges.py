"""States of a problem eliminated range by range: the rows of one range are there at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.problem import Evaluation, Problem, Rows
from factorgraph_dvl.statistics.elimination import eliminated, eliminated_in_turn
from factorgraph_dvl.statistics.rows import rows_by_source, rows_with_times
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Segments of a range at most. Chosen: those of an hour and a half; where many parameters are free,
# rows of 15,000 take 0.4 GB.
_LONGEST = 5_000
# States that are eliminated at once. Chosen: GTSAM keeps all rows that went into them.
_AT_ONCE = 500

# Returns the part of a problem for some segments, evaluated where it is; for None the whole.
Part = Callable[[slice | None], tuple[Problem, Evaluation]]


@dataclass(frozen=True)
class StateRanges:
    """A problem whose states were eliminated range by range.

    Parameters
    ----------
    part : callable
        Returns the part of the problem for some segments.
    chain : Chain
        Chain of the whole problem.
    blocks : sequence of slice or None
        Segments of each range; None for all of them.
    before : sequence of gtsam.GaussianFactorGraph
        What the ranges before each one leave.
    names : dict of str to int
        Keys of the parameters.
    information : SquareRootInformation
        Information on what all states share, the states eliminated.
    """

    part: Part
    chain: Chain
    blocks: Sequence[slice | None]
    before: Sequence[gtsam.GaussianFactorGraph]
    names: Mapping[str, int]
    information: SquareRootInformation

    def rows(
        self, shared: Mapping[int, Array]
    ) -> Iterator[tuple[Iterator[tuple[Rows, Array]], dict[int, Array]]]:
        """Yield rows with their times, and how their variables follow some components.

        Range by range, the last one first, which makes each range anew.

        Parameters
        ----------
        shared : dict of int to ndarray
            How each variable that all states share follows n components, (size, n) by key.
        """
        known = dict(shared)
        for block, left in zip(reversed(self.blocks), reversed(self.before), strict=True):
            problem, at = self.part(block)
            nodes = self.chain.nodes_of(block) if block else None
            trees = [tree for tree, _ in _eliminations(problem, at, nodes, left)]
            own = SquareRootInformation(trees, at.values.dims()).following(known)
            # Priors of what all states share belong to the first range.
            yield (
                (
                    each
                    for each in rows_with_times(problem, rows_by_source(problem, at))
                    if not (
                        block and block.start and shared.keys() >= set(each[0].keys[0].tolist())
                    )
                ),
                known | dict(own),
            )
            # The range before depends on the first of these nodes.
            known = dict(shared) | dict(own)


def eliminated_by_ranges(part: Part, chain: Chain, *, whole: bool = False) -> StateRanges:
    """Return a problem whose states are eliminated range by range.

    Parameters
    ----------
    part : callable
        Returns the part of the problem for some segments, evaluated where it is; for None the
        whole problem. Parts differ in their measurements and factors only.
    chain : Chain
        Chain of the whole problem.
    whole : bool, default False
        Whether there is one range only, however long the chain is.
    """
    count = chain.count
    edges = np.linspace(0, count, (1 if whole else -(-count // _LONGEST)) + 1).astype(int)
    blocks: list[slice | None] = [slice(a, b) for a, b in pairwise(edges.tolist())]
    if len(blocks) == 1:
        blocks = [None]
    before = []
    left = gtsam.GaussianFactorGraph()
    for block in blocks:
        before.append(left)
        problem, at = part(block)
        nodes = chain.nodes_of(block) if block else None
        ((_, left),) = deque(_eliminations(problem, at, nodes, left), maxlen=1)
    names = {p.name: problem.key(p.name) for p in problem.parameters}
    sizes = at.values.dims()
    shared = {key: int(sizes[key]) for key in _shared(problem)}
    information = eliminated(left, keys.ordering(shared), shared)
    return StateRanges(part, chain, blocks, before, names, information)


def _eliminations(
    problem: Problem, at: Evaluation, nodes: range | None, before: gtsam.GaussianFactorGraph
) -> Iterator[tuple[gtsam.GaussianBayesTree, gtsam.GaussianFactorGraph]]:
    """Return the eliminations of the states of a range, each with the graph that it leaves.

    Beside the factors of the range are those that the ranges before leave.
    """
    gaussian, graph = problem.linearize(at), gtsam.GaussianFactorGraph()
    for i in range(before.size()):
        graph.push_back(before.at(i))
    # Priors of what all states share count once.
    priors = range(problem.chain.graph.size(), problem.graph.size())
    for i in range(gaussian.size()):
        if not (nodes and nodes[0] and i in priors):
            graph.push_back(gaussian.at(i))
    # Nothing else holds the factors then, so that each goes once it is eliminated.
    del gaussian
    problem.release()
    ordering, shared = problem.ordering(), set(_shared(problem))
    every = (ordering.at(i) for i in range(ordering.size()))
    order = [key for key in every if key not in shared]
    if nodes:
        own = set(problem.chain.keys_of(nodes))
        order = [key for key in order if key in own]
    return eliminated_in_turn(graph, order, _AT_ONCE)


def _shared(problem: Problem) -> list[int]:
    """Return the keys of what all states share."""
    return [*problem.chain.constants, *(problem.key(p.name) for p in problem.parameters)]
