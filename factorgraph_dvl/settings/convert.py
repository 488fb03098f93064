"""Plain data, as read from YAML, into typed settings."""

from __future__ import annotations

import re
from typing import Any, TypeVar

import msgspec

from factorgraph_dvl.errors import ConfigError

_T = TypeVar("_T")


def convert(data: Any, kind: type[_T], key: str, source: str) -> _T:
    """Return data as settings of a kind; a ConfigError names the key in the source."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        what, _, path = str(error).partition(" - at ")
        inner = path.strip("`").removeprefix("$").removeprefix(".")
        full = re.sub(r"\.(?=\[)", "", ".".join(part for part in (key, inner) if part))
        where = f"{source} key {full}" if full else source
        raise ConfigError(what[:1].lower() + what[1:], where=where) from error
