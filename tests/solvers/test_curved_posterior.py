"""The posterior along the direction that the data determine least."""

from __future__ import annotations

import numpy as np
import pytest
from planar import STRAIGHT, trial

from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.solvers.curved_posterior import _is_curved, points_along_arc
from factorgraph_dvl.solvers.planar_setup import planar_setup


def quiet(stage, iteration, cost):
    pass


def test_a_straight_run_tells_no_more_of_the_current_than_its_prior():
    t = trial(1, **STRAIGHT)
    found, *_ = solved_problems(t)
    beacon = planar_setup(t, t.frame()).rows.place[0]
    points, cost = points_along_arc(found, beacon[None], quiet)
    assert len(points) > 5
    assert cost[0] == min(cost)
    assert cost[0] == pytest.approx(found.minimum.evaluation.cost, abs=1e-3)
    share = np.exp(cost.min() - cost)
    share /= share.sum()
    every = [p.minimum.evaluation.states for p in points]
    first = np.array([s.x[0, :2] for s in every])
    # All on an arc about the beacon: its range is known, the bearing is not.
    radius = np.hypot(*(first - beacon).T)
    assert np.ptp(radius) < 0.05 * radius.mean()
    spread = np.sqrt(np.sum(share[:, None] * (first - share @ first) ** 2))
    # The ground velocity is known in size alone; across it the current has its prior, 0.3 m/s.
    x, time = every[0].x, every[0].time
    moved = np.linalg.norm(x[-1, :2] - x[0, :2]) / (time[-1] - time[0])
    assert spread == pytest.approx(radius.mean() * 0.3 / moved, rel=0.3)


def test_an_arc_counts_as_curved_by_its_height_over_the_chord():
    # 10 m along an arc of radius 100 m is 0.5 m over the chord: more than 0.3 of 1 m across.
    P = np.diag([10.0**2, 1.0])
    assert _is_curved(P, np.array([100.0, 500.0]))
    assert not _is_curved(P, np.array([200.0, 500.0]))
