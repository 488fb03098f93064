"""The replay against the batch solver at odd rates, phases and clocks.

    pytest -m slow tests/replay/test_clock_rates.py

runs all trials in two processes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from clocks import COUNT, odd_trial
from workers import in_two_processes

from factorgraph_dvl import solve
from factorgraph_dvl.replay import replay

# In standard deviations.
_SAME = 0.2


def compared(seed):
    """Return samples from the last state to the end, and the largest difference in σ."""
    # What a replay finds of the noise is of its first minute only.
    trial = replace(odd_trial(seed), noise="stated")
    batch = solve(trial)
    solution, record = replay(trial, rate_hz=5.0)
    assert batch.converged
    assert solution.converged
    a, b = (np.concatenate([e.value for e in s.estimates]) for s in (solution, batch))
    apart = np.abs(a - b) / np.sqrt(np.diag(batch.covariance))
    np.testing.assert_array_equal(solution.trajectory.time, batch.trajectory.time)
    end = trial.imu.time[-1]
    short = (end - record.time[-1]) / np.median(np.diff(trial.imu.time))
    return short, apart.max()


@pytest.mark.slow
def test_all_replays_end_as_the_batch_does():
    short, apart = np.transpose(in_two_processes(compared, range(COUNT)))
    assert np.abs(short).max() < 0.5
    assert apart.max() < _SAME, apart
