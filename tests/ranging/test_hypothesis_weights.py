"""Costs of hypotheses: chance, turns, priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from planar import STRAIGHT, trial, true_state

from factorgraph_dvl.ranging.hypothesis_weights import hypothesis_costs, significant_costs
from factorgraph_dvl.ranging.problem import planar_setup
from factorgraph_dvl.ranging.smoother import fit


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
    t = trial(1, **STRAIGHT)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    good = fit(problem, x, theta)
    bad = replace(good, theta=good.theta + 3.0)
    assert hypothesis_costs(problem, [good, bad])[1] > 50.0
