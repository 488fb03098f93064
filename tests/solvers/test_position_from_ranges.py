"""First positions from ranges: none without beacons, outliers where GNSS gives the position."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from truth import exact_states, scenario

from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import hypotheses
from factorgraph_dvl.solvers.planar_setup import PlanarSetup
from factorgraph_dvl.solvers.position_from_ranges import positions_from_ranges

BEACONS = {
    "rate_hz": 2,
    "positions": {"B1": {"lat_deg": 36.002, "lon_deg": 121.003, "height_m": -60}},
    "range_std_m": 0.5,
    "range_rate_std_m_s": 0.05,
}


def prepared(**beacons):
    scene = scenario(manoeuvres=[{"straight_s": 30}], beacons={**BEACONS, **beacons})
    trial = simulate(scene, 1)
    seg = segments(increments(trial.imu)[0], 1.0)
    frame = trial.frame()
    return trial, frame, seg, exact_states(scene, frame, seg.node_time)


def test_without_ranges_the_states_stay():
    trial, frame, seg, states = prepared()
    others = tuple(aid for aid in trial.others if aid is not trial.beacons)
    found = positions_from_ranges(replace(trial, others=others), frame, seg, states)
    assert found.states == (states,)
    assert not found.rejected
    late = replace(trial.beacons, time=trial.beacons.time + 1e4)
    found = positions_from_ranges(replace(trial, others=(*others, late)), frame, seg, states)
    assert found.states == (states,)


def test_with_gnss_only_outliers_are_sought(monkeypatch):
    fits, fit = [], PlanarSetup.fitted

    def counted(self, *args):
        fits.append(args)
        return fit(self, *args)

    monkeypatch.setattr(hypotheses, "search", None)
    monkeypatch.setattr(PlanarSetup, "fitted", counted)
    trial, frame, seg, states = prepared()
    beacons = trial.beacons
    wrong = np.arange(20, beacons.time.size, 20)
    beacons.range[wrong] += 30.0
    found = positions_from_ranges(trial, frame, seg, states)
    assert found.states == (states,)
    assert not found.hypotheses
    rejected = found.rejected["Beacon B1 range"]
    assert np.isin(beacons.time[wrong], rejected).all()
    assert rejected.size <= wrong.size + 2
    # The only track needs no search, and is fitted once.
    assert len(fits) == 1
