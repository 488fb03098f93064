"""From a planar trial to its problem: ends of records, clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planar import STRAIGHT, trial

from factorgraph_dvl.errors import DataError, SolveError
from factorgraph_dvl.ranging.planar_solution import solve_planar
from factorgraph_dvl.ranging.problem import planar_setup


def test_a_range_at_the_very_end_but_for_rounding_is_no_step_of_its_own():
    t = trial(**STRAIGHT)
    b = t.beacons
    ends = np.append(b.time[:-1], t.heading.time[-1] - 1e-12)
    setup = planar_setup(replace(t, beacons=replace(b, time=ends)))
    assert np.diff(setup.problem.time).min() > 0.5
    assert solve_planar(replace(t, beacons=replace(b, time=ends)), rate_hz=1.0).converged


def test_clocks_that_do_not_fit_are_refused():
    t = trial()
    late = replace(t, beacons=replace(t.beacons, time=t.beacons.time + 1e5))
    with pytest.raises(DataError, match=r"1 to 315 s: they are from 100001 to 100315 s"):
        planar_setup(late)
    with pytest.raises(DataError, match=r"one value every 1000 s; expected .* 60 s apart"):
        planar_setup(replace(t, heading=replace(t.heading, time=1e3 * t.heading.time)))
    nothing = np.full(t.beacons.time.size, np.nan)
    empty = replace(t, beacons=replace(t.beacons, range=nothing, range_rate=nothing))
    with pytest.raises(DataError, match="no range and no range rate"):
        planar_setup(empty)
    with pytest.raises(SolveError, match="0 ranges are too few"):
        solve_planar(replace(t, beacons=replace(t.beacons, range=nothing)))
