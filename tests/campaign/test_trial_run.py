"""A trial of a campaign: its process ends with the worker that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

WORKER = """
import signal, sys
# Also where the tests run in the background, which ignores interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
from factorgraph_dvl.campaign.trial_run import run_trial
sys.executable, trial, out = sys.argv[1:]
run_trial(trial, "a", out, [])
"""
# Stands where Python does, and solves for long.
SOLVE = """\
#!/bin/sh
echo $$ > "$0.started"
mv "$0.started" "$0.pid"
exec sleep 600
"""


def runs(process: int) -> bool:
    """Whether a process is there, and no more than its exit code."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def until(condition) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_told(process: int) -> bool:
    """Whether the system will tell a process that its standard input was closed."""
    lines = Path(f"/proc/{process}/fdinfo/0").read_text().splitlines()
    info = dict(line.split(":", 1) for line in lines)
    return bool(int(info["flags"], 8) & os.O_ASYNC)


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_its_worker(tmp_path, by):
    solve = tmp_path / "solve"
    solve.write_text(SOLVE)
    solve.chmod(0o755)
    (tmp_path / "trial").mkdir()
    (tmp_path / "trial" / "trial.yaml").write_text("format: 1\n")
    command = [sys.executable, "-c", WORKER, solve, tmp_path / "trial", tmp_path / "out"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as worker:
        pid = tmp_path / "solve.pid"
        until(pid.exists)
        process = int(pid.read_text())
        until(lambda: is_told(process))
        assert runs(process)
        worker.send_signal(by)
        worker.wait(60)
    until(lambda: not runs(process))


def test_a_solve_that_ends_by_itself_is_waited_for(tmp_path):
    solve = tmp_path / "solve"
    solve.write_text("#!/bin/sh\necho 'error: no IMU' >&2\nexit 2\n")
    solve.chmod(0o755)
    (tmp_path / "trial").mkdir()
    (tmp_path / "trial" / "trial.yaml").write_text("format: 1\n")
    command = [sys.executable, "-c", WORKER, solve, tmp_path / "trial", tmp_path / "out"]
    subprocess.run(command, check=True, timeout=60)
    assert '"error":"no IMU"' in (tmp_path / "out/trials/a.json").read_text().replace(": ", ":")
