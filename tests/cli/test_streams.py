"""What becomes of output that cannot be written, of interrupts, of too little memory."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from builders import build_solution, build_trial, edit, write_trial
from running import Run
from truth import scenario

from factorgraph_dvl.cli.commands import naming_memory
from factorgraph_dvl.cli.exit_codes import exit_code_of
from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.files.solution_folder import save_solution

CLI = (sys.executable, "-m", "factorgraph_dvl.cli")


def inspect(trial: Path, **streams: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*CLI, "inspect", str(trial)], text=True, timeout=120, check=False, **streams
    )


def test_output_that_cannot_be_written_is_said_and_exits_1(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    with open("/dev/full", "w") as full:
        done = inspect(trial, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 1
    assert "standard output cannot be written (No space left on device)" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [(), ("--json",)])
@pytest.mark.parametrize("command", ["--version", "--help", "inspect", "report", "export"])
def test_every_command_says_that_its_output_cannot_be_written(
    tmp_path: Path, command: str, as_json: tuple[str, ...]
) -> None:
    save_solution(build_solution(), tmp_path / "solution")
    given = {
        "inspect": [str(write_trial(tmp_path))],
        "report": [str(tmp_path / "solution")],
        "export": [str(tmp_path / "solution"), "--to", "tum"],
    }.get(command, [])
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*CLI, *as_json, command, *given],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 1
    said = "error: standard output cannot be written (No space left on device); the files of this"
    assert said in done.stderr


def test_events_that_cannot_be_written_are_said_beside_the_exit_code_of_the_error(
    tmp_path: Path,
) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*CLI, "--json", "inspect", str(tmp_path / "none")],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == ("error: standard output cannot be written (No space left on device)\n")


def test_a_reader_that_has_enough_is_no_error(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    read, write = os.pipe()
    os.close(read)
    try:
        done = inspect(trial, stdout=write, stderr=subprocess.PIPE)
    finally:
        os.close(write)
    assert done.returncode == 0
    assert done.stderr == ""


def test_messages_that_cannot_be_written_change_no_exit_code(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        assert inspect(tmp_path / "none", stdout=full, stderr=full).returncode == 2


@pytest.mark.parametrize("module", ["rich", "pyarrow", "scipy"])
def test_an_interrupt_while_modules_load_is_one_line(tmp_path: Path, module: str) -> None:
    trial = write_trial(tmp_path)
    # Loading that module stands still, as it may on a slow disk.
    stall = (
        "import signal, sys, time\n"
        # Also where the tests run in the background, which ignores interrupts.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Stall:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            print('stalled', flush=True)\n"
        "            time.sleep(60)\n"
        "sys.meta_path.insert(0, Stall())\n"
        "from factorgraph_dvl.cli import main\n"
        f"main(['inspect', {str(trial)!r}])\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", stall], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "stalled\n"
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "error: interrupted\n"


def test_too_little_memory_says_what_the_trial_takes(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)

    def command(trial_path: Path) -> None:
        raise MemoryError

    with pytest.raises(SolveError) as caught:
        naming_memory(command)(trial_path=trial)
    samples = build_trial().imu.time.size
    assert f"{samples} IMU samples" in str(caught.value)
    assert "about 0.3 GB" in str(caught.value)
    assert "lower rate" in str(caught.value)
    assert exit_code_of(caught.value) == 1


def test_names_give_a_terminal_no_orders(tmp_path: Path, run: Run) -> None:
    trial = write_trial(tmp_path)
    edit(trial / "trial.yaml", "name: by hand", 'name: "a\\e[31m\\x9b2J\u202eb"')
    shown = run("inspect", trial)
    assert r"a\x1b[31m\x9b2J\u202eb" in shown.out
    edit(trial / "trial.yaml", "body_axes:", '"k\\e[2J": 1\nbody_axes:')
    refused = run("inspect", trial)
    assert r"unknown key `k\x1b[2J`" in refused.err
    assert not set("\x1b\x9b\u202e") & set(shown.out + shown.err + refused.out + refused.err)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize(
    ("locale", "name"),
    [
        # Python decodes names as ASCII, which leaves `é` as two bytes.
        ({"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, "Séa".encode()),
        # Latin-1 within UTF-8.
        ({"LC_ALL": "C.UTF-8"}, b"S\xe9a"),
    ],
)
def test_names_that_are_not_text_work(
    tmp_path: Path, locale: dict[str, str], name: bytes, suffix: str
) -> None:
    folder = os.path.join(os.fsencode(tmp_path), name)
    os.mkdir(folder)
    config = Path(__file__).resolve().parents[2] / "examples" / "short.yaml"
    trial, solution, out = (os.path.join(folder, name + b"-" + x) for x in (b"t", b"s", b"o"))
    lines: list[list[str | bytes]] = [
        ["simulate", str(config), "--out", trial, *(["--parquet"] * (suffix == ".parquet"))],
        ["inspect", trial],
        ["kalman", trial, "--out", solution, "--no-figures", "--anyway"],
        ["crosscheck", solution, solution, "--out", out, "--no-figures", "--anyway"],
        ["report", solution, solution, "--out", out + b".html"],
        ["export", trial, "--to", "mcap", "--out", out + b".mcap"],
        ["import", out + b".mcap", "--out", out + b"-imported"],
    ]
    for line in lines:
        done = subprocess.run(
            [*CLI, "--json", *line],
            env={**os.environ, **locale},
            capture_output=True,
            timeout=300,
            check=False,
        )
        assert b"internal" not in done.stdout
        assert done.returncode in (0, 1), (line, done)
        events = [json.loads(text) for text in done.stdout.decode("utf-8", "replace").splitlines()]
        assert not [e for e in events if e["event"] == "warning" and "could not" in e["text"]]
    assert set(os.listdir(folder)) == {
        name + ending
        for ending in (b"-t", b"-s", b"-o", b"-o.html", b"-o.mcap", b"-o.bag", b"-o-imported")
    }


def test_a_name_that_the_locale_has_no_bytes_for_is_an_error(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    edit(trial / "trial.yaml", "dvl.csv", "dvlé.csv")
    done = subprocess.run(
        [*CLI, "inspect", str(trial)],
        env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert "the name of the file cannot be written in ascii" in done.stderr
    assert "LC_ALL=C.UTF-8" in done.stderr


@pytest.mark.parametrize(
    "line", ["inspect trial", "solve trial --out out", "simulate x --out out"]
)
@pytest.mark.parametrize("as_json", [(), ("--json",)])
def test_a_current_directory_that_was_deleted_is_said(
    tmp_path: Path, line: str, as_json: tuple[str, ...]
) -> None:
    script = (
        f"import os; os.mkdir({str(tmp_path / 'gone')!r}); os.chdir({str(tmp_path / 'gone')!r})\n"
        f"os.rmdir({str(tmp_path / 'gone')!r})\n"
        "from factorgraph_dvl.cli import main\n"
        f"main({[*as_json, *line.split()]!r})\n"
    )
    # As an installed command, without the current directory on its path: with it, Python 3.13.0
    # fails at any attribute that a module lacks.
    done = subprocess.run(
        [sys.executable, "-P", "-c", script],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert "the current directory no longer exists" in (done.stdout if as_json else done.stderr)


def test_a_full_disk_is_named_with_the_output_and_leaves_nothing(tmp_path: Path) -> None:
    def little_room() -> None:
        # A file may grow to 4 kB only, as on a disk that is nearly full.
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    config = Path(__file__).resolve().parents[2] / "examples" / "short.yaml"
    done = subprocess.run(
        [*CLI, "simulate", str(config), "--out", str(tmp_path / "out")],
        preexec_fn=little_room,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1
    assert f"{tmp_path / 'out'}: cannot be written: File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_names_of_scenarios_give_a_terminal_no_orders() -> None:
    assert scenario(name="a\x1b[31m").name == r"a\x1b[31m"
