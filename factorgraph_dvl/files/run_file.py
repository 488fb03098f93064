"""Run files, format 1: the settings, records and versions that a solution came from."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from factorgraph_dvl.errors import DataError, as_text
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.convert import from_json
from factorgraph_dvl.settings.files import MEGABYTE, open_file, read_bytes
from factorgraph_dvl.solution import SolverStep
from factorgraph_dvl.trial import Trial

RUN_FILE = "run.json"
# Settings of some dozen sensors, with the places of beacons.
_MAX_BYTES = 16 * MEGABYTE
# Bytes that are read at once for a hash.
_BLOCK = MEGABYTE
# Packages that numbers depend on.
_PACKAGES = ("factorgraph-dvl", "gtsam", "numpy", "scipy")


class Inventory(msgspec.Struct):
    """What the record of one sensor contains."""

    sensor: str
    rows: int
    from_s: float
    to_s: float
    interval_s: float
    longest_interval_s: float


class InputFile(msgspec.Struct):
    """A file that a trial was read from."""

    name: str
    sha256: str


class StepTaken(msgspec.Struct):
    """A change of what the solver assumes, and what it took off the objective."""

    round: int
    change: str
    objective: float
    fall: float
    largest_move_sigma: float


class Run(msgspec.Struct):
    """What a solution came from; without times of the run, so that equal runs are equal."""

    format: Literal[1]
    versions: dict[str, str]
    epoch: str
    settings: dict[str, dict[str, Any]]
    records: list[Inventory]
    truth: dict[str, Any] = {}
    steps: list[StepTaken] = []
    certificate: dict[str, Any] = {}
    files: list[InputFile] = []


def run_of(trial: Trial, steps: Sequence[SolverStep] = (), files: Sequence[Path] = ()) -> Run:
    """Return what a solution of a trial comes from.

    Parameters
    ----------
    trial : Trial
        The trial, as loaded.
    steps : sequence of SolverStep, optional
        What its solver changed of its assumptions.
    files : sequence of Path, optional
        What the trial was read from.
    """
    records: list[Any] = list(trial.records)
    versions = {"python": platform.python_version()}
    return Run(
        format=1,
        versions=versions | {name: version(name) for name in _PACKAGES},
        epoch=trial.epoch,
        settings={r.section: msgspec.to_builtins(r.settings) for r in records},
        records=[_inventory(r.section, r.time) for r in records],
        truth={name: np.asarray(v).tolist() for name, v in trial.calibration_truth.items()},
        steps=[
            StepTaken(i, s.change, s.objective, s.fall, s.largest_move_sigma)
            for i, s in enumerate(steps)
        ],
        certificate=dict(trial.certificate),
        files=[InputFile(as_text(file.name), hash_of(file)) for file in files],
    )


def _inventory(section: str, time: Array) -> Inventory:
    intervals = np.diff(time) if time.size > 1 else np.zeros(1)
    return Inventory(
        sensor=section,
        rows=int(time.size),
        from_s=float(time[0]),
        to_s=float(time[-1]),
        interval_s=float(np.median(intervals)),
        longest_interval_s=float(intervals.max()),
    )


def hash_of(path: Path) -> str:
    """Return the SHA-256 of a file; empty if there is none that can be read."""
    total = hashlib.sha256()
    try:
        with open_file(path, expected="a file") as file:
            while block := file.read(_BLOCK):
                total.update(block)
    except (DataError, OSError):
        return ""
    return total.hexdigest()


def encode_run(run: Run) -> bytes:
    """Return the content of run.json."""
    return msgspec.json.format(msgspec.json.encode(run), indent=2) + b"\n"


def read_run(folder: Path) -> Run | None:
    """Read run.json of a solution folder; None where there is none, as in older folders.

    Raises
    ------
    DataError
        If it cannot be read.
    """
    file = folder / RUN_FILE
    if not os.path.lexists(file):
        return None
    try:
        content = read_bytes(file, limit=_MAX_BYTES, expected="the settings of a solution")
        return from_json(content, Run)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DataError(f"cannot be read ({error})", where=str(file)) from None
