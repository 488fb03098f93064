"""Plain data and JSON as typed settings, in any number of threads."""

from __future__ import annotations

import re
from threading import RLock
from typing import Any, TypeVar

import msgspec

from factorgraph_dvl.errors import ConfigError

_T = TypeVar("_T")

# At the first use of a type, msgspec notes what it knows of it before that is complete, and a
# second thread that reads it crashes. A value may be converted within another: the lock of one
# thread does not stop itself.
_types = RLock()


def from_plain(data: Any, kind: type[_T]) -> _T:
    """Return plain data as a type; raise msgspec.ValidationError if it does not fit."""
    with _types:
        return msgspec.convert(data, kind)


def from_json(content: bytes, kind: type[_T]) -> _T:
    """Return JSON as a type; raise msgspec.MsgspecError if it is none or does not fit."""
    with _types:
        return msgspec.json.decode(content, type=kind)


def convert(data: Any, kind: type[_T], key: str, source: str) -> _T:
    """Return data as settings of a kind; a ConfigError names the key in the source."""
    try:
        return from_plain(data, kind)
    except msgspec.ValidationError as error:
        what, _, path = str(error).partition(" - at ")
        inner = path.strip("`").removeprefix("$").removeprefix(".")
        full = re.sub(r"\.(?=\[)", "", ".".join(part for part in (key, inner) if part))
        where = f"{source} key {full}" if full else source
        raise ConfigError(what[:1].lower() + what[1:], where=where) from error
