"""From a planar trial to its problem: ends of records, clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planar import STRAIGHT, changed, setup_of, trial, true_state

from factorgraph_dvl import load_solution, save_trial
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import DataError, SolveError
from factorgraph_dvl.plausibility.survey import survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.planar_setup import Track

SHORT = {"manoeuvres": [{"straight_s": 30}, {"turn_deg_s": 2, "duration_s": 30}]}


@pytest.mark.slow
def test_a_range_at_the_very_end_but_for_rounding_is_no_step_of_its_own():
    t = trial(**STRAIGHT)
    b = t.beacons
    ends = np.append(b.time[:-1], t.records[0].time[-1] - 1e-12)
    setup = setup_of(changed(t, replace(b, time=ends)))
    assert np.diff(setup.chain.node_time).min() > 0.5
    assert solve(changed(t, replace(b, time=ends)), rate_hz=1.0).converged


def test_a_track_goes_on_at_other_nodes_by_dead_reckoning():
    """Where it was at new nodes, and from its end on by what heading and log say since."""
    t = trial()
    x, values = true_state(t, setup_of(t))
    early = setup_of(t.until(101.0))
    problem = early.problem(early.chain.node_time.size, {})
    count = problem.chain.node_time.size
    states = early.chain.with_recorded(problem.chain.node_time, x[:count])
    track = Track(problem, problem.evaluate(problem.values(states, values)), converged=True)
    heading, log = t.records[:2]
    every_other = [rows_of(record, slice(0, None, 2)) for record in (heading, log)]
    setup = setup_of(changed(t, *every_other))
    time = setup.chain.node_time
    found = setup.carried(track, int(np.searchsorted(time, 131.0)))
    known = time[: len(found)] <= problem.chain.node_time[-1]
    assert 0 < known.sum() < len(found)
    whole = setup_of(t).chain.node_time
    there = np.searchsorted(whole, time[: len(found)])
    np.testing.assert_allclose(found[known], x[there[known]], atol=1e-9)
    off = found[~known] - x[there[~known]]
    assert np.abs(off[:, :2]).max() < 2.0
    assert np.abs(off[:, 2:]).max() < 0.3
    cut = setup_of(t).carried(track, 40)
    np.testing.assert_allclose(cut, x[:40], atol=1e-9)


def test_clocks_that_do_not_fit_are_refused():
    t = trial()
    late = changed(t, replace(t.beacons, time=t.beacons.time + 1e5))
    with pytest.raises(DataError, match=r"1 to 315 s: they are from 100001 to 100315 s"):
        setup_of(late)
    heading = t.records[0]
    with pytest.raises(DataError, match=r"one value every 1000 s; expected .* 60 s apart"):
        setup_of(changed(t, replace(heading, time=1e3 * heading.time)))
    nothing = np.full(t.beacons.time.size, np.nan)
    empty = changed(t, replace(t.beacons, range=nothing, range_rate=nothing))
    with pytest.raises(DataError, match="no range and no range rate"):
        setup_of(empty)
    with pytest.raises(SolveError, match="0 ranges are too few"):
        solve(changed(t, replace(t.beacons, range=nothing)))


def jumping(t, at, by):
    """Return a trial whose clock is set while it runs."""
    late = [replace(r, time=np.where(r.time >= at, r.time + by, r.time)) for r in t.records]
    return changed(t, *late)


@pytest.mark.parametrize(("at", "kept"), [(20.0, (20.0, 315.0)), (250.0, (0.0, 250.0))])
def test_only_the_part_between_jumps_with_most_ranges_is_used(at, kept):
    t = jumping(trial(), at, 1.3e9)
    setup = setup_of(t)
    first, last = np.array(kept) + (1.3e9 if at < 100.0 else 0.0)
    assert first <= setup.chain.node_time[0] <= first + 1.0
    assert last - 1.0 <= setup.chain.node_time[-1] <= last
    codes = [f.code for f in survey(t).findings]
    assert codes.count(Code.CLOCK_JUMP) == 3
    assert Code.GAPS not in codes


def test_a_long_trial_before_a_jump_is_no_gap():
    t = trial()
    slow = changed(t, *(replace(r, time=20.0 * r.time) for r in t.records))
    setup = setup_of(jumping(slow, 6000.0, 1.3e9))
    assert np.ptp(setup.chain.node_time) > 5900.0


def test_the_trajectory_of_a_trial_with_a_jump_is_no_longer_than_its_records():
    found = solve(jumping(trial(**SHORT), 5.0, 1.3e9), rate_hz=1.0)
    assert found.trajectory.time.size < 70


def test_a_track_alone_is_solved_and_its_information_shown(tmp_path):
    """Two beacons whose places are known, and a log over ground: no constant is estimated."""
    places = {
        "B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80},
        "B2": {"lat_deg": 25.004, "lon_deg": 135.004, "height_m": -90},
    }
    made = trial(
        manoeuvres=[{"straight_s": 75}],
        beacons={"positions": places},
        log={"reference": "bottom"},
        current_m_s=[0, 0, 0],
    )
    save_trial(made, tmp_path / "trial")
    for command in ("solve", "observability"):
        with pytest.raises(SystemExit) as end:
            main([command, str(tmp_path / "trial"), "--out", str(tmp_path / command)])
        assert end.value.code == 0
    found = load_solution(tmp_path / "solve")
    assert found.estimates == ()
    assert found.verdict.grade == "good"
