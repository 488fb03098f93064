"""Errors that users can act on: what is wrong, where, what was expected."""

from __future__ import annotations

from factorgraph_dvl.text import printable


class FactorgraphDvlError(Exception):
    """Base of every error raised on purpose.

    Parameters
    ----------
    what : str
        What is wrong, in one sentence.
    where : str, optional
        File, line, key or column it was found in.
    expected : str, optional
        What would have been right.
    hint : str, optional
        What to try.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: str = "", expected: str = "", hint: str = "") -> None:
        # Names, keys and cells in it are those of files, whatever these hold.
        self.what, self.where = printable(what), printable(where)
        self.expected, self.hint = printable(expected), printable(hint)
        text = f"{self.where}: {self.what}" if where else self.what
        if expected:
            text += f"; expected {self.expected}"
        if hint:
            text += f". {self.hint}"
        super().__init__(text)


class ConfigError(FactorgraphDvlError):
    """A setting is missing, unknown or out of range."""

    exit_code = 2


class DataError(FactorgraphDvlError):
    """A data file or record does not hold what it should."""

    exit_code = 2


class SolveError(FactorgraphDvlError):
    """The input was valid, but no trustworthy solution was found."""

    exit_code = 1
