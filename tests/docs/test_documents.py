"""Every code block and command of the documents runs, and every table renders.

A block runs in a folder of its document, after the blocks before it, on trials of a minute. One
that is not run says so on the line before it: `<!-- not run: reason -->`; one that takes long:
`<!-- slow: reason -->`.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from markdown_tables import faults
from running import Run, run  # noqa: F401
from truth import merged, scenario

from factorgraph_dvl.files.external_results import read_calibration_values
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.segments_file import read_segments
from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.files.trial_yaml import TrialSettings
from factorgraph_dvl.settings.yaml_file import parse_yaml
from factorgraph_dvl.simulation import parse_scenario, simulate

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (
        *ROOT.glob("*.md"),
        *(
            p
            for name in ("docs", "data", "benchmarks", "examples")
            for p in ROOT.glob(f"{name}/**/*.md")
        ),
    )
)


@dataclass(frozen=True)
class Block:
    """A fenced block, or a command that is indented; how it is marked, and its line."""

    language: str
    text: str
    mark: str
    line: int


def blocks_of(text: str) -> Iterator[Block]:
    """Yield the blocks of a document in their order."""
    lines = text.splitlines()
    i = 0
    while i < len(lines):
        before = lines[i - 1] if i else ""
        mark = before[4:-3].strip() if before.startswith("<!--") else ""
        if fence := re.fullmatch(r"```(\w*|\{[\w-]+\})", lines[i]):
            end = lines.index("```", i + 1)
            # Directives of the site are no code.
            if not fence[1].startswith("{"):
                yield Block(fence[1], "\n".join(lines[i + 1 : end]) + "\n", mark, i + 1)
            i = end
        elif re.match(r"    factorgraph-dvl ", lines[i]):
            yield Block("sh", lines[i].strip() + "\n", mark, i + 1)
        i += 1


BLOCKS = {name: list(blocks_of((ROOT / name).read_text(encoding="utf-8"))) for name in DOCUMENTS}


def is_run(block: Block) -> bool:
    return not block.mark.startswith(("not run:", "command:"))


def run_documents(*, slow: bool) -> list[str]:
    """Return the documents that have blocks of the one kind."""
    return [
        name
        for name, blocks in BLOCKS.items()
        if any(is_run(b) and b.mark.startswith("slow:") == slow for b in blocks)
        # Translations have the commands of the original.
        and not name.endswith(".zh.md")
    ]


@pytest.fixture(scope="module")
def stock(tmp_path_factory) -> Path:
    """Trials of a minute, and solutions of them."""
    folder = tmp_path_factory.mktemp("stock")
    dvl = simulate(scenario(noise=True), 1)
    save_trial(dvl, folder / "trial")
    star = scenario(noise=True, epoch="2018-12-01T05:30:00Z", star={"rate_hz": 2, "std_arcsec": 5})
    save_trial(simulate(star, 1), folder / "star")
    beams = {
        "rate_hz": 5,
        "slant_azimuth_deg": [[30, 45], [30, 135], [30, 225], [30, 315]],
        "velocity_std_m_s": 0.002,
    }
    claims = {"dvl": None, "dvl_beams": {"velocity_std_m_s": 0.002}}
    save_trial(
        simulate(scenario(noise=True, dvl=None, dvl_beams=beams, trial=claims), 1),
        folder / "beams",
    )
    (folder / "segments.yaml").write_text("segments: [{start_s: 0, end_s: 30, label: first}]\n")
    easy_plan(folder / "PLAN.yaml")
    fix = b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76\r\n"
    (folder / "record.nmea").write_bytes(fix)
    for name in ("trial", "beams"):
        code = invoke("solve", folder / name, "--out", folder / f"{name}-solution", "--no-figures")
        assert code == 0, name
    kalman = ("kalman", folder / "trial", "--out", folder / "kalman-solution", "--no-figures")
    assert invoke(*kalman) == 0
    return folder


def easy_plan(path: Path) -> None:
    """Write the plan of configs/ with requirements that it meets: nothing is searched for."""
    plan = yaml.safe_load((ROOT / "configs/plans/harbour.yaml").read_text(encoding="utf-8"))
    plan["required"] = {"misalignment_deg": 10, "scale_error": 1}
    path.write_text(yaml.safe_dump(plan), encoding="utf-8")


def invoke(*args: object) -> int:
    from factorgraph_dvl.cli import main

    with pytest.raises(SystemExit) as caught:
        main([str(a) for a in args])
    return int(caught.value.code or 0)


@pytest.fixture
def bench(stock, tmp_path, monkeypatch) -> Path:
    """A folder as the root of the repository, but its trial, cruise and plan are short."""
    for name in ("examples", "configs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    cruise = tmp_path / "configs" / "cruise.yaml"
    data = yaml.safe_load(cruise.read_text(encoding="utf-8"))
    cruise.write_text(yaml.safe_dump({**data, "manoeuvres": [{"straight_s": 20}]}))
    easy_plan(tmp_path / "configs" / "plans" / "harbour.yaml")
    shutil.copytree(stock / "trial", tmp_path / "data" / "seed-a-phase-90")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def arguments(command: str, line: str, stock: Path) -> list[str]:
    """Return a command's arguments, with its placeholders filled in."""
    trial = "trial"
    if command == "correct" or "beams" in line.split("#")[0]:
        trial = "beams"
    elif "--method star" in line:
        trial = "star"
    solution = stock / ("beams-solution" if trial == "beams" else "trial-solution")
    names = {
        "TRIAL": stock / trial,
        "CALIBRATION": solution / "calibration.json",
        "FILE": solution / "calibration.json",
        "A": stock / "trial-solution",
        "B": stock / "kalman-solution",
        "PLAN.yaml": stock / "PLAN.yaml",
        "RECORD": stock / "record.nmea",
    }
    words = shlex.split(line, comments=True)[1:]
    count = len(list(Path().glob("dir-*")))
    names["DIR"] = Path(f"dir-{count}")
    if "simulate" in words or "import" in words:
        names["TRIAL"] = Path(f"dir-{count}")
    # `--efficient A` is a choice.
    before = ["", *words]
    given = [
        word if previous == "--efficient" else str(names.get(word, word))
        for previous, word in zip(before, words, strict=False)
    ]
    if command == "reproduce" and "--table" not in given:
        # All of a publication takes a minute, and has a test of its own.
        given += ["--table", "3"]
    # Drawing is tested elsewhere, and takes longer than all else on a trial of a minute.
    return [*given, "--no-figures"] if "--no-figures" in options(command) else given


def options(command: str) -> set[str]:
    """Return the options that a command has."""
    from factorgraph_dvl.cli.commands import command as command_named

    return {option for p in command_named(command).params for option in p.opts}


def run_shell(block: Block, stock: Path, run: Run) -> None:  # noqa: F811
    for line in block.text.splitlines():
        if not line.startswith("factorgraph-dvl "):
            # Only what makes files for the commands.
            echoed = re.fullmatch(r"echo '(.*)' >> (\S+)", line)
            assert echoed, f"no such command is known here: {line}"
            with Path(echoed[2]).open("a", encoding="utf-8") as file:
                file.write(echoed[1] + "\n")
            continue
        command = line.split()[1]
        result = run(*arguments(command, line, stock))
        assert result.code == 0, f"{line}\n{result.out}\n{result.err}"
        # Options that a comment names are there.
        comment = line.partition("#")[2]
        assert set(re.findall(r"--[a-z-]+", comment)) <= options(command), line


def run_yaml(block: Block, folder: Path) -> None:
    """Read a block as what it is: scenario, plan, trial or part of one, segments, values."""
    data = yaml.safe_load(block.text)
    file = folder / "block.yaml"
    file.write_text(block.text, encoding="utf-8")
    if "segments" in data:
        assert read_segments(file)
    elif "tables" in data:
        assert parse_yaml(block.text, MappingSettings, source="block").tables
    elif "manoeuvres" in data:
        parse_scenario(data)
    elif "required" in data:
        harbour = yaml.safe_load((ROOT / "configs/plans/harbour.yaml").read_text(encoding="utf-8"))
        parse_scenario(harbour | data)
    elif "misalignment_deg" in data:
        assert read_calibration_values(file, "FRD").keys() == data.keys()
    else:
        base = {
            "format": 1,
            "body_axes": "FRD",
            "imu": {
                "gyro_noise_deg_sqrt_h": 0.003,
                "gyro_bias_std_deg_h": 0.05,
                "accel_noise_ug_sqrt_hz": 30,
                "accel_bias_std_ug": 100,
            },
        }
        whole = block.text if "format" in data else yaml.safe_dump(merged(base, data))
        parse_yaml(whole, TrialSettings, source="block")


def run_blocks(name: str, stock: Path, folder: Path, run: Run, *, slow: bool) -> None:  # noqa: F811
    namespace: dict[str, object] = {}
    for block in BLOCKS[name]:
        where = f"{name}:{block.line}"
        if not is_run(block) or (block.mark.startswith("slow:") and not slow):
            continue
        if block.language == "sh":
            run_shell(block, stock, run)
        elif block.language == "python":
            exec(compile(block.text, where, "exec"), namespace)
        elif block.language == "yaml":
            run_yaml(block, folder)
        elif block.language in ("text", "math"):
            continue
        elif block.language == "json":
            json.loads(block.text)
            (folder / "block.json").write_text(block.text, encoding="utf-8")
            assert read_calibration_values(folder / "block.json", "FRD")
        else:
            pytest.fail(f"{where}: no language, so nothing says how to run it")


# They take long, and the commands of most are run by the blocks of other pages too.
LONG = (
    "README.md",
    "docs/crosscheck.md",
    "docs/getting-started.md",
    "docs/kalman.md",
    "docs/replay.md",
    "docs/underwater.md",
)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in LONG else ())
        for name in run_documents(slow=False)
    ],
)
def test_blocks_run(name, stock, bench, run):  # noqa: F811
    run_blocks(name, stock, bench, run, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", run_documents(slow=True))
def test_slow_blocks_run(name, stock, bench, run):  # noqa: F811
    run_blocks(name, stock, bench, run, slow=True)


def test_blocks_that_are_not_run_say_why():
    found = {
        name: [b.mark.partition(":")[2].split()[0] for b in blocks if not is_run(b)]
        for name, blocks in BLOCKS.items()
    }
    found = {name: reasons for name, reasons in found.items() if reasons}
    assert found == {
        "README.md": ["solve", "it", "it", "test"],
        "README.zh.md": ["the", "it"],
        "CONTRIBUTING.md": ["environment"],
        "data/README.md": ["compared"],
        "docs/allan.md": ["takes"],
        "docs/beacon.md": ["the"],
        "docs/bluerov.md": ["recordings", "recordings", "needs", "the"],
        "docs/campaign.md": ["it"],
        "docs/events.md": ["needs", "needs"],
        "docs/formats.md": ["a"],
        "docs/before-solving.md": ["recordings", "recordings"],
        "docs/getting-started.md": ["recordings"],
        "docs/getting-started.zh.md": ["recordings"],
        "docs/import.md": ["recordings", "needs"],
        "docs/underwater.md": ["needs"],
        "docs/underwater.zh.md": ["needs"],
        "docs/verdict.md": ["part"],
        "examples/compass-plugin/README.md": ["installs"],
    }


@pytest.mark.parametrize("name", [n for n in DOCUMENTS if n.endswith(".zh.md")])
def test_translations_have_the_commands_of_the_original(name):
    def plain(block: Block) -> str:
        return re.sub(r" *#.*", "", block.text)

    original = [plain(block) for block in BLOCKS[name.replace(".zh.md", ".md")]]
    translated = [plain(block) for block in BLOCKS[name]]
    if name.startswith("docs"):
        assert translated == original
    assert set(translated) <= set(original)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_tables_render(name):
    assert faults((ROOT / name).read_text(encoding="utf-8")) == []


def test_tables_that_do_not_render_are_found():
    assert faults("text\n| a | b |\n|---|---|\n| 1 | 2 |\n") == ["line 2: no blank line before"]
    assert faults("\n| a | b |\n|---|---|\n| 1 |\n") == ["line 4: 1 cells, not 2"]
    assert faults("\n| a | b |\n| 1 | 2 |\n") == ["line 2: no header"]
    assert faults("\n| a | b |\n|---|---|\n| 1 | `x|y` |\n") == ["line 4: 3 cells, not 2"]
    assert faults("\n| a | b |\n|---|---|\n| 1 | `x\\|y` |\ntext\n") == ["line 5: text in a table"]
    assert faults("\n| a | b |\n|---|---|\n| 1 | 2 |\n\n```\n| no\n```\n") == []


@pytest.mark.parametrize("name", DOCUMENTS)
def test_paragraphs_are_apart(name):
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    # One that begins with a heading in bold is a paragraph of its own.
    lead = re.compile(r"\*\*[^*]+\.\*\* ")
    glued = [b for a, b in pairwise(lines) if a and lead.match(b)]
    assert not glued


@pytest.mark.parametrize("path", sorted(ROOT.glob("configs/**/*.yaml")), ids=lambda p: p.name)
def test_commands_in_configs_name_what_is_there(path):
    text = path.read_text(encoding="utf-8")
    for command in re.findall(r"factorgraph-dvl (\w+)", text):
        assert options(command)
