"""The certificate of a calibration: what, where, with which instruments, method and files."""

from __future__ import annotations

from factorgraph_dvl.report.certificate import statements
from factorgraph_dvl.report.html.content import Result
from factorgraph_dvl.report.html.markup import (
    Cell,
    Section,
    both,
    element,
    joined,
    section,
    table,
)


def certificate_section(result: Result) -> Section | None:
    """Return the certificate; none without run.json, and none without names of files."""
    if not result.run or result.redacted:
        return None
    rows = [[joined(*map(both, names)), both(text)] for names, text in statements(result)]
    content: list[Cell] = [table([both("item"), both("stated")], rows, label="Certificate")]
    if files := result.run.get("files", ()):
        hashes = [[f["name"], element("code", f["sha256"])] for f in files]
        content.append(element("h3", both("Input files")))
        content.append(table([both("file"), "SHA-256"], hashes, label="Input files"))
    content.append(element("p", both("Signature, name, date:"), class_="sign"))
    return section("Certificate", *content, key="certificate")
