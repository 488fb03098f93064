"""An equation, table, figure or claim of a publication, and what becomes of it here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure

from factorgraph_dvl.simulation import Scenario, load_scenario

Verdict = Literal["reproduced", "corrected", "not reproducible"]

_CONFIGS = Path(__file__).parent / "configs"


@dataclass(frozen=True)
class Result:
    """What was measured of an entry.

    Parameters
    ----------
    measured : str
        What was measured, in a line, with its numbers.
    verdict : Verdict
        Verdict by these numbers.
    details : tuple of str, optional
        Lines of Markdown: tables, reasons.
    figure : Figure, optional
        Drawn anew.
    """

    measured: str
    verdict: Verdict
    details: tuple[str, ...] = ()
    figure: Figure | None = None


@dataclass(frozen=True)
class Entry:
    """An equation, table, figure or claim.

    Parameters
    ----------
    label : str
        Such as `eq. 6`, `table 4` or `figure 1`; a claim by its place.
    says : str
        What the publication states.
    where : str
        Module, command or configuration that has it.
    check : callable of int, Result
        Measures it, over a number of seeds.
    """

    label: str
    says: str
    where: str
    check: Callable[[int], Result]


@dataclass(frozen=True)
class Paper:
    """A publication.

    Parameters
    ----------
    name : str
        Name as the command has it.
    reference : str
        Authors, title, journal, year.
    entries : tuple of Entry
        Entries in the order of the publication.
    """

    name: str
    reference: str
    entries: tuple[Entry, ...]


def scenario(name: str) -> Scenario:
    """Return a scenario that comes with the package, by the name of its file."""
    return load_scenario(_CONFIGS / f"{name}.yaml")


def judged(printed: bool, corrected: bool = False) -> Verdict:
    """Return the verdict on what is right as printed, with a correction, or not at all."""
    if printed:
        return "reproduced"
    return "corrected" if corrected else "not reproducible"


def counted(seeds: int) -> str:
    """Return a number of seeds in words, such as `1 seed`."""
    return f"{seeds} seed{'s' * (seeds != 1)}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return tuple("| " + " | ".join(line) + " |" for line in lines)
