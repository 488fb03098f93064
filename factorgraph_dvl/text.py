"""Text from files, made fit to be shown."""

from __future__ import annotations

import unicodedata


def printable(text: str) -> str:
    r"""Return text with what does not print escaped, such as `\x1b` and `\u202e`.

    These are control characters, which a terminal obeys, marks that turn the direction of
    writing, and line breaks. Spaces of all scripts stay.
    """
    if text.isprintable():
        return text
    return "".join(
        c
        if c.isprintable() or unicodedata.category(c) == "Zs"
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )
