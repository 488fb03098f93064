"""One trial of a campaign: solved by a process of its own, unless its result is there."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import perf_counter

import numpy as np
from msgspec import UnsetType

from factorgraph_dvl.campaign.record import (
    RunRecord,
    fingerprint_of,
    read_record,
    write_record,
)
from factorgraph_dvl.errors import FactorgraphDvlError, as_text
from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE, load_calibration
from factorgraph_dvl.files.run_file import hash_of
from factorgraph_dvl.files.trial_folder import files_of, locate
from factorgraph_dvl.files.trial_yaml import TrialSettings
from factorgraph_dvl.sensors.dvl import CALIBRATED, DvlSettings
from factorgraph_dvl.settings.yaml_file import parse_yaml, read_text

TRIALS_FOLDER = "trials"
# Chosen: the end of what a run that failed wrote to standard error.
_LONGEST_ERROR = 2000


def run_trial(trial: str, label: str, out: str, options: Sequence[str]) -> RunRecord:
    """Solve a trial into `out`/trials/`label`, unless that is there already.

    The process ends with this one: a worker that is killed leaves none behind.

    Parameters
    ----------
    trial : str
        Path of the trial, absolute.
    label : str
        Name of its folder.
    out : str
        Folder of the campaign, absolute.
    options : sequence of str
        Options of the command `solve`.
    """
    folder = Path(out) / TRIALS_FOLDER / label
    file = folder.with_name(f"{label}.json")
    fingerprint = fingerprint_of(files_of(Path(trial)), {"options": " ".join(options)})
    earlier = read_record(file, RunRecord)
    same = earlier is not None and earlier.done and earlier.fingerprint == fingerprint
    if earlier is not None and same and earlier.result == hash_of(folder / CALIBRATION_FILE):
        return earlier
    file.unlink(missing_ok=True)
    record = RunRecord(name=as_text(Path(trial).name), fingerprint=fingerprint, done=False)
    try:
        _describe(record, Path(trial))
    except FactorgraphDvlError as error:
        # `solve` says the same if it matters to it.
        record.error = str(error)
    before = _state_of(folder / CALIBRATION_FILE)
    command = [sys.executable, "-m", "factorgraph_dvl.cli", "solve", trial]
    command += ["--out", str(folder), "--force", "--quiet", *options]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile() as log:
        start = perf_counter()
        # The system ends a process by a signal when the other end of its standard input is
        # closed: by this process, or by its death.
        theirs, ours = os.pipe()
        with open(ours, "wb"), open(theirs, "rb") as end:
            process = subprocess.Popen(command, stdin=end, stdout=subprocess.DEVNULL, stderr=log)
            fcntl.fcntl(end, fcntl.F_SETOWN, process.pid)
            fcntl.fcntl(end, fcntl.F_SETFL, os.O_ASYNC)
            # Of this process alone: getrusage knows only the largest of all.
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        record.wall_s = perf_counter() - start
        record.cpu_s = usage.ru_utime + usage.ru_stime
        record.peak_bytes = usage.ru_maxrss * 1024
        log.seek(0)
        text = log.read().decode(errors="replace").strip()
    record.done = process.returncode in (0, 1) and _state_of(folder / CALIBRATION_FILE) != before
    if record.done:
        record.error = ""
        record.result = hash_of(folder / CALIBRATION_FILE)
    else:
        record.error = _reason(process.returncode, text)
    write_record(record, file)
    return record


def name_of(trial: Path) -> str:
    """Return the name of a trial; empty if its trial.yaml cannot be read."""
    with suppress(FactorgraphDvlError, OSError):
        return _settings_of(trial)[1]
    return ""


def _settings_of(trial: Path) -> tuple[TrialSettings, str, Path]:
    """Return the settings of a trial, its name and folder."""
    folder, file = locate(trial)
    settings = parse_yaml(read_text(file), TrialSettings, source=file.name)
    return settings, settings.name or as_text(folder.resolve().name), folder


def _describe(record: RunRecord, trial: Path) -> None:
    """Take name, epoch and the joint prior of the DVL from the settings of a trial."""
    settings, record.name, folder = _settings_of(trial)
    record.epoch = settings.epoch
    dvl = settings.aids.get("dvl")
    if not isinstance(dvl, DvlSettings) or isinstance(dvl.calibration, UnsetType):
        return
    prior = load_calibration(folder / dvl.calibration, body_axes=settings.body_axes)
    rows: list[int] = []
    at = 0
    for e in prior.estimates:
        if e.name in CALIBRATED:
            record.prior_names += e.component_names
            rows += range(at, at + e.value.size)
        at += e.value.size
    record.prior_covariance = prior.covariance[np.ix_(rows, rows)].tolist()


def _state_of(file: Path) -> tuple[int, int] | None:
    """Return inode and time of a file, which one that replaces it changes; None if none."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def _reason(code: int, text: str) -> str:
    if code < 0:
        return f"the process was ended by {signal.Signals(-code).name}"
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    found = lines[-1].removeprefix("error: ") if lines else text[-_LONGEST_ERROR:]
    return found[:_LONGEST_ERROR] or f"the process ended with exit code {code}"
