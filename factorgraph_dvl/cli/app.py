"""The application: its commands, its output streams, its errors."""

from __future__ import annotations

import atexit
import gc
import io
import os
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from io import StringIO
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from factorgraph_dvl.cli import interrupts
from factorgraph_dvl.cli.commands import Commands, lost_folder
from factorgraph_dvl.cli.exit_codes import BAD_INPUT, DONE, INTERRUPTED, NO_RESULT, exit_code_of
from factorgraph_dvl.cli.options import claims
from factorgraph_dvl.errors import FactorgraphDvlError, OutputError, printable

if TYPE_CHECKING:
    from factorgraph_dvl.cli.events import FailureKind


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


_NAME = "factorgraph-dvl"
# Objects made before garbage is collected. Chosen: some ten megabytes.
_ALLOCATIONS = 50_000
# Options that stand anywhere on the line.
_EVERYWHERE = ("--debug", "--json")
_NO_PARTS: Mapping[str, str] = {}

app = typer.Typer(
    name=_NAME,
    cls=Commands,
    help="Calibrate a Doppler velocity log, jointly with the trajectory of its vehicle.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def run(args: list[str]) -> NoReturn:
    """Run a command and exit; see `factorgraph_dvl.cli.main`."""
    # All matrices are small: more threads only slow each other down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Most objects live until the end: looking for garbage among them took 4 % of a run.
    gc.set_threshold(_ALLOCATIONS)
    # Nor is it worth while when the process ends. Measured: 16 % of `--help`.
    atexit.register(gc.freeze)
    guard_streams()
    try:
        if "--json" in args:
            _run_with_events(args)
        _run(args)
    except SystemExit as done:
        failure = output_failure()
        if failure is None:
            raise
        complete = "" if done.code else "; the files of this run are complete"
        message = f"standard output cannot be written ({failure.strerror}){complete}"
        _fail(message, _code_of(done) or NO_RESULT, args, "output")


def _run_with_events(args: list[str]) -> NoReturn:
    from factorgraph_dvl.cli import events

    events.switch(True)
    code = INTERRUPTED
    try:
        try:
            if "--help" in args:
                _emit_help(args)
            # Typer would print its help.
            if not set(args) - set(_EVERYWHERE):
                _fail("the command is missing", BAD_INPUT, args, "usage")
            _run(args)
        except SystemExit as done:
            # The last event states the exit code: no interrupt may change it any more.
            interrupts.end()
            code = _code_of(done)
    except KeyboardInterrupt:
        interrupts.end()
        events.emit(events.Failed("interrupted", "interrupted"))
    try:
        events.emit(events.End(code))
    finally:
        events.switch(False)
    sys.exit(code)


def _code_of(done: SystemExit) -> int:
    return done.code if isinstance(done.code, int) else int(bool(done.code))


def _emit_help(args: list[str]) -> NoReturn:
    """Print help as an event."""
    from factorgraph_dvl.cli import events

    with redirect_stdout(StringIO()) as shown, suppress(SystemExit):
        _call(args)
    events.emit(events.Text(shown.getvalue()))
    sys.exit(DONE)


def _call(args: list[str]) -> None:
    """Call the command; with events, wrong usage is an exception for `_run`."""
    as_json = "--json" in args
    given = [arg for arg in args if arg not in _EVERYWHERE]
    code = app(args=given, prog_name=_NAME, standalone_mode=not as_json)
    if isinstance(code, int):
        sys.exit(code)


def _run(args: list[str]) -> NoReturn:
    try:
        with claims:
            _call(args)
        interrupts.check()
    except BaseException as error:
        if _is_interrupt(error):
            # Said without rich, which may be what was being loaded.
            raise KeyboardInterrupt from error
        _end_with(error, args)
    sys.exit(DONE)


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether an interrupt came; libraries turn it into errors of their own, or into none.

    Typer turns it into an exit.
    """
    if interrupts.came():
        return True
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _end_with(error: BaseException, args: list[str]) -> NoReturn:
    """Say an error, and end with its exit code."""
    if isinstance(error, OSError):
        error = lost_folder() or error
    if isinstance(error, FactorgraphDvlError):
        from factorgraph_dvl.cli.console import warn

        for note in getattr(error, "__notes__", ()):
            warn(note)
        parts = {name: getattr(error, name) for name in ("what", "where", "expected", "hint")}
        _fail(str(error), exit_code_of(error), args, _kind_of(error), parts)
    if isinstance(error, OSError):
        name = error.filename if error.filename is not None else "a file"
        _fail(f"{name}: {error.strerror or error}", exit_code_of(error), args, "system")
    if not isinstance(error, Exception):
        raise error
    # Typer's errors of usage have no public base class.
    if hasattr(error, "format_message"):
        _fail(error.format_message(), exit_code_of(error), args, "usage")
    hint = "" if "--debug" in args else ". Run with --debug to see where"
    _fail(
        f"internal error: {type(error).__name__}: {error}{hint}",
        exit_code_of(error),
        args,
        "internal",
    )


def _kind_of(error: FactorgraphDvlError) -> FailureKind:
    if isinstance(error, OutputError):
        return "output"
    return "input" if exit_code_of(error) == BAD_INPUT else "result"


def _fail(
    message: str,
    exit_code: int,
    args: list[str],
    kind: FailureKind,
    parts: Mapping[str, str] = _NO_PARTS,
) -> NoReturn:
    from rich.text import Text

    from factorgraph_dvl.cli import events
    from factorgraph_dvl.cli.console import stderr

    if "--debug" in args:
        stderr().print_exception()
    if events.active():
        events.emit(events.Failed(printable(message), kind, **parts))
        sys.exit(exit_code)
    stderr().print(Text(f"error: {printable(message)}", "red"), soft_wrap=True)
    sys.exit(exit_code)


def _show_version(value: bool) -> None:
    if value:
        from factorgraph_dvl import __version__
        from factorgraph_dvl.cli.console import stdout

        stdout().print(f"{_NAME} {__version__}", markup=False, highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_show_version, is_eager=True
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print events and results of any command as JSON lines (docs/events.md).",
        ),
    ] = False,
) -> None:
    pass
