"""The command `kalman`: figures of convergence, accuracy, the filters as published."""

from __future__ import annotations

import json

import pytest
from running import run  # noqa: F401
from truth import scenario

from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.simulation import simulate


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kalman") / "trial"
    save_trial(simulate(scenario(noise=True), 1), folder)
    return folder


@pytest.mark.slow
def test_the_linear_filter_draws_how_it_converged_and_says_its_accuracy(trial, run, tmp_path):  # noqa: F811
    out = tmp_path / "out"
    result = run("kalman", trial, "--method", "nine-state", "--linear", "--out", out, "--quiet")
    assert result.code in (0, 1), result.err
    assert (out / "figures" / "convergence.png").stat().st_size > 1000
    assert "Accuracy, mean of 1 − |error / truth|" in result.out
    solver = json.loads((out / "calibration.json").read_text(encoding="utf-8"))["solver"]
    assert solver == "kalman-nine-state-linear"


@pytest.mark.parametrize("method", [(), ("--method", "point-set")], ids=["default", "other"])
def test_linear_belongs_to_one_method(method, trial, run, tmp_path):  # noqa: F811
    result = run("kalman", trial, *method, "--linear", "--out", tmp_path / "out")
    assert result.code == 2
    assert "--method nine-state" in result.err
    assert not (tmp_path / "out").exists()
