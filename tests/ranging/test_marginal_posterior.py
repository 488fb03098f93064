"""The posterior along the direction that the data determine least."""

from __future__ import annotations

import numpy as np
import pytest
from planar import STRAIGHT, trial, true_state

from factorgraph_dvl.ranging.marginal_posterior import grid_points, posterior_weights
from factorgraph_dvl.ranging.problem import planar_setup
from factorgraph_dvl.ranging.smoother import fit


def test_a_straight_run_tells_no_more_of_the_current_than_its_prior():
    t = trial(1, **STRAIGHT)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    best = fit(problem, x, theta, iterations=100)
    grid = grid_points(problem, best)
    assert len(grid) > 5
    share = posterior_weights(grid)
    first = np.array([s.fit.p[0] for s in grid])
    beacon = problem.place[0, :2]
    # All on an arc about the beacon: its range is known, the bearing is not.
    radius = np.hypot(*(first - beacon).T)
    assert np.ptp(radius) < 0.05 * radius.mean()
    spread = np.sqrt(np.sum(share[:, None] * (first - share @ first) ** 2))
    # The ground velocity is known in size alone; across it the current has its prior, 0.3 m/s.
    moved = np.linalg.norm(x[-1, :2] - x[0, :2]) / (problem.time[-1] - problem.time[0])
    assert spread == pytest.approx(radius.mean() * 0.3 / moved, rel=0.3)
