"""Messages: the key of a sentence and its values; the texts are in `quality/texts.json`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, Union

import numpy as np

Value: TypeAlias = Union[str, int, float, "Message", tuple["Value", ...]]


@dataclass(frozen=True)
class Message:
    """A sentence of the catalogue, with its values; `quality.texts.text_of` writes it.

    Parameters
    ----------
    key : str
        Its place in the catalogue: a group, such as the code of a finding, and a name.
    values : tuple of (str, Value), optional
        Values by the names of the template. A value may be a message itself.
    """

    key: str
    values: tuple[tuple[str, Value], ...] = ()

    def with_words(self, change: Callable[[str], str]) -> Message:
        """Return the message with every word among its values changed, such as names of files."""

        def changed(value: Value) -> Value:
            if isinstance(value, Message):
                return value.with_words(change)
            if isinstance(value, tuple):
                return tuple(map(changed, value))
            return change(value) if isinstance(value, str) else value

        return Message(self.key, tuple((name, changed(value)) for name, value in self.values))


def message(key: str, **values: object) -> Message:
    """Return a message; arrays and NumPy's numbers become plain ones.

    Parameters
    ----------
    key : str
        Key as in `Message`.
    **values : str, float, Message, ndarray or sequence of these
        Values by the names of the template.
    """
    return Message(key, tuple((name, plain(value)) for name, value in values.items()))


def plain(value: object) -> Value:
    """Return a value as messages contain it.

    Raises
    ------
    TypeError
        If a message contains no such values.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(map(plain, value))
    if isinstance(value, str | int | float | Message):
        return value
    raise TypeError(f"no value of a message: {value!r}")


def encoded(said: Message) -> dict[str, Any]:
    """Return a message as plain data for JSON: its key and its values."""

    def written(value: Value) -> Any:
        if isinstance(value, Message):
            return encoded(value)
        return list(map(written, value)) if isinstance(value, tuple) else value

    return {"key": said.key, "values": {name: written(value) for name, value in said.values}}


def together(parts: Sequence[Message | str]) -> Message | str:
    """Return parts, joined by "and"."""
    first, *rest = parts
    return message("words.and", first=first, rest=together(rest)) if rest else first


def either(parts: Sequence[Message | str]) -> Message | str:
    """Return alternatives, joined by "or"."""
    first, *rest = parts
    return message("words.or", first=first, rest=either(rest)) if rest else first
