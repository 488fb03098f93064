"""Messages: sentences with typed values, in English and in Chinese, from one catalogue."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from string import Formatter
from typing import Any, Literal, TypeAlias, Union

import numpy as np

Language = Literal["en", "zh"]
Value: TypeAlias = Union[str, int, float, "Message", tuple["Value", ...]]


@dataclass(frozen=True)
class Message:
    """A sentence of the catalogue, with its values.

    Parameters
    ----------
    key : str
        Its place in `messages.json`: a group, such as the code of a finding, and a name.
    values : tuple of (str, Value), optional
        Values by the names of the template. A value may be a message itself.
    """

    key: str
    values: tuple[tuple[str, Value], ...] = ()

    def text(self, language: Language = "en") -> str:
        """Return the sentence in a language."""
        template = templates(self.key)[language]
        return _FORMATTERS[language].vformat(template, (), dict(self.values))

    def with_words(self, change: Callable[[str], str]) -> Message:
        """Return the message with every word among its values changed, such as names of files."""

        def changed(value: Value) -> Value:
            if isinstance(value, Message):
                return value.with_words(change)
            if isinstance(value, tuple):
                return tuple(map(changed, value))
            return change(value) if isinstance(value, str) else value

        return Message(self.key, tuple((name, changed(value)) for name, value in self.values))

    def __str__(self) -> str:
        return self.text()


class _InLanguage(Formatter):
    """Formats messages inside of messages in the same language, and several values as a list."""

    def __init__(self, language: Language, separator: str) -> None:
        self._language: Language = language
        self._separator = separator

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a value as text; each of several by the same format.

        `|ping|pings` writes a number with its word, `~is|are` the word alone.
        """
        if format_spec[:1] in ("|", "~"):
            one, many = format_spec[1:].split("|")
            word = one if value == 1 else many
            return f"{value} {word}" if format_spec[0] == "|" else word
        if isinstance(value, Message):
            return value.text(self._language)
        if isinstance(value, tuple):
            numbers = all(isinstance(v, int | float) for v in value)
            parts = [self.format_field(v, format_spec) for v in value]
            return (", " if numbers else self._separator).join(parts)
        return format(value, format_spec)


_FORMATTERS = {"en": _InLanguage("en", ", "), "zh": _InLanguage("zh", "、")}


@cache
def catalogue() -> dict[str, dict[str, dict[Language, str]]]:
    """Return the templates of all messages: by group, name and language."""
    file = files("factorgraph_dvl.sensors") / "messages.json"
    found: dict[str, dict[str, list[str]]] = json.loads(file.read_text(encoding="utf-8"))
    return {
        group: {name: {"en": en, "zh": zh} for name, (en, zh) in own.items()}
        for group, own in found.items()
    }


def templates(key: str) -> dict[Language, str]:
    """Return the templates of a message in each language.

    Raises
    ------
    KeyError
        If the catalogue has no such message.
    """
    group, _, name = key.partition(".")
    return catalogue()[group][name]


def message(key: str, **values: object) -> Message:
    """Return a message; arrays and NumPy's numbers become plain ones.

    Parameters
    ----------
    key : str
        As in `Message`.
    **values : str, float, Message, ndarray or sequence of these
        Values by the names of the template.
    """
    return Message(key, tuple((name, _plain(value)) for name, value in values.items()))


def _plain(value: object) -> Value:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(map(_plain, value))
    if isinstance(value, str | int | float | Message):
        return value
    raise TypeError(f"no value of a message: {value!r}")


def in_language(said: Message | str, language: Language) -> str:
    """Return a message in a language; a text from a file as it is."""
    return said if isinstance(said, str) else said.text(language)


def encoded(said: Message) -> dict[str, Any]:
    """Return a message as plain data for JSON: its key and its values."""

    def plain(value: Value) -> Any:
        if isinstance(value, Message):
            return encoded(value)
        return list(map(plain, value)) if isinstance(value, tuple) else value

    return {"key": said.key, "values": {name: plain(value) for name, value in said.values}}


def decoded(data: Any, text: str) -> Message | str:
    """Return the message that `encoded` wrote; the text of its file where it says another.

    Parameters
    ----------
    data : object
        As read from JSON.
    text : str
        The sentence in English beside it.
    """

    def value(found: Any) -> Value:
        if isinstance(found, Mapping):
            own = found["values"]
            return Message(str(found["key"]), tuple((str(k), value(v)) for k, v in own.items()))
        if isinstance(found, Sequence) and not isinstance(found, str):
            return tuple(map(value, found))
        return _plain(found)

    try:
        read = value(data)
        # Another version may have other templates.
        if isinstance(read, Message) and read.text() == text:
            return read
    except (AttributeError, KeyError, TypeError, ValueError, IndexError):
        pass
    return text


def together(parts: Sequence[Message | str]) -> Message | str:
    """Return parts, joined by "and"."""
    first, *rest = parts
    return message("words.and", first=first, rest=together(rest)) if rest else first


def either(parts: Sequence[Message | str]) -> Message | str:
    """Return alternatives, joined by "or"."""
    first, *rest = parts
    return message("words.or", first=first, rest=either(rest)) if rest else first
