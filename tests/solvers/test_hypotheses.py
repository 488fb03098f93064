"""Mirror images: both live on a straight run, one dies in a turn."""

from __future__ import annotations

import numpy as np
import pytest
from findings import of_code
from planar import STRAIGHT, error_of, trial, truth

from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.solvers.batch import solve


@pytest.mark.slow
def test_a_straight_run_leaves_both_mirror_images_and_admits_to_it():
    t = trial(1, **STRAIGHT)
    solution = solve(t, rate_hz=1.0)
    living = [h for h in solution.hypotheses if h.died is None]
    assert len(living) == 2
    assert sum(h.weight for h in living) == pytest.approx(1.0)
    assert living[1].weight > 0.02
    assert of_code(solution.findings, Code.AMBIGUOUS)
    end = truth(t, np.array([t.reference.time[-1]]))[0]
    ends = [t.frame().position(*h.trajectory.geodetic[-1])[:2] for h in living]
    near = min(ends, key=lambda e: np.hypot(*(e - end)))
    far = max(ends, key=lambda e: np.hypot(*(e - end)))
    assert np.hypot(*(near - end)) < 200.0 < np.hypot(*(far - end))
    # The answer says that it may be the other one.
    assert np.hypot(*solution.trajectory.position_std[-1, :2]) > 0.1 * np.hypot(*(far - near))
    own = living[0].trajectory.position_std[-1, :2]
    assert np.hypot(*own) < np.hypot(*solution.trajectory.position_std[-1, :2])


@pytest.mark.slow
def test_after_a_turn_by_30_degrees_the_wrong_one_is_dead():
    t = trial(3)
    solution = solve(t, rate_hz=1.0)
    first, second = solution.hypotheses[:2]
    assert first.died is None
    assert 150.0 < second.died < 175.0
    assert not of_code(solution.findings, Code.AMBIGUOUS)
    assert np.hypot(*error_of(t, solution).T).max() < 15.0
