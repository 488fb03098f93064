"""Prose for readers: its sentences, private words, inversions, and how long a sentence may be."""

from __future__ import annotations

import re
from collections.abc import Iterator

from markdown_it import MarkdownIt
from markdown_it.token import Token

# Words that no paper on navigation would use for these things, nowhere in the package or in
# its documents, and the term to use instead.
REPLACED = {
    "admit": "allow",
    "admits": "allows",
    "anchoring": "position from ranges",
    "away": "deviation",
    "badness": "shortfall",
    "doubt": "contradiction",
    "doubts": "consistency warnings",
    "feign": "spurious information",
    "feigned": "spurious",
    "feigns": "makes spurious information",
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
    "wavers": "varies",
}

# Words that make a reader stop, and plain ones: in documents, help texts and findings. The
# comments of the code may use those that have a technical sense.
UNCLEAR = {
    "beforehand": "before the trial, in advance",
    "believed": "accepted",
    "dies": "is rejected",
    "hang": "depend",
    "hangs": "depends",
    "held": "fixed, compared",
    "hold": "fix, contain, be valid",
    "holds": "contains, fixes, is valid",
    "nobody": "not",
    "nowhere": "not anywhere",
    "reckoned": "computed",
    "stand": "be",
    "standing": "being",
    "stands": "is",
    "strewn": "spread",
    "swallow": "absorb",
    "swallows": "absorbs",
    "wanders": "varies",
    "whatever": "for any",
    "whoever": "you",
}

# Most words of a sentence. GTSAM's and SciPy's pages have a mean of about 18.
LONGEST = 30

_CLAUSE = r"(?:^|[;:–] )"
_VERB = r"(?:is|are|was|were|has|have|had|comes?|goes?|lies?|remains?|stays?|follows?|begins?)"
_PREPOSITION = (
    r"(?:[Aa]bove|[Aa]cross|[Aa]fter|[Aa]long|[Aa]t|[Bb]eside|[Bb]etween|[Bb]eyond|[Bb]y"
    r"|[Ff]or|[Ff]rom|[Ii]n|[Ii]nside|[Oo]n|[Oo]ver|[Tt]o|[Uu]nder|[Ww]ith|[Ww]ithin|[Ww]ithout)"
)
# Turns that put the subject late, by what is wrong with them.
INVERSIONS = {
    "begins with 'of'": re.compile(r"^Of\b|[;:–] of\b"),
    "begins with a clause of 'what', 'who' or 'that'": re.compile(
        r"(?:^|; )(?:[Ww]hat|[Ww]ho|[Ww]hose|[Ww]hoever|[Tt]hat (?:an?|it|the|they|you))\b[^?]*$"
    ),
    "a preposition, and the verb without a comma": re.compile(
        rf"{_CLAUSE}{_PREPOSITION} (?:(?!which|that|who)[^\s,;:]+ ){{1,7}}?{_VERB}\b"
    ),
    "the verb before its subject": re.compile(
        rf"{_CLAUSE}(?:[Nn]or|[Nn]ot only|[Oo]nly then|[Hh]ere|[Tt]here|[Ss]o) "
        r"(?:do|does|did|is it|are they|stands?|comes?|goes|lies?)\b"
    ),
    "'of it' as an object": re.compile(r"\b(?:nobody's|no one's)\b"),
}
_END = re.compile(
    r"(?<=[.!?])(?<!\bal\.)(?<!\beq\.)(?<!\beqs\.)(?<!\bch\.)(?<!e\.g\.)(?<!i\.e\.)"
    r"(?<!\bNo\.)[)\"]?\s+(?=[A-Z(\"“0-9`]|$)"
)
_WORD = re.compile(r"[A-Za-z][A-Za-z’'-]+|`")


def sentences(text: str) -> Iterator[tuple[int, str, bool]]:
    """Yield line, text, and whether it is of running text, of each sentence of a page.

    Code within a line is one word, and blocks of code and formulas are left out.
    """
    row = 0
    opened: list[Token] = []
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        if token.nesting:
            opened = [*opened, token] if token.nesting > 0 else opened[:-1]
        if token.map:
            row = token.map[0] + 1
        if token.type != "inline":
            continue
        kinds = {t.type for t in opened}
        running = not kinds & {"td_open", "th_open", "heading_open"}
        if "th_open" in kinds or "heading_open" in kinds:
            continue
        yield from ((row, s, running) for s in split(_plain(token.children or [])))


def _plain(tokens: list[Token]) -> str:
    tokens = [t for t in tokens if t.content or t.type != "text"]
    if tokens and tokens[0].type == "strong_open":
        end = next(i for i, t in enumerate(tokens) if t.type == "strong_close")
        # A title in bold is no sentence.
        tokens = tokens[end:] if tokens[end - 1].content.endswith(".") else tokens
    texts = {"softbreak": " ", "hardbreak": " ", "code_inline": "`", "html_inline": ""}
    return "".join(texts.get(t.type, t.content if t.type == "text" else "") for t in tokens)


def split(text: str) -> list[str]:
    """Return the sentences of a paragraph."""
    return [s.strip() for s in _END.split(text) if s.strip()]


def length(sentence: str) -> int:
    """Return the number of words; numbers, symbols of formulas and single letters are none."""
    return len(_WORD.findall(sentence))


def words(text: str) -> set[str]:
    """Return the lower-case words of identifiers, docstrings, comments and messages."""
    separated = re.sub(r"([a-z])([A-Z])", r"\1 \2", text).replace("_", " ")
    return {word.lower() for word in re.findall(r"[^\W\d]+", separated)}


def faults(sentence: str, *, running: bool = True) -> list[str]:
    """Return what makes a sentence hard to read: words, turns, and its length if it runs."""
    plain = {w.lower() for w in re.findall(r"[A-Za-z][A-Za-z-]*", sentence)}
    out = [f"{word} -> {REPLACED[word]}" for word in sorted(words(sentence) & REPLACED.keys())]
    out += [f"{word} -> {UNCLEAR[word]}" for word in sorted(plain & UNCLEAR.keys())]
    if not running:
        return out
    out += [name for name, pattern in INVERSIONS.items() if pattern.search(sentence)]
    if (count := length(sentence)) > LONGEST:
        out.append(f"{count} words")
    return out
