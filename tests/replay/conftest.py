"""A replay that has just started, and the segments after its start."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from truth import scenario

from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import Segments, one_segment
from factorgraph_dvl.replay.start import ReplayStart, solve_start
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.trial import Trial

# Records up to here, s, are solved as a batch.
STARTED = 45.0


@dataclass(frozen=True)
class Started:
    """A trial of a minute, its records until the start, and the start."""

    trial: Trial
    early: Trial
    start: ReplayStart

    def segment(self, i: int) -> Segments:
        """Return second i after the start."""
        inc, _ = increments(self.trial.imu, self.start.smoothing)
        edges = np.searchsorted(inc.start, self.start.time + np.array([i, i + 1.0]) - 1e-6)
        return one_segment(inc, *edges.tolist())

    def aids(self, seg: Segments):
        """Return what GNSS and DVL measured in a segment."""
        a, b = seg.node_time
        parts = (
            rows_of(aid, (aid.time >= a) & (aid.time < b))
            for aid in (self.trial.gnss, self.trial.dvl)
        )
        return [part for part in parts if part.time.size]


def before(trial: Trial, end: float) -> Trial:
    """Return the records until a time."""
    parts = {
        name: rows_of(getattr(trial, name), getattr(trial, name).time < end)
        for name in ("imu", "gnss", "dvl")
    }
    return replace(trial, **parts)


def silent(stage, iteration, cost):
    """Report nothing."""


@pytest.fixture(scope="session")
def started() -> Started:
    trial = simulate(scenario(noise=True), 2)
    early = before(trial, STARTED)
    start = solve_start(early, None, 1.0, STARTED - 3.0, silent, 0.0)
    assert isinstance(start, ReplayStart), start
    return Started(trial, early, start)
