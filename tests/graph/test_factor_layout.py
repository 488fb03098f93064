"""Which rows of measurements go to which factors."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.graph import factor_layout as module
from factorgraph_dvl.graph.factor_layout import factor_layout

# Three measurements of two components beside two of one: at nodes 0, 0, 2 and 2, 1.
NODES = [np.array([[0], [0], [2]]), np.array([[2], [1]])]


def placed(layout, values):
    """Write the rows (M d,) of each observation into factors."""
    factors = [np.full(rows, np.nan) for rows in layout.rows]
    for parts, own in zip(layout.parts, values, strict=True):
        for part in parts:
            rows = own[part.measurements].ravel()
            for k, there, here in part.places:
                factors[k][there] = rows[here]
    return factors


def test_measurements_at_the_same_nodes_share_a_factor():
    layout = factor_layout(NODES, [2, 1])
    np.testing.assert_array_equal(layout.nodes, [[0], [1], [2]])
    assert layout.rows == [4, 1, 3]
    values = [np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.array([[7.0], [8.0]])]
    first, second, third = placed(layout, values)
    np.testing.assert_array_equal(first, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(second, [8.0])
    np.testing.assert_array_equal(third, [5.0, 6.0, 7.0])


def test_rows_are_the_same_in_parts_of_any_size(monkeypatch):
    rng = np.random.default_rng(0)
    nodes = [rng.integers(0, 9, (200, 2)), np.sort(rng.integers(0, 9, (60, 2)), axis=0)]
    values = [rng.normal(size=(200, 3)), rng.normal(size=(60, 2))]
    whole = placed(factor_layout(nodes, [3, 2]), values)
    monkeypatch.setattr(module, "CHUNK", 7)
    layout = factor_layout(nodes, [3, 2])
    assert len(layout.parts[0]) > 5
    for one, other in zip(whole, placed(layout, values), strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.isfinite(one).all()
