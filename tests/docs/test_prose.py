"""What people read is plain: pages, help texts, findings and messages.

The words and turns are listed in `tests/prose.py`. Tables are checked for words only, because
their cells are no sentences.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from prose import UNCLEAR, faults, sentences, split, words
from typer.main import get_command

from factorgraph_dvl.cli.app import app
from factorgraph_dvl.cli.commands import COMMANDS
from factorgraph_dvl.cli.commands import command as command_named
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.texts import catalogue

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "factorgraph_dvl"


def is_measured(page: Path) -> bool:
    """Whether a benchmark writes a page: its prose changes with its next run."""
    return "do not edit" in page.read_text(encoding="utf-8")[:1000]


def is_english(page: Path) -> bool:
    return not page.stem.endswith(".zh")


PAGES = [
    page.relative_to(ROOT).as_posix()
    for page in sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
    if is_english(page) and not is_measured(page)
]


def help_texts() -> Iterator[tuple[str, str]]:
    """Yield the name and the text of every help of the command line."""
    group = get_command(app)
    yield "factorgraph-dvl", group.help or ""
    for name in sorted(COMMANDS):
        command = command_named(name)
        yield name, command.help or ""
        for parameter in command.params:
            yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""


def messages() -> Iterator[tuple[str, str]]:
    """Yield place and text of every message: the texts in the package of four words or more.

    Docstrings and markup are none, nor are the rows of tables that `reproduce` prints.
    """
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.parent.name == "reproduce":
            continue
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        left_out = {id(n.value) for n in nodes if isinstance(n, ast.Expr)}
        left_out |= {id(v) for n in nodes if isinstance(n, ast.JoinedStr) for v in n.values}
        for node in nodes:
            text = text_of(node)
            if id(node) not in left_out and text.count(" ") >= 3 and not set("<{") & set(text):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text.lstrip("# ")


def text_of(node: ast.AST) -> str:
    """Return a text, with a sign for each value in it; empty for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = (v.value if isinstance(v, ast.Constant) else "`" for v in node.values)
        return "".join(str(part) for part in parts)
    return ""


# Words that docstrings may use in a technical sense: `dead-reckoned`, `nan stands for`.
TECHNICAL = {"reckoned", "stand", "stands", "standing", "whatever"}
# A description that begins so is the rest of a sentence whose subject is missing.
FRAGMENT = re.compile(r"(?:Of|By|As|That|To|With|In|At|From|On|For|Without|Between)\b(?! default)")
SECTION = re.compile(r"^(Parameters|Attributes)\n-+\n((?:.*\n)*?)(?=^\S.*\n-+\n|\Z)", re.MULTILINE)
ITEM = re.compile(r"^\S.* : .*\n {4}(\S.*)", re.MULTILINE)
# Names of parameters, and other code.
CODE = re.compile(r"^[\w, *]+ : |`[^`]*`", re.MULTILINE)


def docstrings() -> Iterator[tuple[str, str]]:
    """Yield place and text of every docstring of the package, without examples."""
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
            if isinstance(node, kinds) and (text := ast.get_docstring(node)):
                name = getattr(node, "name", "")
                yield f"{place}: {name}", text.partition("\nExamples\n")[0] + "\n"


def introductions() -> Iterator[tuple[str, str]]:
    """Yield the texts that benchmarks put on their pages."""
    for path in sorted((ROOT / "benchmarks").glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and len(text := text_of(node.value)) > 200:
                yield path.name, text


def found(texts: Iterator[tuple[str, str]]) -> list[str]:
    return [
        f"{where}: {fault}: {sentence}"
        for where, text in texts
        for sentence in split(" ".join(text.split()))
        for fault in faults(sentence)
    ]


@pytest.mark.parametrize("page", PAGES)
def test_pages_are_plain(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    wrong = [
        f"{page}:{line}: {fault}: {sentence}"
        for line, sentence, running in sentences(text)
        for fault in faults(sentence, running=running)
    ]
    assert not wrong, "\n".join(wrong)


def test_introductions_of_measured_pages_are_plain():
    wrong = [
        f"{name}: {fault}: {sentence}"
        for name, text in introductions()
        for _, sentence, running in sentences(text)
        for fault in faults(sentence, running=running)
    ]
    assert not wrong, "\n".join(wrong)


def test_help_texts_are_plain():
    wrong = found(help_texts())
    assert not wrong, "\n".join(wrong)


def test_findings_are_plain():
    wrong = found(
        (f"{code}", text) for code in Code for text in (code.meaning, code.why, code.action)
    )
    assert not wrong, "\n".join(wrong)


def test_sentences_of_the_report_are_plain():
    wrong = found((text, text) for text in catalogue("phrases") if text.endswith("."))
    assert not wrong, "\n".join(wrong)


def test_messages_are_plain():
    wrong = found(messages())
    assert not wrong, "\n".join(wrong)


def test_docstrings_use_plain_words():
    wrong = [
        f"{where}: {word} -> {UNCLEAR[word]}"
        for where, text in docstrings()
        for word in sorted(words(CODE.sub("", text)) & (UNCLEAR.keys() - TECHNICAL))
    ]
    assert not wrong, "\n".join(wrong)


def test_descriptions_begin_with_what_they_describe():
    wrong = [
        f"{where}: {text}"
        for where, docstring in docstrings()
        for _, section in SECTION.findall(docstring)
        for text in ITEM.findall(section)
        if FRAGMENT.match(text)
    ]
    assert not wrong, "\n".join(wrong)


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize(
    ("sentence", "fault"),
    [
        ("Of all that is random.", "begins with 'of'"),
        (
            "A height is nobody's knowledge beforehand.",
            "beforehand -> before the trial, in advance",
        ),
        ("Of a dive, one value is left.", "begins with 'of'"),
        (
            "453 s with these manoeuvres do not tell it better than the prior.",
            "tell -> show, determine",
        ),
        ("What agrees might differ.", "begins with a clause of 'what', 'who' or 'that'"),
        (
            "In the case above 0.0002 deg/h are left.",
            "a preposition, and the verb without a comma",
        ),
        ("Nor does it hold.", "the verb before its subject"),
        ("word " * 31, "31 words"),
    ],
)
def test_unclear_sentences_are_found(sentence, fault):
    assert fault in faults(sentence)


@pytest.mark.parametrize(
    "sentence",
    [
        "Random seed.",
        "The height of the sea surface is not known in advance.",
        "Without noise, the result is exact.",
        "The dead-reckoned track is compared with GNSS.",
        "What does the verdict mean?",
    ],
)
def test_plain_sentences_pass(sentence):
    assert faults(sentence) == []


def test_code_and_formulas_are_no_sentences():
    blocks = "    y = of x\n\n```sh\nof all that\n```\n\n| head |\n|---|\n| of x |\n"
    page = f"Text with `code of it`:\n\n{blocks}"
    assert [(s, running) for _, s, running in sentences(page)] == [
        ("Text with `:", True),
        ("of x", False),
    ]
