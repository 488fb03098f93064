"""Exit codes of the commands: what each means, and with which one an error ends."""

from __future__ import annotations

from factorgraph_dvl.errors import ConfigError, DataError

DONE = 0
# Valid input, and no result that can be used; or one that could not be written.
NO_RESULT = 1
# Bad input, or wrong usage.
BAD_INPUT = 2
# After an interrupt, as in Typer.
INTERRUPTED = 130


def exit_code_of(error: BaseException) -> int:
    """Return the exit code of a command that an error ends."""
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    wrong_usage = hasattr(error, "format_message")
    bad = isinstance(error, ConfigError | DataError | OSError) or wrong_usage
    return BAD_INPUT if bad else NO_RESULT
