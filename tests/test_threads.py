"""Threads of a program that use the package at once, for the first time in their process."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import pytest
from kinds import TRIALS

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.folders import claim
from factorgraph_dvl.files.trial_folder import save_trial

_PROGRAMS = Path(__file__).with_name("thread_programs.py")
_PACKAGE = Path(__file__).resolve().parent.parent / "factorgraph_dvl"


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trials")
    for name, make in TRIALS.items():
        save_trial(make(), folder / name)
    return folder


def output_of(*args):
    """Return what a program printed; it has ended well."""
    done = subprocess.run(
        [sys.executable, str(_PROGRAMS), *map(str, args)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | {"PYTHONFAULTHANDLER": "1"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def check_first_use(trial, runs):
    """Use types for the first time in several threads, in so many processes, two at a time."""
    orders = ["load", "parse"] * (runs // 2)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda order: output_of("first-use", order, trial), orders))
    assert set(found) == {output_of("first-use", "alone", trial)}


@pytest.mark.slow
def test_types_may_be_used_first_in_several_threads(trials):
    check_first_use(trials / "imu", 8)


@pytest.mark.slow
def test_types_may_be_used_first_in_several_threads_many_times(trials):
    check_first_use(trials / "imu", 40)


@pytest.mark.slow
def test_two_threads_solve_two_trials_as_one_does(trials):
    pair = trials / "imu", trials / "beacon"
    assert output_of("solve", "together", *pair) == output_of("solve", "apart", *pair)


@pytest.mark.slow
@pytest.mark.parametrize("pair", [*pairwise([*TRIALS, next(iter(TRIALS))])], ids="-".join)
def test_two_threads_solve_trials_of_all_kinds_as_one_does(trials, pair):
    paths = [trials / name for name in pair]
    assert output_of("solve", "together", *paths) == output_of("solve", "apart", *paths)


def test_two_threads_do_not_write_to_one_folder(tmp_path):
    def claim_too():
        with claim(tmp_path / "out"):
            pass

    with ThreadPoolExecutor(1) as pool, claim(tmp_path / "out"):
        with pytest.raises(DataError, match="another run is writing"):
            pool.submit(claim_too).result()
        # Its own thread may claim it again.
        claim_too()


def test_types_are_read_under_one_lock():
    """Only `settings.convert` has msgspec read a type; see there."""
    found = set()
    for file in _PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            typed = any(keyword.arg == "type" for keyword in node.keywords)
            name = ast.unparse(node.func)
            if name.startswith("msgspec.") and (
                node.func.attr in ("convert", "Decoder") or (node.func.attr == "decode" and typed)
            ):
                found.add(file.relative_to(_PACKAGE).as_posix())
    assert found == {"settings/convert.py"}
