"""GTSAM's symbols."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.graph import keys


def test_no_two_variables_share_a_key():
    made = [keys.node(k) for k in range(5)] + [keys.bias(k) for k in range(5)]
    made += [keys.calibration(i, size) for i in range(5) for size in (1, 2, 3, 8)]
    made += [keys.process(i, j) for i in range(3) for j in range(5)]
    assert len(set(made)) == len(made)


def test_keys_know_what_they_are_of():
    assert (keys.letter_of(keys.node(7)), keys.index_of(keys.node(7))) == ("x", 7)
    assert (keys.letter_of(keys.bias(3)), keys.index_of(keys.bias(3))) == ("b", 3)
    assert keys.is_process(keys.process(1, 4))
    assert keys.index_of(keys.process(1, 4)) == 4
    assert not any(map(keys.is_process, (keys.node(0), keys.bias(0), keys.calibration(0, 3))))


def test_keys_of_many_nodes_are_those_of_each():
    k = np.array([0, 3, 4800])
    assert keys.nodes(k).tolist() == [keys.node(i) for i in k]
    assert keys.indices_of(keys.nodes(k)).tolist() == k.tolist()
