"""The table of findings in docs/findings.md: run this module to write it anew."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from factorgraph_dvl.quality import finding
from factorgraph_dvl.quality.finding import UNUSABLE, Code

DOCUMENT = Path(__file__).parent.parent / "docs" / "findings.md"
BEGIN, END = "<!-- findings: begin -->", "<!-- findings: end -->"
HEAD = [
    "| code | verdict | what it means | why it matters | what to do |",
    "|---|---|---|---|---|",
]
VERDICTS = {"note": "–", "warning": "doubtful", "error": "do not use"}


def drawn() -> str:
    """Return the tables as they should be: one for each group of codes."""
    lines = [BEGIN]
    source = inspect.getsource(finding.Code)
    for group, name in re.findall(r"^    (?:# (.*)\.|([A-Z_]+) = .*)$", source, re.MULTILINE):
        if group:
            lines += ["", f"## {group}", "", *HEAD]
        if name:
            code = Code[name]
            mark = " *refused*" if code in UNUSABLE else ""
            texts = (VERDICTS[code.severity], code.meaning, code.why, code.action)
            lines.append(f"| `{code}`{mark} | {' | '.join(texts)} |")
    return "\n".join([*lines, "", END])


def written() -> str:
    """Return the tables as they stand in the document."""
    text = DOCUMENT.read_text(encoding="utf-8")
    return text[text.index(BEGIN) : text.index(END) + len(END)]


if __name__ == "__main__":
    text = DOCUMENT.read_text(encoding="utf-8")
    DOCUMENT.write_text(text.replace(written(), drawn()), encoding="utf-8")
