"""Interrupts end a command with exit code 130 and one line, wherever they come."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from builders import write_trial

from factorgraph_dvl.cli import interrupts

# What runs when a module is loaded, or instead of a command; each loses an interrupt, or has
# Python kill its process for it.
PLACES = {
    "in exec": "exec('import signal; signal.raise_signal(signal.SIGINT)')",
    "where a class is made": (
        "class Named:\n"
        "    def __set_name__(self, owner, name): signal.raise_signal(signal.SIGINT)\n"
        "class Owner: named = Named()"
    ),
    "in a destructor": (
        "class Dying:\n    def __del__(self): signal.raise_signal(signal.SIGINT)\nDying()"
    ),
    "where all is caught": ("try: signal.raise_signal(signal.SIGINT)\nexcept BaseException: pass"),
    "where it becomes another error": (
        "try: signal.raise_signal(signal.SIGINT)\n"
        "except BaseException: raise ImportError('no such module') from None"
    ),
}


def interrupted(place: str, module: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a new process where a module runs code before it is loaded."""
    script = f"""
import signal, sys
# Also where the tests run in the background, which ignores interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
class Place:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r} and self in sys.meta_path:
            sys.meta_path.remove(self)
            exec(compile({place!r}, "place", "exec"), {{"signal": signal}})
sys.meta_path.insert(0, Place())
from factorgraph_dvl.cli import main
main({list(args)!r})
"""
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("module", ["typer", "pyarrow"])
def test_an_interrupt_is_not_lost(tmp_path: Path, place: str, module: str) -> None:
    done = interrupted(PLACES[place], module, "inspect", str(write_trial(tmp_path)))
    assert (done.returncode, done.stderr) == (130, "error: interrupted\n")


@pytest.mark.parametrize("place", PLACES)
def test_an_interrupt_is_an_event(tmp_path: Path, place: str) -> None:
    trial = write_trial(tmp_path)
    done = interrupted(PLACES[place], "pyarrow", "--json", "inspect", str(trial))
    assert (done.returncode, done.stderr) == (130, "")
    *_, error, end = done.stdout.splitlines()
    assert error.startswith('{"event":"error","text":"interrupted","kind":"interrupted"')
    assert end == '{"event":"end","exit_code":130}'


def test_a_long_run_ends_at_the_next_step_after_an_interrupt_that_was_lost(tmp_path: Path) -> None:
    trial, out = write_trial(tmp_path), tmp_path / "out"
    done = interrupted(PLACES["in a destructor"], "gtsam", "solve", str(trial), "--out", str(out))
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")
    assert not out.exists()


def test_an_interrupt_after_the_end_changes_nothing() -> None:
    # Callbacks at the end of Python, and what it does without them, take a while.
    script = """
import atexit, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
class Last:
    def __del__(self, raise_signal=signal.raise_signal): raise_signal(2)
last = Last()
atexit.register(signal.raise_signal, signal.SIGINT)
from factorgraph_dvl.cli import main
main(["--version"])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("factorgraph-dvl ")


def test_an_interrupt_after_the_last_event_does_not_contradict_it() -> None:
    script = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from factorgraph_dvl.cli import events, main
emit = events.emit
def interrupted(event):
    emit(event)
    if isinstance(event, events.End):
        signal.raise_signal(signal.SIGINT)
events.emit = interrupted
main(["--json", "--version"])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == '{"event":"end","exit_code":0}'


def test_a_handler_of_somebody_else_stays() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        interrupts.watch()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
