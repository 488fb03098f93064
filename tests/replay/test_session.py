"""The replay from end to end: against the batch solver, live, and through what goes wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from findings import of_code
from rich.console import Console
from truth import scenario

from factorgraph_dvl import load_solution, save_trial, solve
from factorgraph_dvl.analysis.error_statistics import calibration_errors, motion_errors
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import ConfigError, DataError, SolveError
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.plausibility.survey import Survey
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.replay import Replay, replay
from factorgraph_dvl.report.terminal.live import live_view
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solved_problems
from factorgraph_dvl.statistics.spurious_information import spurious_information

# 150 s with turns to both sides.
MANOEUVRES = [
    {"straight_s": 30},
    {"turn_deg_s": -6, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 20},
    {"turn_deg_s": 8, "duration_s": 20, "ramp_s": 4},
    {"straight_s": 52},
]


@pytest.fixture(scope="module")
def trial():
    return simulate(scenario(noise=True, manoeuvres=MANOEUVRES, reference_rate_hz=100), 5)


@pytest.fixture(scope="module")
def run(trial):
    return replay(trial, rate_hz=1.0)


def values(solution):
    return np.concatenate([e.value for e in solution.estimates])


def std(solution):
    return np.sqrt(np.diag(solution.covariance))


def within(solution, trial, limit=4.0):
    """Whether all errors of calibration and trajectory are as large as stated."""
    errors = calibration_errors(solution, trial.calibration_truth)
    assert np.nanmax(np.abs(errors.normalised)) < limit
    motion = motion_errors(solution.trajectory, trial.reference)
    for v in (motion.position, motion.velocity, motion.attitude):
        assert np.sqrt(np.mean(v.normalised**2)) < 2.0
        assert np.abs(v.normalised).max() < 6.0


@pytest.fixture
def unsurveyed(monkeypatch):
    """Replay without what a survey of the whole record would find of it, which takes longer."""
    nothing = Survey("trial", (), 0.0, 0.0, 0.0, 0.0, ())
    monkeypatch.setattr("factorgraph_dvl.replay.playback.survey", lambda trial: nothing)


def feed(session, trial, start, end, *, sections=("gnss", "dvl")):
    """Feed what was measured in [start, end), sensors first as they are ahead of the IMU."""
    out = []
    for a in np.arange(start, end, 1.0):
        b = min(a + 1.0, end)
        for section in sections:
            aid = getattr(trial, section)
            inside = np.flatnonzero((aid.time >= a) & (aid.time < b))
            if inside.size:
                session.add(rows_of(aid, inside))
        i = trial.imu
        inside = (i.time >= a) & (i.time < b)
        out += session.add_imu(i.time[inside], i.gyro[inside], i.accel[inside])
    return out


def test_the_end_is_that_of_the_batch_solver(trial, run):
    batch = solve(trial)
    solution, record = run
    assert solution.order == batch.order
    assert np.all(np.abs(values(solution) - values(batch)) < 0.3 * std(batch))
    np.testing.assert_allclose(std(solution), std(batch), rtol=0.05)
    assert solution.converged
    within(solution, trial)
    np.testing.assert_array_equal(record.values[-1], values(solution))


def test_isam2_agrees(trial, run):
    solution, _ = replay(trial, smoother="isam2", rate_hz=1.0)
    assert np.all(np.abs(values(solution) - values(run[0])) < 0.3 * std(run[0]))


def test_smoothed_states_are_better_than_filtered_ones(trial, run):
    solution, record = run
    smoothed = motion_errors(record.smoothed, trial.reference)
    filtered = motion_errors(solution.trajectory, trial.reference)
    for v in (smoothed.position, smoothed.velocity, smoothed.attitude):
        assert np.sqrt(np.mean(v.normalised**2)) < 2.0
    shared = np.isin(filtered.time, smoothed.time)
    assert smoothed.time.size > 80
    assert np.mean(smoothed.position.std) < 0.8 * np.mean(filtered.position.std[shared])
    worse = np.mean(filtered.velocity.error[shared] ** 2)
    assert np.mean(smoothed.velocity.error**2) < worse


def test_what_comes_twice_counts_once(trial):
    once, twice = Replay(trial, rate_hz=1.0), Replay(trial, rate_hz=1.0)
    a = feed(once, trial, 0.0, 40.0)
    feed(twice, trial, 0.0, 36.0)
    for section in ("gnss", "dvl"):
        aid = getattr(trial, section)
        twice.add(rows_of(aid, (aid.time >= 30.0) & (aid.time < 36.0)))
    b = feed(twice, trial, 36.0, 40.0)
    ours, theirs = a[-1].calibration.covariance, b[-1].calibration.covariance
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert any("came twice" in f.text for f in twice.counts())


def test_nothing_is_known_before_it_was_measured(trial):
    whole = Replay(trial, rate_hz=1.0)
    a = feed(whole, trial, 0.0, 90.0)
    other = replace(
        trial,
        imu=replace(trial.imu, gyro=trial.imu.gyro + (trial.imu.time > 80.0)[:, None]),
        dvl=replace(trial.dvl, velocity=trial.dvl.velocity + (trial.dvl.time > 80.0)[:, None]),
    )
    b = feed(Replay(trial, rate_hz=1.0), other, 0.0, 90.0)
    assert whole.delay < 0.5
    known = [u for u in b if u.time < 80.0 - whole.delay]
    assert len(known) > 40
    for mine, theirs in zip(known, a, strict=False):
        assert mine.time == theirs.time
        np.testing.assert_array_equal(mine.state.velocity, theirs.state.velocity)
        np.testing.assert_array_equal(mine.calibration.covariance, theirs.calibration.covariance)


def test_one_sample_at_a_time_gives_the_same(trial):
    blocks = feed(Replay(trial, rate_hz=1.0), trial, 0.0, 45.0)
    single, out = Replay(trial, rate_hz=1.0), []
    for i in range(int(np.searchsorted(trial.imu.time, 45.0))):
        now = trial.imu.time[i]
        for section in ("gnss", "dvl"):
            aid = getattr(trial, section)
            for row in np.flatnonzero((aid.time > now - 0.01 + 1e-9) & (aid.time <= now + 1e-9)):
                single.add(rows_of(aid, [row]))
        out += single.add_imu(now, trial.imu.gyro[i], trial.imu.accel[i])
    assert [u.time for u in out] == [u.time for u in blocks]
    assert len(out) > 10
    np.testing.assert_allclose(
        out[-1].state.geodetic, blocks[-1].state.geodetic, rtol=0.0, atol=1e-10
    )


def test_late_measurements_correct_and_later_ones_are_counted(trial):
    on_time = Replay(trial, rate_hz=1.0)
    late = Replay(trial, rate_hz=1.0)
    feed(on_time, trial, 0.0, 60.0)
    feed(late, trial, 0.0, 60.0)
    a = feed(on_time, trial, 60.0, 80.0)
    feed(late, trial, 60.0, 70.0, sections=("gnss",))
    missing = np.flatnonzero((trial.dvl.time >= 60.0) & (trial.dvl.time < 70.0))
    late.add(rows_of(trial.dvl, missing[::-1]))
    b = feed(late, trial, 70.0, 80.0)
    ours, theirs = (np.sqrt(np.diag(x[-1].calibration.covariance)) for x in (a, b))
    np.testing.assert_allclose(ours, theirs, rtol=1e-3)
    difference = values(a[-1].calibration) - values(b[-1].calibration)
    assert np.abs(difference / ours).max() < 0.05
    assert late.counts() == []
    other = replace(trial.dvl, velocity=trial.dvl.velocity + 1e-9)
    late.add(rows_of(other, slice(0, 3)))
    feed(late, trial, 80.0, 82.0)
    assert any("DVL: 3 measurements came too late" in str(f) for f in late.counts())


def lost(trial, **changes):
    return replace(trial, **changes)


def without(aid, start, end):
    return rows_of(aid, (aid.time < start) | (aid.time > end))


def test_gnss_and_bottom_lock_may_fail(trial):
    failing = replace(
        trial, gnss=without(trial.gnss, 60.0, 90.0), dvl=without(trial.dvl, 95.0, 120.0)
    )
    solution, _ = replay(failing, rate_hz=1.0)
    within(solution, trial)
    for label in ("GNSS position", "DVL velocity"):
        noticed = [f.code for f in solution.findings if f.sensor == label]
        assert noticed == [Code.SILENT, Code.HEARD_AGAIN]


@pytest.mark.slow
def test_a_gap_of_the_imu_is_survived_and_a_silent_sensor_after_it(trial):
    short = replace(
        trial,
        imu=rows_of(trial.imu, (trial.imu.time < 70.0) | (trial.imu.time > 100.0)),
        dvl=without(trial.dvl, 68.0, 112.0),
    )
    solution, record = replay(short, rate_hz=1.0)
    within(solution, trial)
    (text,) = of_code(solution.findings, Code.IMU_GAP)
    assert "gap of 30.0" in text
    before = np.searchsorted(record.time, 70.0) - 1
    # What was known of the calibration before the gap is known after it.
    after = before + 1
    assert record.time[after] > 100.0
    assert np.all(record.std[after] < 1.2 * record.std[before])
    assert np.all(np.isfinite(record.std))


def test_a_clock_that_jumps_is_not_believed(trial, unsurveyed):
    time = np.where(trial.dvl.time > 60.0, trial.dvl.time + 1.37, trial.dvl.time)
    solution, record = replay(replace(trial, dvl=replace(trial.dvl, time=time)), rate_hz=1.0)
    assert ("DVL velocity", Code.CONTRADICTS) in {(f.sensor, f.code) for f in solution.findings}
    assert not solution.converged
    good = ~record.inconsistent
    assert good.sum() > 20
    errors = calibration_errors(solution, trial.calibration_truth)
    assert np.nanmax(np.abs(errors.normalised)) < 5.0


def test_a_clock_of_a_sensor_that_jumps_back_is_not_believed(trial):
    session = Replay(trial, rate_hz=1.0)
    feed(session, trial, 0.0, 36.0)
    updates = []
    for a in np.arange(36.0, 80.0):
        for section, late in (("gnss", 0.0), ("dvl", 2.0)):
            aid = getattr(trial, section)
            now = rows_of(aid, (aid.time >= a) & (aid.time < a + 1.0))
            session.add(replace(now, time=now.time - late))
        updates += feed(session, trial, a, a + 1.0, sections=())
    assert updates[-1].inconsistent == ("DVL velocity",)
    truth = trial.calibration_truth
    for e in updates[-1].calibration.estimates:
        if e.name in ("misalignment_deg", "scale_error", "lever_arm_m"):
            # Nor is it when all is solved again.
            assert np.all(np.abs(e.value - truth[e.name]) < 4.0 * e.std)


@pytest.mark.slow
def test_a_clock_of_the_imu_that_jumps_ahead_is_no_gap(trial, run, unsurveyed):
    time = np.where(trial.imu.time > 62.0, trial.imu.time + 1.37, trial.imu.time)
    solution, record = replay(replace(trial, imu=replace(trial.imu, time=time)), rate_hz=1.0)
    (text,) = of_code(solution.findings, Code.CLOCK_JUMP)
    assert "jumped ahead by 1.37" in text
    assert solution.converged
    within(solution, trial)
    assert record.time[-1] == pytest.approx(run[1].time[-1], abs=1e-6)
    # No estimate is better than a wrong one until the two have been told apart.
    assert np.diff(record.time).max() < 11.0


def test_a_clock_of_the_imu_alone_that_jumps_back_is_set_right(trial):
    session = Replay(trial, rate_hz=1.0)
    feed(session, trial, 0.0, 60.0)
    updates = []
    for a in np.arange(60.0, 80.0):
        for section in ("gnss", "dvl"):
            aid = getattr(trial, section)
            session.add(rows_of(aid, (aid.time >= a) & (aid.time < a + 1.0)))
        inside = (trial.imu.time >= a) & (trial.imu.time < a + 1.0)
        i = trial.imu
        updates += session.add_imu(i.time[inside] - 5.0, i.gyro[inside], i.accel[inside])
    (text,) = (t for u in updates for t in of_code(u.findings, Code.CLOCK_JUMP))
    assert "jumped back by 5.0" in text
    motion = motion_errors(updates[-1].state, trial.reference)
    assert updates[-1].time > 77.0
    for v in (motion.position, motion.velocity, motion.attitude):
        assert np.abs(v.normalised).max() < 6.0
    assert not updates[-1].inconsistent


@pytest.mark.slow
def test_a_clock_that_jumps_back_is_set_right(trial):
    session = Replay(trial, rate_hz=1.0)
    feed(session, trial, 0.0, 60.0)
    back = replace(trial, imu=replace(trial.imu, time=trial.imu.time - 50.0))
    for section in ("gnss", "dvl"):
        aid = getattr(trial, section)
        back = replace(back, **{section: replace(aid, time=aid.time - 50.0)})
    updates = feed(session, back, 10.0, 30.0)
    assert any(of_code(u.findings, Code.CLOCK_JUMP) for u in updates)
    assert updates[-1].time == pytest.approx(79.0, abs=1.1)
    motion = motion_errors(updates[-1].state, trial.reference)
    for v in (motion.position, motion.velocity, motion.attitude):
        assert np.abs(v.normalised).max() < 6.0


def test_what_a_straight_run_does_not_show_is_not_claimed():
    scene = scenario(noise=True, manoeuvres=[{"straight_s": 60}], sway={})
    trial = simulate(scene, 2)
    solution, record = replay(trial, rate_hz=1.0)
    misalignment = solution.estimate("misalignment_deg")
    assert not misalignment.observable[1]
    # Roll about the direction of the velocity, all along.
    column = solution.order.index("misalignment_y_deg")
    assert record.std[:, column].min() > 60.0
    assert of_code(solution.findings, Code.NOT_OBSERVABLE)


def test_spurious_information_is_counted_at_whatever_rate_a_sensor_comes(trial):
    seldom = rows_of(trial.dvl, np.arange(2, trial.dvl.time.size, 5))
    early = replace(trial, imu=rows_of(trial.imu, trial.imu.time < 60.0), dvl=seldom)
    session = Replay(early)
    for aid in early.aids:
        session.add(aid)
    session.add_imu(early.imu.time, early.imu.gyro, early.imu.accel)
    nav = session._navigator
    found = solved_problems(early, state_interval_s=0.2)[0]
    by_node = spurious_information(
        found.problem, found.minimum.evaluation, found.covariances.nodes
    ).trace(axis1=1, axis2=2)
    after = found.problem.chain.segments.node_time > nav.start.time
    # The motion is known less well at the time than with hindsight.
    grown = np.trace(nav.spurious.information - nav.start.spurious)
    assert by_node[after].sum() < grown < 10.0 * by_node[after].sum()


def test_what_never_starts_says_why():
    trial = simulate(scenario(noise=True, manoeuvres=[{"straight_s": 3}]), 0)
    with pytest.raises(SolveError, match="never sufficient"):
        replay(replace(trial, imu=rows_of(trial.imu, slice(0, 60))))
    with pytest.raises(DataError, match="positions: no file has any"):
        replay(replace(trial, gnss=None))
    with pytest.raises(ConfigError, match="lag_s"):
        Replay(trial, lag_s=0.0)
    with pytest.raises(ConfigError, match="smoother"):
        Replay(trial, smoother="kalman")
    with pytest.raises(ConfigError, match="no IMU"):
        Replay(replace(trial, imu=None)).add_imu(0.0, np.zeros(3), np.zeros(3))


def test_the_command_writes_what_was_known_when(trial, tmp_path, capsys):
    early = replace(trial, imu=rows_of(trial.imu, trial.imu.time < 90.0))
    save_trial(early, tmp_path / "trial", parquet=True)
    out = tmp_path / "out"
    command = ["replay", str(tmp_path / "trial"), "--out", str(out), "--rate", "1", "--quiet"]
    limits = ["--good-std", "scale_error=0.01", "--good-std", "misalignment_deg=1"]
    with pytest.raises(SystemExit) as end:
        main([*command, "--live", *limits])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert "good enough after" in shown
    solution = load_solution(out)
    assert solution.solver == "replay"
    names = [column for name in solution.order for column in (name, f"{name}_std")]
    history = read_table(out / "history.csv", ["time_s", "latency_ms", *names])
    header = (out / "history.csv").read_text().splitlines()[0].replace('"', "").split(",")
    assert header == ["time_s", "latency_ms", *names]
    assert history["latency_ms"].min() > 0.0
    assert history["lever_arm_x_m"][-1] == pytest.approx(solution.estimate("lever_arm_m").value[0])
    trajectory = read_table(out / "trajectory.csv", ["time_s", "smoothed_std_e_m", "std_e_m"])
    there = ~np.isnan(trajectory["smoothed_std_e_m"])
    assert there.sum() > 80
    assert read_table(out / "latency.csv", ["time_s", "latency_ms", "batch"])["batch"].sum() >= 1
    assert (out / "figures" / "convergence.png").stat().st_size > 10_000
    assert (out / "instrument.yaml").is_file()
    assert (out / "convergence.csv").read_text().splitlines()[-1].startswith("all,")
    with pytest.raises(SystemExit) as end:
        main([*command, "--force", "--good-std", "lever_arm_m"])
    assert end.value.code == 2
    with pytest.raises(SystemExit) as end:
        main([*command, "--force", "--good-std", "current_m_s=1"])
    assert end.value.code == 2
    assert "'current_m_s'" in capsys.readouterr().err


def test_lost_samples_and_an_end_that_is_not_reached_are_said(trial, tmp_path, capsys):
    time = trial.imu.time
    lost = (np.abs(time - 12.0) < 0.015) | (np.abs(time - 50.0) < 0.005)
    gap = (time > 75.0) & (time < 77.0)
    short = replace(trial, imu=rows_of(trial.imu, ~lost & ~gap & (time < 77.1)))
    save_trial(short, tmp_path / "trial", parquet=True)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as end:
        main(["replay", str(tmp_path / "trial"), "--out", str(out), "--rate", "1", "--no-figures"])
    assert end.value.code == 1
    solution = load_solution(out)
    assert not solution.converged
    assert solution.trajectory.time[-1] == pytest.approx(75.0, abs=0.11)
    shown = " ".join(capsys.readouterr().err.split())
    for code, text in (
        (Code.LOST_SAMPLES, "3 lost samples in 1 place were interpolated"),
        (Code.LOST_SAMPLES, "1 sample that was lost after the start was interpolated"),
        (Code.UNUSED, "the replay ended at 75.0"),
    ):
        assert any(text in w for w in of_code(solution.findings, code)), text
        assert text in shown, text
    assert "the replay did not reach the end" in shown


def test_what_matters_is_in_view_on_a_low_terminal(trial, run):
    solution, _ = run
    console = Console(width=80, height=24)
    view = live_view(
        "trial",
        200.0,
        solution.estimates,
        rows_of(solution.trajectory, [0]),
        latency=0.004,
        speed=20.0,
        inconsistent=("GNSS position",),
        short_of_limits=("misalignment_y_deg",),
        verdict=solution.verdict,
    )
    lines = [s for line in console.render_lines(view) if (s := "".join(x.text for x in line))]
    text = "\n".join(lines[: console.height - 1])
    assert str(solution.verdict)[:40] in text
    for expected in ("not good enough yet: misalignment_y", "contradictory: GNSS position"):
        assert expected in text
    for expected in ("position", "latency 4.0 ms, 20.0 times", "lever_arm_z"):
        assert expected in text
