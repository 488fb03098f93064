"""Findings of a result by their codes."""

from __future__ import annotations

from collections.abc import Iterable

from factorgraph_dvl.quality.finding import Code, Finding


def of_code(findings: Iterable[Finding], code: Code) -> list[str]:
    """Return the texts of the findings of a code, with their sensors."""
    return [str(f) for f in findings if f.code == code]
