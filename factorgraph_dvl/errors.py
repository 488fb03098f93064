"""Errors that users can act on: what is wrong, where, what was expected."""

from __future__ import annotations


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
        self.what = what
        self.where = where
        self.expected = expected
        self.hint = hint
        text = f"{where}: {what}" if where else what
        if expected:
            text += f"; expected {expected}"
        if hint:
            text += f". {hint}"
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
