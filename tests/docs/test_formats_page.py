"""The page of formats says of each what the catalogue says."""

from __future__ import annotations

import re
from pathlib import Path

from factorgraph_dvl.files.formats.catalogue import FORMATS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


def rows():
    """Return the cells of the first table, by the name of the format."""
    text = PAGE.read_text(encoding="utf-8")
    table = re.search(r"\| format \|.*?\n\n", text, re.DOTALL)
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in table[0].splitlines()[2:]]
    return {row[0].strip("`"): row[1:] for row in cells if len(row) > 1}


def test_every_format_has_its_row():
    found = rows()
    formats = {form.name: form for form in FORMATS if form.family != "table"}
    assert set(found) == set(formats)
    for name, (title, verified, source, extra) in found.items():
        form = formats[name]
        assert (title, verified, extra.strip("`")) == (form.title, form.verified, form.extra)
        assert source
