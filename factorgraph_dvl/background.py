"""Work in a second process, which goes on beside the first one."""

from __future__ import annotations

import copyreg
import gc
import os
import pickle
import select
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, cached_property, partial
from threading import current_thread, main_thread
from types import MappingProxyType
from typing import Any, BinaryIO, Generic, NoReturn, Protocol, TypeVar

# Number of processes that a run may have. The command line sets it unless the user did. Without
# it there is one: a program with threads of its own cannot fork safely.
PROCESSES = "FACTORGRAPH_DVL_PROCESSES"
_PR_SET_PDEATHSIG = 1
# By how much less urgent second processes are. Chosen: half the time of the first one, where they
# share a core.
_LESS_URGENT = 3


_Input = TypeVar("_Input")
_Result = TypeVar("_Result")
_Result_co = TypeVar("_Result_co", covariant=True)


class Awaited(Protocol[_Result_co]):
    """Work whose result is awaited, and may be asked for again."""

    def __call__(self) -> _Result_co:
        """Return the result once it is there."""

    @property
    def is_there(self) -> bool:
        """Whether the result is there without waiting."""


@dataclass(frozen=True)
class _Later(Generic[_Result]):
    """Work that is done when its result is asked for."""

    work: Callable[[], _Result]
    is_there: bool = False

    def __call__(self) -> _Result:
        return self.work()


@dataclass(frozen=True)
class _Elsewhere:
    """Work that a second process does."""

    reply: BinaryIO

    @property
    def is_there(self) -> bool:
        """Whether the second process has begun to send its result."""
        return bool(select.select([self.reply], [], [], 0.0)[0])

    def __call__(self) -> Any:
        done, result = self._received
        if done:
            return result
        raise result

    @cached_property
    def _received(self) -> tuple[bool, Any]:
        """Whether the work was done, and its result or error."""
        try:
            done, result = pickle.load(self.reply)
        except EOFError:
            return False, MemoryError("a second process was killed")
        return done, result


def _unchanging(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    """Return a mapping that cannot be changed; Python does not pickle such by itself."""
    return MappingProxyType(values)


copyreg.pickle(MappingProxyType, lambda mapping: (_unchanging, (dict(mapping),)))


@contextmanager
def in_background(
    work: Callable[[], _Result], *, urgent: bool = False
) -> Iterator[Awaited[_Result]]:
    """Start work in a second process, and yield what waits for its result.

    The second process begins as a copy of this one: it has all data, and only its result is sent
    back. It ends with the block, whether its result was asked for or not. Where there may be one
    process only, the work is done when its result is asked for.

    Parameters
    ----------
    work : callable
        Returns a result that can be pickled. It prints nothing.
    urgent : bool, default False
        Whether it is as urgent as what this process does meanwhile.

    Raises
    ------
    Exception
        What the work raises, from the callable that is yielded.
    MemoryError
        From that callable, if the system killed the second process.

    Examples
    --------
    >>> with in_background(lambda: sum(range(5))) as total:
    ...     total()
    10
    """
    with on_standby(lambda _: work(), urgent=urgent) as start:
        yield start(None)


@contextmanager
def on_standby(
    work: Callable[[_Input], _Result],
    prepare: Callable[[], object] = bool,
    *,
    urgent: bool = False,
) -> Iterator[Callable[[_Input], Awaited[_Result]]]:
    """Start a second process that waits for input, and yield what starts its work.

    That returns what waits for the result; all else is as of `in_background`.

    Parameters
    ----------
    work : callable
        Takes an input that can be pickled, and returns a result that can be.
    prepare : callable, optional
        What the second process does first, such as loading modules.
    urgent : bool, default False
        As of `in_background`.

    Examples
    --------
    >>> with on_standby(sum) as start:
    ...     total = start([1, 2])
    ...     total()
    3
    """
    second = _fork(work, prepare, urgent=urgent) if available() else None
    if second is None:
        yield lambda given: _Later(cache(partial(work, given)))
        return
    process, order, reply = second

    def start(given: _Input) -> Awaited[_Result]:
        # Of a process that was killed the reply ends early.
        with suppress(BrokenPipeError), order:
            pickle.dump(given, order, protocol=pickle.HIGHEST_PROTOCOL)
        return _Elsewhere(reply)

    try:
        with reply:
            yield start
    finally:
        with suppress(BrokenPipeError):
            order.close()
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)


def available() -> bool:
    """Whether a run may have a second process, and a core for it."""
    # Elsewhere libraries of the system do not bear to be copied.
    if sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        return False
    return os.environ.get(PROCESSES, "1") != "1"


def _fork(
    work: Callable[[Any], Any], prepare: Callable[[], object], *, urgent: bool
) -> tuple[int, BinaryIO, BinaryIO] | None:
    """Return the second process, where its input goes to and where its reply comes from.

    None without means for it.
    """
    parent = os.getpid()
    pipes = (*os.pipe(), *os.pipe())
    order, given, reply, result = pipes
    with _interrupts_wait():
        try:
            process = os.fork()
        except OSError:
            for end in pipes:
                os.close(end)
            return None
        if process == 0:
            os.close(given)
            if not urgent:
                os.nice(_LESS_URGENT)
            _work(work, prepare, order, result, parent)
    os.close(order)
    os.close(result)
    return process, os.fdopen(given, "wb"), os.fdopen(reply, "rb")


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Let interrupts wait for the end of the block.

    Python loses an interrupt that comes while it calls what belongs to a fork, and a copy of this
    process that is interrupted before it works would clean up what the first process still needs.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is None or current_thread() is not main_thread():
        yield
        return
    came: list[object] = []
    signal.signal(signal.SIGINT, lambda *_: came.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


def _work(
    work: Callable[[Any], Any],
    prepare: Callable[[], object],
    order: int,
    result: int,
    parent: int,
) -> NoReturn:
    """Do the work of the second process, send its result or error, and end."""
    import ctypes

    try:
        # The first process ends it, also where that is killed, and alone keeps its files locked.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        _leave_files({0, 1, 2, order, result})
        if os.getppid() == parent:
            # Collecting what the first process made would copy it.
            gc.freeze()
            with os.fdopen(order, "rb") as given, os.fdopen(result, "wb") as reply:
                reply.write(_reply(work, prepare, given))
    finally:
        # Nothing of what the first process has to clean up is cleaned up here.
        os._exit(0)


def _leave_files(kept: Collection[int]) -> None:
    """Close what is open but some descriptors, and have nothing in its place.

    Libraries that close their own when this process is copied again would fail: Arrow then ends
    the copy.
    """
    opened = map(int, os.listdir("/proc/self/fd"))
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in {*opened} - {*kept, nothing}:
        os.dup2(nothing, number, inheritable=False)


def _reply(work: Callable[[Any], Any], prepare: Callable[[], object], given: BinaryIO) -> bytes:
    """Return whether the work was done, and its result or error, as bytes."""
    try:
        prepare()
        done = work(pickle.load(given))
        return pickle.dumps((True, done), protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        return pickle.dumps((False, error), protocol=pickle.HIGHEST_PROTOCOL)
