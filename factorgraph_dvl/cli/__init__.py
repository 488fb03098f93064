"""The command line: parse, load, call, report, exit code."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

from factorgraph_dvl.cli.exit_codes import INTERRUPTED


def main(argv: list[str] | None = None) -> NoReturn:
    """Run the command line and exit.

    `cli.exit_codes` says with which code.

    Parameters
    ----------
    argv : list of str, optional
        Arguments; by default those of the process.
    """
    # Arrow's own allocator takes memory beside what the C library keeps of freed arrays. Measured:
    # 50 MB while the results of a trial of 80 minutes are written.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    try:
        _run(sys.argv[1:] if argv is None else argv)
    except KeyboardInterrupt:
        if sys.stderr is not None:
            sys.stderr.write("error: interrupted\n")
        sys.exit(INTERRUPTED)


def _run(args: list[str]) -> NoReturn:
    # Loading takes long enough to be interrupted.
    from factorgraph_dvl.cli import interrupts

    interrupts.watch()
    try:
        from factorgraph_dvl.cli.app import run

        run(args)
    except Exception as error:
        if interrupts.came():
            raise KeyboardInterrupt from error
        raise
    finally:
        interrupts.end()
