"""Settings from YAML: keys of typed mappings in messages."""

from __future__ import annotations

from typing import ClassVar, Literal

import msgspec
import pytest

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.settings.yaml_file import dump_yaml, parse_yaml


class Entry(msgspec.Struct, forbid_unknown_fields=True):
    size: float
    kind: Literal["a", "b"] = "a"
    inner: dict[str, list[float]] = msgspec.field(default_factory=dict)


class Marked(Entry):
    mark: ClassVar[str] = "not a key"


class Settings(msgspec.Struct, forbid_unknown_fields=True):
    numbers: dict[str, float] = msgspec.field(default_factory=dict)
    entries: dict[str, Entry] = msgspec.field(default_factory=dict)
    rows: list[dict[str, Entry]] = msgspec.field(default_factory=list)


def test_only_keys_are_offered():
    with pytest.raises(ConfigError, match=r"expected one of inner, kind, size$"):
        parse_yaml("speed: 1\nsize: 2\n", Marked, source="file.yaml")


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("numbers:\n  one: 1\n  two: x\n", 3, "numbers.two is 'x'; expected a number"),
        ("numbers:\n  two:\n", 2, "numbers.two is empty; expected a number"),
        ("entries:\n  one: {size: 1}\n  two: {size: x}\n", 3, "entries.two.size is 'x'"),
        ("entries:\n  one: {size: 1, kind: c}\n", 2, "entries.one.kind is 'c'; expected a or b"),
        ("entries:\n  one:\n    siez: 1\n", 3, "unknown key `entries.one.siez`"),
        ("entries:\n  one: {}\n", 2, "missing key `entries.one.size`"),
        (
            "entries:\n  one: {size: 1}\n  two:\n    size: 1\n    inner:\n      deep: [1, y]\n",
            6,
            "entries.two.inner.deep[1] is 'y'",
        ),
        ("rows:\n  - one: {size: 1}\n  - two: 5\n", 3, "rows[1].two is 5; expected a mapping"),
    ],
)
def test_wrong_entries_of_a_typed_mapping_are_named(text, line, message):
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, Settings, source="file.yaml")
    assert f"file.yaml line {line}" in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "0008",
        "0o17",
        "1e3",
        "-1E-2",
        "no",
        "true",
        "null",
        "~",
        "",
        "1:30",
        "2022-10-12",
        "0x1F",
        ".5",
        "a: b",
    ],
)
def test_text_that_looks_like_something_else_stays_text(text):
    for flow in (None, True):
        written = dump_yaml({"text": text, "more": [text, 1e-3, 1e22, True, None, 8]}, flow=flow)
        read = parse_yaml(written, dict, source="file.yaml")
        assert read == {"text": text, "more": [text, 1e-3, 1e22, True, None, 8]}


def test_leading_zeros_do_not_make_a_number_octal():
    assert parse_yaml("size: 010\n", Entry, source="file.yaml").size == 10.0
    assert parse_yaml("size: 008\n", Entry, source="file.yaml").size == 8.0
