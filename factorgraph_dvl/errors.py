"""Errors that users can act on: what is wrong, where, what was expected."""

from __future__ import annotations

import re
import unicodedata

# As which Python shows bytes of names that it cannot decode.
_UNKNOWN_BYTES = re.compile("[\udc80-\udcff]+")


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

    Examples
    --------
    >>> from factorgraph_dvl import FactorgraphDvlError, load_trial
    >>> try:
    ...     load_trial("no-such-trial")
    ... except FactorgraphDvlError as error:
    ...     print(error)
    no-such-trial: the trial does not exist; expected a trial folder
    """

    def __init__(self, what: str, *, where: str = "", expected: str = "", hint: str = "") -> None:
        # Names, keys and cells in it are those of files, whatever these hold.
        self.what, self.where = printable(what), printable(where)
        self.expected, self.hint = printable(expected), printable(hint)
        text = f"{self.where}: {self.what}" if where else self.what
        if expected:
            text += f"; expected {self.expected}"
        if hint:
            text += f" {self.hint}" if text.endswith("?") else f". {self.hint}"
        super().__init__(text)


class ConfigError(FactorgraphDvlError):
    """A setting is missing, unknown or out of range.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> fd.solve(fd.simulate("examples/short.yaml", seed=1), rate_hz=-1.0)
    Traceback (most recent call last):
    factorgraph_dvl.errors.ConfigError: rate_hz is -1.0; expected a number above 0
    """


class DataError(FactorgraphDvlError):
    """A data file or record does not contain what it should.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> fd.load_solution("no-such-solution")
    Traceback (most recent call last):
    factorgraph_dvl.errors.DataError: ...
    """


class SolveError(FactorgraphDvlError):
    """The input was valid, but no trustworthy solution was found.

    Examples
    --------
    >>> from factorgraph_dvl import SolveError
    >>> print(SolveError("the cost at the start is not finite", hint="Check the units."))
    the cost at the start is not finite. Check the units.
    """


class OutputError(FactorgraphDvlError):
    """Results were found, and could not be written."""


def as_text(name: object) -> str:
    r"""Return the name of a file as text that any file in UTF-8 can contain.

    Where Python does not know the encoding of names, they are taken to be in UTF-8; bytes that
    are not are escaped, such as `\xff`.
    """
    return _UNKNOWN_BYTES.sub(
        lambda found: (
            found[0].encode("ascii", "surrogateescape").decode("utf-8", "backslashreplace")
        ),
        str(name),
    )


def printable(text: str) -> str:
    r"""Return text with what does not print escaped, such as `\x1b` and `\u202e`.

    These are control characters, which a terminal obeys, marks that turn the direction of
    writing, and line breaks. Spaces of all scripts stay.
    """
    if text.isprintable():
        return text
    text = as_text(text)
    return "".join(
        c
        if c.isprintable() or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )
