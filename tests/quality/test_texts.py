"""Messages: one catalogue for both languages, with the same values in each."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from string import Formatter

import numpy as np
import pytest
from prose import faults, split

import factorgraph_dvl
from factorgraph_dvl.message import Message, either, encoded, message
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.texts import catalogue, chinese, decoded, text_of
from factorgraph_dvl.solvers import steps

PACKAGE = Path(factorgraph_dvl.__file__).parent
KEYS = {f"{group}.{name}" for group, own in catalogue("messages").items() for name in own}
SOURCES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
# Messages inside of others, and those of pages.
PARTS = {"words", "axes", "campaign", "directions", "mount"}


def fields(template: str) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(template) if name is not None}


def calls(name: str) -> list[tuple[Path, ast.Call]]:
    return [
        (path, node)
        for path, tree in SOURCES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name
    ]


def texts(node: ast.AST) -> list[str]:
    return [
        n.value for n in ast.walk(node) if isinstance(n, ast.Constant) and isinstance(n.value, str)
    ]


def test_both_languages_have_the_same_values():
    for group, own in catalogue("messages").items():
        for name, by_language in own.items():
            assert fields(by_language[0]) == fields(by_language[1]), (group, name)


def test_chinese_is_chinese_and_english_is_not():
    chinese = re.compile("[\u4e00-\u9fff]")
    for group, own in catalogue("messages").items():
        for name, by_language in own.items():
            words = re.sub(r"\{.*?\}", "", by_language[0])
            assert not chinese.search(by_language[0]), (group, name)
            assert chinese.search(by_language[1]) or len(words.split()) < 3, (group, name)


def test_groups_are_codes():
    assert {group for group in catalogue("messages") if group not in PARTS} <= {
        str(c) for c in Code
    }


def test_every_message_is_said_somewhere_and_has_its_values():
    said = {text for tree in SOURCES.values() for text in texts(tree)}
    assert said >= KEYS, KEYS - said
    for path, call in calls("message"):
        keys = [key for key in texts(call.args[0]) if "." in key]
        given = {k.arg for k in call.keywords}
        for key in keys:
            assert key in KEYS, f"{path}:{call.lineno}: {key}"
            group, _, name = key.partition(".")
            wanted = fields(catalogue("messages")[group][name][0])
            assert wanted == given, f"{path}:{call.lineno}: {key}: {wanted ^ given}"


def test_findings_are_messages_of_their_code():
    for path, call in calls("Finding"):
        said = call.args[1]
        assert not isinstance(said, ast.JoinedStr | ast.Constant), f"{path}:{call.lineno}"
        code_of = ast.unparse(call.args[0])
        if isinstance(said, ast.Call) and code_of.startswith("Code."):
            code = Code[code_of.removeprefix("Code.")]
            for key in texts(said.args[0]):
                group = key.partition(".")[0]
                assert group in (code, "axes") or "." not in key, f"{path}:{call.lineno}: {key}"


def test_english_is_plain():
    wrong = [
        f"{group}.{name}: {fault}: {sentence}"
        for group, own in catalogue("messages").items()
        for name, by_language in own.items()
        for sentence in split(re.sub(r"\{.*?\}", "`", by_language[0]))
        if sentence.count(" ") >= 3
        for fault in faults(sentence)
    ]
    assert not wrong, "\n".join(wrong)


def test_numbers_and_words_are_written_in_either_language():
    said = message(
        "saturated.ends",
        ends=[message("saturated.above", name="gyro_x", end=np.float64(0.25), count=np.int64(7))],
    )
    assert text_of(said) == "gyro_x is never above 0.25, and is that 7 times: its range ends there"
    assert text_of(said, "zh") == "gyro_x 从不大于 0.25，且有 7 次等于它：这是量程的端点"
    arm = message("antenna.elsewhere", found=[1.0, -0.01, 2.0], std=0.1, stated=np.zeros(3))
    assert "[1.0, 0.0, 2.0] m" in text_of(arm)
    assert "[1.0, 0.0, 2.0] m" in text_of(arm, "zh")


def test_words_follow_their_number():
    one, many = (text_of(message("unused.without_imu", count=n)) for n in (1, 2))
    assert one == "1 measurement at times without IMU data was not used"
    assert many == "2 measurements at times without IMU data were not used"


def test_alternatives_are_joined():
    assert text_of(either(["RFU", "FLU", "FRD"])) == "RFU or FLU or FRD"
    assert either(["FRD"]) == "FRD"


def test_messages_come_back_from_files():
    said = message("unused.measurements", count=3, why=message("unused.too_late", lag=30.0))
    assert decoded(encoded(said), text_of(said)) == said


@pytest.mark.parametrize(
    "data",
    [
        None,
        {"key": "unused.gone", "values": {}},
        {"key": "unused.measurements", "values": {"count": 3}},
        {"key": "unused.measurements", "values": {"count": None, "why": "x"}},
        {"key": "unused", "values": 7},
        {"key": "unused.twice", "values": {}},
    ],
)
def test_what_another_version_wrote_stays_as_it_is(data):
    assert decoded(data, "3 measurements were lost") == "3 measurements were lost"


def test_words_can_be_hidden():
    said = message(
        "unusable_prior.graded", source="cruise.json", reason=message("words.or", first="a.json",
                                                                      rest="b"))  # fmt: skip
    hidden = said.with_words(lambda text: text.replace(".json", ""))
    assert isinstance(hidden, Message)
    assert text_of(hidden) == "cruise is graded `do not use`: a or b"


def test_components_have_the_names_of_their_parameters_in_chinese():
    assert chinese("misalignment x") == "安装误差角 x"
    assert chinese("GNSS lever arm z") == "GNSS 杆臂 z"
    assert chinese("x") == "x"


def test_steps_of_the_solver_have_chinese_names():
    kinds = [kind for kind in vars(steps).values() if isinstance(kind, type)]
    names = {name for kind in kinds if isinstance(name := getattr(kind, "name", None), str)}
    assert "gross errors" in names
    assert [name for name in sorted(names | {"start"}) if chinese(name) == name] == []
