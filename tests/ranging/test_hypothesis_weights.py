"""Costs of hypotheses: chance, turns, priors."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.ranging.hypothesis_weights import hypothesis_costs, significant_costs


def test_what_counts_as_evidence():
    rng = np.random.default_rng(0)
    base = 0.5 * rng.normal(size=1000) ** 2
    walk = [significant_costs([base, base + rng.normal(0.0, 0.5, 1000)])[1] for _ in range(200)]
    # Sums of 16 by chance are not believed.
    assert np.mean(np.abs(walk) < 3.0) > 0.95
    turn = base.copy()
    turn[:5] += 8.0
    np.testing.assert_allclose(significant_costs([base, turn]), [0.0, 40.0])
    # A current that ten standard deviations of its prior speak against, and nothing else does.
    assert hypothesis_costs([base, base], [1.0, 51.0])[1] == 50.0
