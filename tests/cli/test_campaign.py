"""The command `campaign`: solved once, whatever is killed; bad input before anything starts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from truth import CONFIGS, TURNING, scenario
from workers import sleepy_run

from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.simulation import simulate


def test_bad_input_is_refused_before_anything_starts(run, tmp_path):
    (tmp_path / "trial").mkdir()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.tex").write_text("all of it")
    cases = {
        "does not exist": (tmp_path / "absent", "--out", tmp_path / "out"),
        "exclude each other": (
            *(tmp_path / "trial", "--out", tmp_path / "out"),
            *("--workers", "1", "--scheduler", "tcp://localhost:1"),
        ),
        "--seeds belongs to one scenario": (
            *(tmp_path / "trial", tmp_path / "trial", "--seeds", "2"),
            *("--out", tmp_path / "out"),
        ),
        "exists and is not empty": (tmp_path / "trial", "--out", full),
        "pipe: is not a trial": (tmp_path / "trial", pipe, "--out", tmp_path / "out"),
        "a scenario --seeds N": (CONFIGS / "cruise.yaml", "--out", tmp_path / "out"),
    }
    for message, args in cases.items():
        result = run("campaign", *args)
        assert result.code == 2
        assert message in result.err
        assert not (tmp_path / "out").exists()
    assert [p.name for p in full.iterdir()] == ["thesis.tex"]


def dives(folder: Path, count: int) -> list[Path]:
    for i in range(count):
        data = scenario(noise=True, name=f"dive-{i}", epoch=f"2024-05-{i + 1:02d}T00:00:00Z")
        save_trial(simulate(data, i), folder / f"{i}")
    return [folder / f"{i}" for i in range(count)]


def written(out: Path) -> dict[str, int]:
    return {p.parent.name: p.stat().st_mtime_ns for p in out.glob("trials/*/calibration.json")}


@pytest.mark.slow
def test_a_campaign_survives_kills_and_solves_nothing_twice(run, tmp_path):
    pytest.importorskip("distributed")
    trials = dives(tmp_path, 4)
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "trial.yaml").write_text("format: 1\n")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "factorgraph_dvl.cli", "campaign", *map(str, trials)]
    command += ["--out", str(out), "--workers", "1", "--no-figures"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    while len(written(out)) < 2:
        time.sleep(0.05)
        assert process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(1.0)
    before = written(out)
    assert 2 <= len(before) < 4
    # What ended before the kill is kept, but for one whose record was not written yet.
    recorded = {p.stem for p in (out / "trials").glob("*.json")}
    result = run(*command[3:], str(bad))
    assert result.code == 1
    assert "missing key `imu`" in result.err
    after = written(out)
    assert all(after[name] == before[name] for name in recorded)
    content = json.loads((out / "campaign.json").read_text())
    assert [t["solved"] for t in content["trials"]].count(True) == 4
    assert content["joint"]["parameters"]["misalignment_deg"]["std"][2] < 0.1
    shown = run("report", str(out))
    assert shown.code != 0
    assert "the result of a campaign" in shown.err
    # A result that was tampered with is solved again, and it alone.
    victim = out / "trials" / "0" / "calibration.json"
    victim.write_text("{}")
    assert run(*command[3:]).code == 0
    again = written(out)
    assert {n for n in again if again[n] != after[n]} == {"0"}


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_what_it_was_running(tmp_path):
    distributed = pytest.importorskip("distributed")
    assert distributed

    from factorgraph_dvl.campaign.cluster import connected, records

    labels = [f"run-{i}" for i in range(12)]
    counts = tmp_path / "counts"
    counts.mkdir()
    runs = [(sleepy_run, (label, str(counts))) for label in labels]
    found = {}
    with connected(2, None) as client:
        for i, record in records(client, runs, labels):
            found[i] = record
            if len(found) in (2, 5, 8):
                pids = client.run(os.getpid)
                os.kill(next(iter(pids.values())), signal.SIGKILL)
    assert all(found[i].done for i in range(12))
    started = [len(list(counts.glob(f"{label}.*"))) for label in labels]
    # A worker that is killed loses what it runs, and what it has just ended if nobody has it yet.
    assert sum(started) <= 12 + 2 * 3


@pytest.mark.slow
def test_a_worker_leaves_an_interrupt_to_the_command_and_what_it_starts_does_not():
    pytest.importorskip("distributed")

    from factorgraph_dvl.campaign.cluster import connected

    with connected(1, None) as client:
        (process,) = client.run(os.getpid).values()
        os.kill(process, signal.SIGINT)
        interrupted = ["import os, signal", "signal.raise_signal(signal.SIGINT)"]
        code = client.submit(
            subprocess.call,
            [sys.executable, "-c", "; ".join(interrupted)],
            stderr=subprocess.DEVNULL,
        )
        assert code.result(timeout=60) == -signal.SIGINT
        assert list(client.run(os.getpid).values()) == [process]


@pytest.mark.slow
def test_a_scheduler_that_is_running_survives_more_deaths_than_it_would(tmp_path):
    distributed = pytest.importorskip("distributed")

    from factorgraph_dvl.campaign.cluster import connected, records

    labels = [f"run-{i}" for i in range(6)]
    runs = [(sleepy_run, (label, str(tmp_path))) for label in labels]
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as cluster,
        connected(1, cluster.scheduler_address) as client,
    ):
        allowed = client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.allowed_failures)
        assert allowed >= 30
        found = dict(records(client, runs, labels))
    assert all(found[i].done for i in range(6))


@pytest.mark.slow
def test_seeds_of_a_scenario_are_consistent(run, tmp_path):
    pytest.importorskip("distributed")
    config = tmp_path / "scenario.yaml"
    data = yaml.safe_load((CONFIGS / "seed-a-phase-90.yaml").read_text(encoding="utf-8"))
    data["start"]["speed_m_s"] = 4.0
    config.write_text(yaml.safe_dump(data | {"manoeuvres": TURNING}))
    out = tmp_path / "out"
    result = run("campaign", config, "--seeds", 8, "--out", out, "--workers", 2)
    assert result.code == 0, result.err
    content = json.loads((out / "campaign.json").read_text())
    assert content["solved"] == 8
    assert content["nees"]["inside"]
    assert all(s["low"] < 1.0 < s["high"] for s in content["rms_over_std"])
    # More seeds go on from there.
    stamp = (out / "seeds" / "0.json").stat().st_mtime_ns
    assert run("campaign", config, "--seeds", 9, "--out", out, "--workers", 2).code == 0
    assert (out / "seeds" / "0.json").stat().st_mtime_ns == stamp
