"""Events and results as JSON lines on standard output, for programs that drive the commands."""

from __future__ import annotations

import inspect
import math
import sys
from typing import Any, Literal

import msgspec


class Progress(msgspec.Struct, tag="progress", tag_field="event"):
    """A stage began, or an iteration of it; `elapsed_s` counts from the start of the command.

    `left_s` is a guess at the time that is left.
    """

    stage: str
    elapsed_s: float
    iteration: int = 0
    cost: float | None = None
    left_s: float | None = None


class Warned(msgspec.Struct, tag="warning", tag_field="event"):
    """Something that a person should know."""

    text: str


class Said(msgspec.Struct):
    """A message: its key, and its values by name; a value may be a list, or a message itself."""

    key: str
    values: dict[str, Any]


class Found(msgspec.Struct, tag="finding", tag_field="event"):
    """A finding about records or a result; docs/findings.md lists the codes.

    `message` has the numbers and names of the text; it is null where another version wrote it.
    """

    code: str
    severity: str
    sensor: str
    parameter: str
    text: str
    action: str
    message: Said | None


class Judged(msgspec.Struct, tag="verdict", tag_field="event"):
    """The verdict on a result, with its reasons."""

    grade: str
    reasons: list[Found]


class Text(msgspec.Struct, tag="text", tag_field="event"):
    """A line that a person would read."""

    text: str


class Table(msgspec.Struct, tag="table", tag_field="event"):
    """A table that a person would read: cells are text, as they would be printed."""

    title: str
    columns: list[str]
    rows: list[list[str]]


class Written(msgspec.Struct, tag="written", tag_field="event"):
    """Files that this run wrote: a folder, and paths relative to it."""

    folder: str
    files: list[str]


class Result(msgspec.Struct, tag="result", tag_field="event"):
    """A result that this run wrote as JSON: name of the file, and its content."""

    file: str
    content: Any


# What kind of error ended a command; `usage` is a wrong command line.
FailureKind = Literal["usage", "input", "result", "output", "system", "internal", "interrupted"]


class Failed(msgspec.Struct, tag="error", tag_field="event"):
    """An error that ends the command; the parts of its text are empty where it has none."""

    text: str
    kind: FailureKind
    what: str = ""
    where: str = ""
    expected: str = ""
    hint: str = ""


class End(msgspec.Struct, tag="end", tag_field="event"):
    """The command ended; the last line, whatever happened."""

    exit_code: int


Event = Progress | Warned | Found | Judged | Text | Table | Written | Result | Failed | End

# Whether this command speaks JSON; set once, before it runs.
_on = False


def switch(on: bool) -> None:
    """Switch events on or off, for the command that is about to run."""
    global _on
    _on = on


def active() -> bool:
    """Return whether events are printed instead of text."""
    return _on


def emit(event: Event) -> None:
    """Print an event as one line; numbers that JSON does not know are null."""
    sys.stdout.write(msgspec.json.encode(_finite(event)).decode() + "\n")
    sys.stdout.flush()


def _finite(event: Event) -> Event:
    if isinstance(event, Progress) and event.cost is not None and not math.isfinite(event.cost):
        event.cost = None
    return event


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a line."""
    found: dict[str, Any] = msgspec.json.schema(Event)
    # Python 3.13 compiles docstrings without their indentation, earlier versions with it.
    for definition in found["$defs"].values():
        definition["description"] = inspect.cleandoc(definition["description"])
    return found
