"""Interrupts of a command: each ends it, wherever it comes."""

from __future__ import annotations

import atexit
import signal
import sys
from contextlib import suppress
from types import FrameType

_came = False
_ended = False


class Interrupted(KeyboardInterrupt):
    """The interrupt of a command.

    A plain KeyboardInterrupt within `exec` or `eval`, as while modules are loaded, has Python kill
    its own process in the end, whatever the program does about it.
    """


def watch() -> None:
    """Let an interrupt raise `Interrupted`, unless interrupts are ignored or somebody else's."""
    global _came, _ended
    _came = _ended = False
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Only the main thread may do so.
        with suppress(ValueError):
            signal.signal(signal.SIGINT, _interrupt)
            sys.unraisablehook = _unraisable


def came() -> bool:
    """Return whether an interrupt came, also one that a library lost."""
    return _came


def check() -> None:
    """Raise `Interrupted` if an interrupt came that a library lost."""
    if _came and not _ended:
        raise Interrupted


def end() -> None:
    """Let interrupts do nothing any more: all is done, and Python takes a while to end."""
    global _ended
    _ended = True
    atexit.register(_ignore)


def _ignore() -> None:
    # Python gives signals back to the system before the process has ended.
    if signal.getsignal(signal.SIGINT) is _interrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _came
    if not _ended:
        _came = True
        raise Interrupted


def _unraisable(lost: sys.UnraisableHookArgs) -> None:
    # Python cannot raise in a destructor. `check` does it instead.
    if not isinstance(lost.exc_value, Interrupted):
        sys.__unraisablehook__(lost)
