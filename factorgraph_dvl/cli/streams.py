"""Standard output and standard error whose failures do not stop a run."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Stream(io.FileIO):
    """A descriptor that stores its first failure instead of raising it, and then drops output."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        if self.failure is None:
            try:
                return super().write(data) or 0
            except OSError as error:
                self.failure = error
        return memoryview(data).nbytes


def guard_streams() -> None:
    """Drop output that cannot be written instead of failing.

    A stream that a caller has replaced is not changed; a closed one discards its output.
    """
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is None:
            _occupy(number)
        elif stream is not getattr(sys, f"__{name}__") or _is_guarded(stream):
            continue
        else:
            stream.flush()
        guarded = io.TextIOWrapper(
            io.BufferedWriter(_Stream(number, "w", closefd=False)),
            # A terminal without µ must not fail a run.
            encoding=getattr(stream, "encoding", "utf-8"),
            errors="replace",
            line_buffering=os.isatty(number) or number == 2,
        )
        setattr(sys, name, guarded)
        setattr(sys, f"__{name}__", guarded)


def _is_guarded(stream: Any) -> bool:
    return isinstance(_raw(stream), _Stream)


def _raw(stream: Any) -> Any:
    return getattr(getattr(stream, "buffer", None), "raw", None)


def output_failure() -> OSError | None:
    """Return why results could not be printed; None if they were.

    A reader that closes the pipe, such as `head`, is not a failure.
    """
    if not _is_guarded(sys.stdout):
        return None
    sys.stdout.flush()
    failure: OSError | None = _raw(sys.stdout).failure
    return None if isinstance(failure, BrokenPipeError) else failure


def _occupy(number: int) -> None:
    # Otherwise the next file to be opened would get this descriptor.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
