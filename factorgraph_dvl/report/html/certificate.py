"""The certificate of a calibration: what, where, with which instruments, method and files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from factorgraph_dvl.quality.notation import in_words
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.markup import (
    Cell,
    Html,
    Section,
    both,
    element,
    joined,
    section,
    table,
)

# Names of keys that state units, and the units.
_UNITS = {
    "temperature_c": ("temperature", "°C"),
    "salinity_psu": ("salinity", "PSU"),
    "sound_speed_m_s": ("sound speed", "m/s"),
}


def certificate_section(result: Result) -> Section | None:
    """Return the certificate; none without run.json, and none without names of files."""
    if not result.run or result.redacted:
        return None
    solution = result.solution
    rows = list(_stated(result.certificate))
    if "date" not in result.certificate and result.run.get("epoch"):
        rows.append([both("recorded from"), result.run["epoch"]])
    method = "Factor graph of all data" if solution.solver == "batch" else solution.solver
    version = result.run["versions"].get("factorgraph-dvl", "")
    rows += [
        [both("trial"), result.trial],
        [both("method"), both(method)],
        [both("software"), f"factorgraph-dvl {version}".strip()],
        [both("Verdict"), both(solution.verdict.grade)],
    ]
    content: list[Cell] = [table([both("item"), both("stated")], rows, label="Certificate")]
    if files := result.run.get("files", ()):
        hashes = [[f["name"], element("code", f["sha256"])] for f in files]
        content.append(element("h3", both("Input files")))
        content.append(table([both("file"), "SHA-256"], hashes, label="Input files"))
    content.append(element("p", both("Signature, name, date:"), class_="sign"))
    return section("Certificate", *content, key="certificate")


def _stated(values: Mapping[str, Any], before: str = "") -> Iterator[list[Cell]]:
    """Yield a row for each statement, with the instrument that it is of."""
    for key, value in values.items():
        name, unit = _UNITS.get(key, (in_words(key), ""))
        if isinstance(value, Mapping):
            yield from _stated(value, name)
            continue
        shown: Html = both(name)
        if before:
            shown = joined(both(before), shown)
        yield [shown, f"{value} {unit}".strip()]
