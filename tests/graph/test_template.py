"""Empty Jacobian factors, to be filled in place."""

from __future__ import annotations

import gtsam
import numpy as np

from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.template import jacobian_template


def test_what_is_written_is_what_is_solved():
    variables = [keys.calibration(i, 2) for i in range(5)]
    factor = jacobian_template(variables, [2] * 5, 10)
    assert not factor.getA().any()
    A = np.random.default_rng(0).normal(size=(10, 10))
    b = np.arange(10.0)
    factor.getA()[...] = A
    factor.getb()[...] = b
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(factor)
    found = graph.optimize()
    whole = np.concatenate([found.at(key) for key in variables])
    np.testing.assert_allclose(whole, np.linalg.solve(A, b))
