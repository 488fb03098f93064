"""Order of elimination: what lies at the middle of a trial goes last, and so on in each half."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.graph.elimination_order import Spans, elimination_order

CUTS = np.arange(7.0)


def test_nodes_go_in_the_order_of_nested_dissection():
    nodes = Spans([[k] for k in range(7)], CUTS)
    assert elimination_order(CUTS, [nodes]) == [0, 2, 1, 4, 6, 5, 3]


def test_what_spans_a_node_goes_with_it_and_variables_of_a_node_stay_together():
    nodes = Spans([[k, 10 + k] for k in range(7)], CUTS)
    # The second and the third span node 3, the first node 1.
    process = Spans([[20], [21], [22]], np.array([0.5, 2.5, 4.5]))
    order = elimination_order(CUTS, [nodes, process])
    assert order == [0, 10, 2, 12, 1, 11, 20, 4, 14, 6, 16, 5, 15, 3, 13, 21, 22]


def test_what_lies_between_two_nodes_goes_first_in_the_order_of_time():
    fine = Spans([[k] for k in range(3)], np.array([2.2, 2.5, 2.8]))
    nodes = Spans([[10 + k] for k in range(7)], CUTS)
    order = elimination_order(CUTS, [nodes, fine])
    # The spans of the outer ones reach to the ends of the record.
    assert order == [10, 1, 12, 11, 0, 14, 16, 15, 13, 2]


@pytest.mark.parametrize("late", [0.3, -1.6])
def test_variables_that_are_late_separate_both_sides_too(late):
    """A measurement depends on nodes around it, and on others around a later time."""
    rng = np.random.default_rng(0)
    cuts = np.cumsum(rng.uniform(0.5, 1.5, 40))
    nodes, turns = range(40), range(100, 140)
    order = elimination_order(
        cuts, [Spans([[k] for k in nodes], cuts), Spans([[k] for k in turns], cuts + late)]
    )
    place = {key: i for i, key in enumerate(order)}
    neighbours = {key: set() for key in order}
    for t in np.linspace(cuts[0], cuts[-1], 2000):
        k = int(np.clip(np.searchsorted(cuts, t, "right") - 1, 0, 38))
        j = int(np.clip(np.searchsorted(cuts + late, t, "right") - 1, 0, 38))
        tied = [k, k + 1, 100 + j, 101 + j]
        for key in tied:
            neighbours[key].update(tied)
    # Elimination: what depends on a variable depends on each other then.
    depth = dict.fromkeys(order, 0)
    for key in order:
        later = [other for other in neighbours[key] if place[other] > place[key]]
        for other in later:
            neighbours[other].update(later)
            depth[other] = max(depth[other], depth[key] + 1)
    # Six levels of nodes, each with the two turns whose spans have the cut.
    assert max(depth.values()) < 3 * 6
