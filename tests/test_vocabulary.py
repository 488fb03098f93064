"""One vocabulary: words that no paper on navigation would use for these things."""

from __future__ import annotations

from pathlib import Path

from prose import REPLACED, words

PACKAGE = Path(__file__).parent.parent / "factorgraph_dvl"


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
