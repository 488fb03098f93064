from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import pytest
from pyarrow import csv

from factorgraph_dvl.background import PROCESSES, available, in_background, on_standby
from factorgraph_dvl.errors import DataError


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROCESSES, "2")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})


def refuse() -> None:
    error = DataError("is empty", where="dvl.csv", hint="Look at it")
    error.add_note("note")
    raise error


@pytest.mark.usefixtures("two")
def test_a_second_process_sends_its_result() -> None:
    with in_background(os.getpid) as found:
        second = found()
    assert second != os.getpid()


@pytest.mark.parametrize("processes", ["1", "2"])
def test_a_result_may_be_asked_for_again(
    processes: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(PROCESSES, processes)
    file = tmp_path / "done"

    def work() -> int:
        with file.open("a") as done:
            done.write(".")
        return 7

    with in_background(work) as found, in_background(refuse) as refused:
        assert [found(), found()] == [7, 7]
        for _ in range(2):
            with pytest.raises(DataError, match="is empty"):
                refused()
    assert file.read_text() == "."


@pytest.mark.usefixtures("two")
def test_whether_a_result_is_there() -> None:
    with in_background(lambda: time.sleep(0.5)) as found:
        assert not found.is_there
        time.sleep(2.0)
        assert found.is_there
        assert found() is None


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("urgent", [False, True])
def test_a_second_process_is_less_urgent_unless_it_is_said(urgent: bool) -> None:
    with in_background(lambda: os.nice(0), urgent=urgent) as found:
        assert (found() > os.nice(0)) == (not urgent)


@pytest.mark.usefixtures("two")
def test_results_larger_than_a_pipe_arrive() -> None:
    with in_background(lambda: bytes(1_000_000)) as found:
        assert len(found()) == 1_000_000


@pytest.mark.usefixtures("two")
def test_an_error_of_the_second_process_is_one_of_the_first() -> None:
    with in_background(refuse) as found, pytest.raises(DataError, match="is empty") as caught:
        found()
    assert caught.value.where == "dvl.csv"
    assert caught.value.hint == "Look at it"
    assert caught.value.__notes__ == ["note"]


@pytest.mark.usefixtures("two")
def test_a_result_that_cannot_be_sent_is_an_error() -> None:
    with (
        in_background(lambda: lambda: None) as found,
        pytest.raises(AttributeError, match="pickle"),
    ):
        found()


@pytest.mark.usefixtures("two")
def test_a_second_process_that_is_killed_is_an_error() -> None:
    def end() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with in_background(end) as found, pytest.raises(MemoryError, match="killed"):
        found()


@pytest.mark.usefixtures("two")
def test_it_ends_with_the_block_and_cleans_up_nothing_of_the_first(tmp_path: Path) -> None:
    marker, started = tmp_path / "marker", tmp_path / "started"

    def work() -> None:
        started.write_text(str(os.getpid()))
        time.sleep(60.0)

    def interrupted() -> None:
        try:
            with in_background(work):
                while not started.exists() or not started.read_text():
                    time.sleep(0.01)
                raise KeyboardInterrupt
        finally:
            marker.write_text(marker.read_text() + "." if marker.exists() else ".")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)
    assert marker.read_text() == "."


@pytest.mark.usefixtures("two")
def test_a_second_process_may_have_one_of_its_own_after_arrow_has_read(tmp_path: Path) -> None:
    """Arrow closes a pipe of its own in every copy, and ends it if that fails."""
    table = tmp_path / "table.csv"
    table.write_text("a,b\n1,2\n")
    assert csv.read_csv(table).num_rows == 1

    def nested() -> int:
        with in_background(lambda: 2) as found:
            return found()

    with in_background(nested) as found:
        assert found() == 2


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Interrupts end a test, also where a shell started it in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("where", ["parent", "child"])
@pytest.mark.usefixtures("two", "interruptible")
def test_an_interrupt_during_the_fork_ends_the_first_process_alone(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cleaned, fork = tmp_path / "cleaned", os.fork

    def interrupted_fork() -> int:
        process = fork()
        if (process == 0) == (where == "child"):
            signal.raise_signal(signal.SIGINT)
        return process

    monkeypatch.setattr(os, "fork", interrupted_fork)

    def run() -> None:
        try:
            with in_background(lambda: 1) as found:
                assert found() == 1
        finally:
            with cleaned.open("a") as file:
                file.write(f"{os.getpid()}\n")

    if where == "parent":
        with pytest.raises(KeyboardInterrupt):
            run()
    else:
        run()
    assert cleaned.read_text() == f"{os.getpid()}\n"


@pytest.mark.parametrize("why", ["one process", "one core", "no fork", "another system"])
@pytest.mark.usefixtures("two")
def test_otherwise_the_work_is_done_in_line(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert available()
    if why == "one process":
        monkeypatch.delenv(PROCESSES)
    elif why == "one core":
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    elif why == "another system":
        monkeypatch.setattr("sys.platform", "darwin")
    else:

        def fail() -> int:
            raise OSError("no more processes")

        monkeypatch.setattr(os, "fork", fail)
    with in_background(os.getpid) as found:
        assert found() == os.getpid()
    with in_background(refuse) as found, pytest.raises(DataError, match="is empty"):
        found()


@pytest.mark.usefixtures("two")
def test_a_process_on_standby_takes_what_was_made_after_it_began() -> None:
    made: list[int] = []
    with on_standby(lambda given: (made, given), lambda: made.append(1)) as start:
        made.append(2)
        wait = start(MappingProxyType({"a": 3}))
        assert wait() == ([1], {"a": 3})


@pytest.mark.usefixtures("two")
def test_an_error_before_the_work_is_one_of_the_first_too() -> None:
    with on_standby(lambda given: given, refuse) as start, pytest.raises(DataError, match="empty"):
        start(1)()


@pytest.mark.usefixtures("two")
def test_a_process_that_died_on_standby_is_an_error() -> None:
    def end() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with on_standby(lambda given: given, end) as start:
        time.sleep(0.1)
        with pytest.raises(MemoryError, match="killed"):
            start(bytes(1_000_000))()


def test_without_a_second_process_nothing_is_prepared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PROCESSES, raising=False)
    with on_standby(lambda given: given + 1, refuse) as start:
        assert start(1)() == 2
