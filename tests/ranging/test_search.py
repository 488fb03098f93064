"""The global search: both mirror images of a straight run, from nothing."""

from __future__ import annotations

import numpy as np
from planar import STRAIGHT, trial, true_state

from factorgraph_dvl.ranging.problem import planar_setup
from factorgraph_dvl.ranging.search import same_track, search
from factorgraph_dvl.ranging.smoother import fit


def test_a_straight_run_has_two_mirror_images_one_of_which_is_the_truth():
    t = trial(1, **STRAIGHT)
    problem = planar_setup(t).problem
    x, theta = true_state(t, problem)
    found = search(problem, 60)
    assert len(found) == 2
    truth = fit(problem, x[:60], theta)
    assert sum(same_track(problem, truth, f) for f in found) == 1
    assert not same_track(problem, *found)
    ranges = [np.hypot(*(f.p[-1] - problem.place[0, :2])) for f in found]
    np.testing.assert_allclose(ranges[0], ranges[1], atol=5.0)


def test_few_rows_give_no_start():
    problem = planar_setup(trial(1, **STRAIGHT)).problem
    assert search(problem, 5) == []
