"""YAML files as typed settings, with errors that name the line and the key."""

from __future__ import annotations

import difflib
import math
import re
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import yaml

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.settings.convert import from_plain
from factorgraph_dvl.settings.files import MEGABYTE, read_bytes
from factorgraph_dvl.settings.ranges import range_of

T = TypeVar("T")
Key = str | int

# Size and number of values of a file at most. Chosen: a hundred times what settings need.
_MAX_BYTES = MEGABYTE
_MAX_NODES = 100_000


class _Loader(yaml.SafeLoader):
    """Scalars as in YAML 1.2: 1e-3 is a number; no and 2022-10-12 are text."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    """Text is quoted where YAML 1.1 or the loader would take it for something else."""


def _decimal(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    # That of YAML 1.1 takes 010 for octal.
    return int(loader.construct_scalar(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _decimal)
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first
        )


def read_yaml(path: Path, kind: type[T], *, source: str = "") -> T:
    """Read a YAML file into settings of a msgspec type.

    Parameters
    ----------
    path : path-like
        Path of the file.
    kind : type of T
        The type; it should forbid unknown fields.
    source : str, optional
        Name of the file in messages; by default that of `path`.

    Raises
    ------
    ConfigError
        If the file is missing or no YAML, or a key is unknown, missing, given twice,
        of the wrong type or out of range.
    """
    return parse_yaml(read_text(path), kind, source=source or path.name)


def read_text(path: Path) -> str:
    """Read a text file; raise ConfigError if there is none, or it is not text."""
    content = read_bytes(path, limit=_MAX_BYTES, expected="YAML", kind=ConfigError)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(
            "is not a text file", where=str(path), expected="YAML, in UTF-8"
        ) from None


def parse_yaml(text: str, kind: type[T], *, source: str) -> T:
    """Convert YAML text to settings; like `read_yaml`, with `source` in messages."""
    root = _compose(text, source)
    value = _Builder(source).build(root, ())
    try:
        return from_plain(value, kind)
    except msgspec.ValidationError as error:
        raise _explain(str(error), root, value, kind, source) from None


def dump_yaml(value: Any, *, flow: bool | None = None, width: int = 80) -> str:
    """Return YAML text that `parse_yaml` reads back as the same values.

    Parameters
    ----------
    value : mapping, sequence or scalar
        Plain values.
    flow : bool, optional
        Whether mappings and lists are within braces; by default, those of scalars only.
    width : int, optional
        Characters in a line, about.
    """
    return yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=flow,
        width=width,
    )


def _compose(text: str, source: str) -> yaml.Node:
    try:
        root = yaml.compose(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = str(error.problem or error.context)
        raise ConfigError(
            f"not valid YAML: {_in_our_words(problem)}",
            where=f"{source} line {mark.line + 1}" if mark else source,
        ) from None
    except (yaml.YAMLError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"not valid YAML: {reason}", where=source) from None
    if not isinstance(root, yaml.MappingNode):
        raise ConfigError(
            "there are no keys" if root is None else "is not a mapping",
            where=f"{source} line {_line(root)}" if root is not None else source,
            expected="keys and values, such as `format: 1`",
        )
    return root


# What PyYAML says, and what is wrong then.
_PROBLEMS = {
    "'\\t' that cannot start": "a tab, where YAML takes spaces only",
    "mapping values are not allowed": "a colon within a value (put it in quotes), or a line "
    "that is indented too far",
    "could not find expected ':'": "a line without a colon after its key",
    "expected ',' or": "a bracket or brace is not closed, or a comma is missing",
    "expected the node content": "a bracket or brace is not closed, or a value is missing",
    "expected <block end>": "a line is not indented as those above it",
    "unexpected end of stream": "a quotation mark is not closed",
    "undefined alias": "a word that begins with `*`: put it in quotes",
    "cannot start any token": "a special character at the beginning of a value: put it in quotes",
    "special characters are not allowed": "a control character",
}


def _in_our_words(problem: str) -> str:
    """Return what is wrong with YAML, by what its parser says."""
    return next((said for key, said in _PROBLEMS.items() if key in problem), problem)


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


class _Builder:
    """Plain values from YAML nodes; what msgspec cannot see is checked here."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.scalars = _Loader("")
        self.nodes = 0

    def build(self, node: yaml.Node, path: tuple[Key, ...]) -> Any:
        self.nodes += 1
        # Aliases can make a short file endless.
        if self.nodes > _MAX_NODES or len(path) > 50:
            raise ConfigError("too large or nested too deeply", where=self._where(node))
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*path, i)) for i, item in enumerate(node.value)]
        try:
            return self.scalars.construct_object(node)
        except (yaml.YAMLError, ValueError):
            raise ConfigError(
                f"{_dotted(path)} cannot be read", where=self._where(node), expected="plain YAML"
            ) from None

    def _mapping(self, node: yaml.MappingNode, path: tuple[Key, ...]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ConfigError("a key is not text", where=self._where(key), expected="a name")
            name = str(key.value)
            if name in out:
                raise ConfigError(
                    f"{_dotted((*path, name))} is given twice",
                    where=self._where(key),
                    expected="each key once",
                )
            out[name] = self.build(value, (*path, name))
        return out

    def _where(self, node: yaml.Node) -> str:
        return f"{self.source} line {_line(node)}"


_UNKNOWN = re.compile(r"Object contains unknown field `(?P<name>.*)`")
_MISSING = re.compile(r"Object missing required field `(?P<name>\w*)`(?P<instead>.*)")
_NAMES = {
    "float": "a number",
    "int": "an integer",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "a mapping",
    "null": "nothing",
}


def _explain(message: str, root: yaml.Node, value: Any, kind: Any, source: str) -> ConfigError:
    """Turn a message of msgspec into what, where and what was expected."""
    reason, _, at = message.partition(" - at `$")
    path = _entries(_parse_path(at.rstrip("`")), value, kind)

    def where(path: tuple[Key, ...]) -> str:
        line = _find(root, path)
        return f"{source} line {line}" if line else source

    if match := _UNKNOWN.match(reason):
        name = match["name"]
        known = sorted(_fields(_descend(kind, path)))
        near = difflib.get_close_matches(name, known, n=1)
        return ConfigError(
            f"unknown key `{_dotted((*path, name))}`",
            where=where((*path, name)),
            expected=f"one of {', '.join(known)}",
            hint=f"Did you mean `{near[0]}`?" if near else "",
        )
    if match := _MISSING.match(reason):
        return ConfigError(
            f"missing key `{_dotted((*path, match['name']))}`",
            where=where(path) if path else source,
            expected=f"this key{match['instead']}",
        )
    if not reason.startswith(("Expected", "Invalid enum")):
        for name in re.findall(r"`(\w+)`", reason):
            if _find(root, (*path, name)):
                path = (*path, name)
        what = f"{_dotted(path)}: {reason}" if path else reason
        return ConfigError(what, where=where(path))
    found = value
    for key in path:
        found = found[key]
    shown = "empty" if found is None else repr(found) if len(repr(found)) < 60 else "wrong"
    expected = _expected(reason, _descend(kind, path))
    name = next((key for key in reversed(path) if isinstance(key, str)), "")
    limits = range_of(name)
    if isinstance(found, str) and expected.startswith(("a number", "a list")) and limits:
        given = _WITH_UNIT.fullmatch(found.strip())
        of = f" in {limits.unit}" if limits.unit else ""
        if expected.startswith("a number"):
            expected = expected.replace("a number", f"a number{of}", 1)
        elif of:
            expected = expected.replace("a list", f"a list of numbers{of}", 1)
        if given:
            factor = _FACTORS.get((given["unit"], limits.unit))
            value = "" if factor is None else f": {float(given['number']) * factor:g}"
            expected += f", without a unit{value}"
    return ConfigError(f"{_dotted(path)} is {shown}", where=where(path), expected=expected)


_WITH_UNIT = re.compile(
    r"(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\s\d.]\S*)"
)
# How many of the second unit one of the first is.
_FACTORS = {
    **{("mm", "m"): 1e-3, ("cm", "m"): 1e-2, ("km", "m"): 1e3, ("m", "m"): 1.0},
    **{("mm/s", "m/s"): 1e-3, ("cm/s", "m/s"): 1e-2, ("kn", "m/s"): 1852.0 / 3600.0},
    **{("m/s", "m/s"): 1.0, ("ms", "s"): 1e-3, ("us", "s"): 1e-6, ("s", "s"): 1.0},
    **{("°", "deg"): 1.0, ("deg", "deg"): 1.0, ("rad", "deg"): 180.0 / math.pi},
    ("%", ""): 1e-2,
    **{("mg", "µg"): 1e3, ("µg", "µg"): 1.0, ("ug", "µg"): 1.0},
}


def _expected(reason: str, kind: Any) -> str:
    choices = [c for k in _options(kind) if get_origin(k) is Literal for c in get_args(k)]
    if choices:
        return " or ".join(str(choice) for choice in choices)
    text = reason.removeprefix("Expected ").split(", got")[0]
    text = re.sub(
        r"`([^`]*)`",
        lambda m: " or ".join(_NAMES.get(part, part) for part in m[1].split(" | ")),
        text,
    )
    return re.sub(r"(\d)\.0\b", r"\1", text)


def _parse_path(text: str) -> tuple[Key | None, ...]:
    """Split `.dvl.lever_arm_m[0]` into its keys; None where `[...]` stands for any key."""
    return tuple(
        int(index) if index else name or None
        for name, index in re.findall(r"\.(\w+)|\[(\d*)\.*\]", text)
    )


def _entries(path: tuple[Key | None, ...], value: Any, kind: Any) -> tuple[Key, ...]:
    """Return a path with the keys of mappings that msgspec does not name.

    The first entry that does not fit is the one it complains about; where none is found,
    the path ends at the mapping.
    """
    out: list[Key] = []
    for key in path:
        if key is None:
            inner = _entry(kind, "")
            key = next((k for k, v in value.items() if not _fits(v, inner)), None)
            if key is None:
                break
        out.append(key)
        value, kind = value[key], _entry(kind, key)
    return tuple(out)


def _fits(value: Any, kind: Any) -> bool:
    try:
        from_plain(value, Any if kind is None else kind)
    except msgspec.ValidationError:
        return False
    return True


def _dotted(path: tuple[Key, ...]) -> str:
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)
    return text.lstrip(".")


def _find(node: yaml.Node, path: tuple[Key, ...]) -> int:
    """Return the line of a key, 0 if it is not there."""
    line = 0
    for key in path:
        if isinstance(node, yaml.MappingNode):
            items = {k.value: (k, v) for k, v in node.value}
            if key not in items:
                return 0
            line, node = _line(items[key][0]), items[key][1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(key, int):
            node = node.value[key]
            line = _line(node)
        else:
            return 0
    return line


def _options(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself, without annotations."""
    if hasattr(kind, "__metadata__"):
        kind = kind.__origin__
    if get_origin(kind) is Union or type(kind).__name__ == "UnionType":
        return tuple(part for option in get_args(kind) for part in _options(option))
    return (kind,)


def _fields(kind: Any) -> dict[str, Any]:
    """Return the fields of a settings type, among the options of a union."""
    for option in _options(kind):
        if isinstance(option, type) and issubclass(option, msgspec.Struct):
            hints = get_type_hints(option, include_extras=True)
            return {name: hints[name] for name in option.__struct_fields__}
    return {}


def _descend(kind: Any, path: tuple[Key, ...]) -> Any:
    """Return the type of the value at a path; None where the types do not say."""
    for key in path:
        kind = _entry(kind, key)
    return kind


def _entry(kind: Any, key: Key) -> Any:
    """Return the type of what stands under a key; None where the types do not say."""
    if isinstance(key, str):
        for option in _options(kind):
            if get_origin(option) is dict:
                return get_args(option)[1]
        return _fields(kind).get(key)
    lists = [option for option in _options(kind) if get_origin(option) is list]
    return get_args(lists[0])[0] if lists else None
