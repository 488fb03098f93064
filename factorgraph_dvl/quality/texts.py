"""All texts in all languages, from one catalogue: messages, findings, phrases and names."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from string import Formatter
from typing import Any, Literal

from factorgraph_dvl.message import Message, Value, plain
from factorgraph_dvl.quality.notation import in_words, split_unit

Language = Literal["en", "zh"]
# What follows the name of a parameter of several components.
_AXIS = re.compile(r"\d*[xyz]|\d+")
# Beginnings of causes that name a measurement or a parameter, and what follows it in Chinese.
_CAUSES = {
    "noise of ": "噪声",
    "correlated noise of ": "相关噪声",
    "lasting errors of ": "的持续误差",
    "slow errors of ": "的慢变误差",
    "averaging of ": "的平均窗口",
    "prior of ": "的先验",
    "random walk of ": "的随机游走",
}


@cache
def catalogue(kind: str) -> dict[str, Any]:
    """Return a part of the catalogue.

    Parameters
    ----------
    kind : {'messages', 'findings', 'phrases', 'parameters'}
        `messages`: templates in each language, by group and name. `findings`: meaning, why it
        matters and what to do, in each language, by code. `phrases`: the Chinese of each English
        phrase of a page. `parameters`: the Chinese of each stem of a parameter.
    """
    file = files("factorgraph_dvl.quality") / "texts.json"
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))[kind]
    return found


def templates(key: str) -> dict[Language, str]:
    """Return the templates of a message in each language.

    Raises
    ------
    KeyError
        If the catalogue has no such message.
    """
    group, _, name = key.partition(".")
    en, zh = catalogue("messages")[group][name]
    return {"en": en, "zh": zh}


def text_of(said: Message | str, language: Language = "en") -> str:
    """Return a message in a language; a text from a file as it is."""
    if isinstance(said, str):
        return said
    return _FORMATTERS[language].vformat(templates(said.key)[language], (), dict(said.values))


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
            return text_of(value, self._language)
        if isinstance(value, tuple):
            numbers = all(isinstance(v, int | float) for v in value)
            parts = [self.format_field(v, format_spec) for v in value]
            return (", " if numbers else self._separator).join(parts)
        return format(value, format_spec)


_FORMATTERS = {"en": _InLanguage("en", ", "), "zh": _InLanguage("zh", "、")}


def decoded(data: Any, text: str) -> Message | str:
    """Return the message that `message.encoded` wrote; the text of its file if it says another.

    Parameters
    ----------
    data : object
        Data as read from JSON.
    text : str
        The sentence in English beside it.
    """

    def value(found: Any) -> Value:
        if isinstance(found, Mapping):
            own = found["values"]
            return Message(str(found["key"]), tuple((str(k), value(v)) for k, v in own.items()))
        if isinstance(found, Sequence) and not isinstance(found, str):
            return tuple(map(value, found))
        return plain(found)

    try:
        read = value(data)
        # Another version may have other templates.
        if isinstance(read, Message) and text_of(read) == text:
            return read
    except (AttributeError, KeyError, TypeError, ValueError, IndexError):
        pass
    return text


def chinese(english: str) -> str:
    """Return a phrase, or the name of a parameter, in Chinese; where there is none, as it is.

    The name of a component is that of its parameter, and its axis.
    """
    names, name = catalogue("parameters"), english.lower().replace(" ", "_")
    stem, _, axis = name.rpartition("_")
    own = f"{names[stem]} {axis}" if stem in names and _AXIS.fullmatch(axis) else english
    return str(catalogue("phrases").get(english, names.get(name, own)))


def chinese_cause(cause: str) -> str:
    """Return a cause of the error budget in Chinese; what is not known stays as it is."""
    for start, own in _CAUSES.items():
        if cause.startswith(start):
            name = split_unit(cause.removeprefix(start))[0]
            return f"{catalogue('parameters').get(name, chinese(name))}{own}"
    return chinese(cause)


def component_names(component: str) -> tuple[str, str, str]:
    """Return the name of a component in English and in Chinese, and its unit.

    Parameters
    ----------
    component : str
        Component as in `covariance.order`, such as `lever_arm_x_m`.
    """
    stems = catalogue("parameters")
    name, unit = split_unit(component)
    for stem in sorted(stems, key=len, reverse=True):
        if name == stem or name.startswith(f"{stem}_"):
            own = f"{stems[stem]}{name[len(stem) :].replace('_', ' ')}"
            return in_words(name), own, unit
    return in_words(name), in_words(name), unit
