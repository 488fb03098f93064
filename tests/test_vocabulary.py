"""One vocabulary: words that no paper on navigation would use for these things."""

from __future__ import annotations

import re
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "factorgraph_dvl"

# Word that must not occur, and the term to use instead.
REPLACED = {
    "admit": "allow",
    "admits": "allows",
    "anchoring": "position from ranges",
    "away": "deviation",
    "badness": "shortfall",
    "doubt": "contradiction",
    "doubts": "consistency warnings",
    "foreign": "external",
    "lacking": "short of limits",
    "lean": "bias Jacobian",
    "misweighed": "needs reweighting",
    "sailed": "carried out",
    "sanity": "plausibility",
    "shelf": "library",
    "slid": "extrapolated",
    "strayed": "needs rebinding",
    "tell": "show, determine",
    "tells": "shows, determines",
    "told": "informed",
    "untold": "uninformed",
    "wavering": "varying",
}


def words(text: str) -> set[str]:
    """Return the lower-case words of identifiers, docstrings, comments and messages."""
    separated = re.sub(r"([a-z])([A-Z])", r"\1 \2", text).replace("_", " ")
    return {word.lower() for word in re.findall(r"[^\W\d]+", separated)}


def test_words_come_apart() -> None:
    assert words('self._toldOf = told_by["Held"]  # it strayed') >= {
        "told",
        "of",
        "held",
        "strayed",
    }


def test_no_private_words() -> None:
    found = [
        f"{path.relative_to(PACKAGE)}: {word} -> {REPLACED[word]}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for word in sorted(words(path.read_text(encoding="utf-8")) & REPLACED.keys())
    ]
    assert not found, "\n".join(found)
