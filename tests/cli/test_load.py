"""Commands four at a time on two cores, some of them interrupted: as alone on a quiet machine.

FACTORGRAPH_DVL_LOAD sets the number of runs, 20 by default.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path

import format_writers as writers
import pytest
from kinds import TRIALS

from factorgraph_dvl.files.trial_folder import save_trial

RUNS = int(os.environ.get("FACTORGRAPH_DVL_LOAD", "20"))
# Codes that docs/format.md lists.
_DONE, _INTERRUPTED = (0, 1, 2), 130
_COMMANDS = (
    *(("solve", f"../{name}") for name in TRIALS),
    ("--json", "solve", "../imu"),
    ("--json", "solve", "../beacon"),
    ("replay", "../imu"),
    ("replay", "../ship"),
    ("import", "../receiver.log"),
)
# Lines of events after which a run is interrupted, from the first on.
_AFTER = (1, 2, 3, 5, 8)
# Of three runs one is interrupted: with ten commands, each of them in turn.
_EVERY = 3
# What a replay writes of the time that it took.
_TIMES = ("latency.csv", "latency.png")


@dataclass(frozen=True)
class Ended:
    """How a run ended: its code, what it printed, its files, and what it left elsewhere."""

    code: int
    printed: list[str]
    files: dict[str, bytes]
    left: list[str]


@dataclass(frozen=True)
class Job:
    """A command, the arguments that it is given, and after which line it is interrupted."""

    number: int
    command: tuple[str, ...]
    given: tuple[str, ...]
    after: int | None


def job(number, command):
    """Return a command of many, of which every third is interrupted."""
    if number % _EVERY != _EVERY - 1:
        return Job(number, command, command, None)
    # Events come while a command works, text when it has ended.
    given = command if "--json" in command else ("--json", *command)
    return Job(number, command, given, _AFTER[number // _EVERY % len(_AFTER)])


@pytest.fixture(autouse=True)
def interruptible():
    """Interrupts reach commands, also where a shell has started the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("load")
    for name, make in TRIALS.items():
        save_trial(make(), folder / name)
    lines = (
        writers.nmea(f"GPRMC,0920{i:02d},A,5321.68{i:02d},N,00630.3372,W,1.5,10.0,250722,,,A")
        for i in range(30)
    )
    (folder / "receiver.log").write_bytes(b"".join(lines))
    return folder


def run(folder, command, after=None):
    """Run a command in a new folder; interrupt it after so many lines of output."""
    place, temporary = folder / "place", folder / "tmp"
    place.mkdir(parents=True)
    temporary.mkdir()
    with subprocess.Popen(
        [sys.executable, "-m", "factorgraph_dvl.cli", *command, "--out", "place/out"],
        cwd=folder,
        env=os.environ | {"PYTHONFAULTHANDLER": "1", "TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        printed = []
        for line in process.stdout:
            printed.append(line)
            if len(printed) == after:
                process.send_signal(signal.SIGINT)
    found = {path.relative_to(place).as_posix(): path for path in sorted(place.rglob("*"))}
    beside = [name for name in found if not name.startswith("out")]
    return Ended(
        process.returncode,
        [line for line in map(untimed, printed) if line],
        {name: content(path) for name, path in found.items() if path.name not in _TIMES},
        [*processes_of(temporary), *(path.name for path in temporary.iterdir()), *beside],
    )


def processes_of(temporary):
    """Return the command lines of the processes that have this folder for temporary files."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        # Others may end meanwhile, or belong to another user.
        with suppress(OSError):
            if os.fsencode(f"TMPDIR={temporary}\0") in (process / "environ").read_bytes():
                found.append((process / "cmdline").read_text().replace("\0", " "))
    return found


def content(path):
    """Return the content of a file without times that the run took; of a folder nothing."""
    if path.is_dir():
        return b""
    if path.name != "history.csv":
        return path.read_bytes()
    rows = list(csv.reader(path.open()))
    timed = rows[0].index("latency_ms") if "latency_ms" in rows[0] else len(rows[0])
    return str([row[:timed] + row[timed + 1 :] for row in rows]).encode()


def untimed(line):
    """Return a printed line without times that the run took; nothing if it is about progress."""
    if line.startswith('{"event":"progress"') or re.match(r" *\d+\.\d s: ", line):
        return ""
    return re.sub(r"latency.*longest \S+", "", line)


def wrong(job, ended, quiet):
    """Return what is wrong with a run, nothing if all is well."""
    if ended.left:
        return f"left {ended.left}"
    end = f'{{"event":"end","exit_code":{ended.code}}}\n'
    if "--json" in job.given and ended.printed[-1:] != [end]:
        return "has no last event"
    if job.after and ended.code == _INTERRUPTED:
        # The interrupt may come after the result appeared.
        return "left a part of its result" if ended.files not in ({}, quiet.files) else ""
    if ended.code not in _DONE or ended.code != quiet.code:
        return "has another exit code than alone"
    names = {*ended.files, *quiet.files}
    if differ := [name for name in names if ended.files.get(name) != quiet.files.get(name)]:
        return f"has other files than alone: {differ}"
    if job.given == job.command and ended.printed != quiet.printed:
        return "printed something else than alone"
    return ""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="it holds its processes on two cores")
def test_commands_under_load_end_as_they_do_alone(inputs):
    quiet = {c: run(inputs / f"quiet-{n}", c) for n, c in enumerate(_COMMANDS)}
    for command, ended in quiet.items():
        assert ended.code in _DONE, (command, ended)
        assert ended.files, command
        assert not ended.left, (command, ended.left)

    def under_load(job):
        folder = inputs / f"run-{job.number}"
        ended = run(folder, job.given, job.after)
        shutil.rmtree(folder)
        said = wrong(job, ended, quiet[job.command])
        return ended.code, said and f"{job} {said}: {ended.code}, {''.join(ended.printed)}"

    jobs = [job(number, command) for number, command in enumerate(islice(cycle(_COMMANDS), RUNS))]
    two = sorted(os.sched_getaffinity(0))[:2]
    with ThreadPoolExecutor(4, initializer=os.sched_setaffinity, initargs=(0, two)) as pool:
        found = list(pool.map(under_load, jobs))
    failed = [said for _, said in found if said]
    assert not failed, f"{len(failed)} of {RUNS}:\n" + "\n".join(failed)
    interrupted = [code for code, _ in found].count(_INTERRUPTED)
    assert interrupted > len(jobs) // (2 * _EVERY)
