"""The option --resume: a run that was killed continues after the stages that had ended."""

from __future__ import annotations

import os
import signal

import pytest
from truth import scenario

from factorgraph_dvl.cli import main
from factorgraph_dvl.cli.console import ProgressLine
from factorgraph_dvl.io.trial_folder import save_trial
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers import preparation, rounds

RESULTS = ("calibration.json", "trajectory.csv", "residuals.parquet", "history.csv")


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    path = tmp_path_factory.mktemp("resume") / "trial"
    save_trial(simulate(scenario(noise=True), 1), path, parquet=True)
    return path


def options(trial, out, *more):
    return ["solve", str(trial), "--out", str(out), "--no-figures", "--quiet", *more]


@pytest.fixture(scope="module")
def whole(trial):
    out = trial.parent / "whole"
    with pytest.raises(SystemExit):
        main(options(trial, out))
    return {name: (out / name).read_bytes() for name in RESULTS}


def killed(trial, out, at):
    """Run in a process of its own, which kills itself where a stage begins."""
    child = os.fork()
    if child == 0:

        def progress(line, stage, *args, **kwargs):
            if stage == at:
                os.kill(os.getpid(), signal.SIGKILL)

        ProgressLine.__call__ = progress
        main(options(trial, out))
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
    assert not out.exists()


def forbidden(*args, **kwargs):
    raise AssertionError("a stage that had ended runs again")


def test_a_run_continues_after_the_stages_that_had_ended(run, monkeypatch, trial, whole, tmp_path):
    killed(trial, tmp_path / "out", "covariance")
    monkeypatch.setattr(preparation, "initial_states", forbidden)
    monkeypatch.setattr(rounds, "mounted_start", forbidden)
    monkeypatch.setattr(rounds, "minimise", forbidden)
    result = run(*options(trial, tmp_path / "out", "--resume"))
    assert result.code == 0, result.err
    assert "Continuing after the finished stages alignment, mounting, minimum-1" in result.err
    assert {name: (tmp_path / "out" / name).read_bytes() for name in RESULTS} == whole
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_there_is_nothing_to_resume_of_other_records(run, trial, tmp_path):
    out = tmp_path / "out"
    killed(trial, out, "alignment")
    settings = (trial / "trial.yaml").read_text(encoding="utf-8")
    (trial / "trial.yaml").write_text(settings + "# another\n", encoding="utf-8")
    result = run(*options(trial, out, "--resume"))
    (trial / "trial.yaml").write_text(settings, encoding="utf-8")
    assert result.code == 0
    assert "no interrupted run of this trial with these options" in " ".join(result.err.split())
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_interrupt_says_how_to_continue(run, monkeypatch, trial, tmp_path):
    def progress(line, stage, *args, **kwargs):
        if stage == "covariance":
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressLine, "__call__", progress)
    result = run(*options(trial, tmp_path / "out"))
    assert result.code == 130
    assert "--resume continues" in result.err
    assert (tmp_path / ".out.factorgraph-dvl" / "stages" / "mounting.msgpack").exists()
