"""Output folders: what they may not replace, kills at every step, runs beside each other."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from builders import build_history, build_solution, edit, write_trial
from truth import CONFIGS

import factorgraph_dvl.solvers.information_along_trial
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files import folders
from factorgraph_dvl.files.folders import claim, new_folder
from factorgraph_dvl.files.solution_folder import save_solution

OWNED = ("result.json", "table.csv", "figures/*.png")


def run(*args):
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    return caught.value.code


def files(folder):
    """Content of all that lies in a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def write(path, content, **options):
    with new_folder(path, owned=OWNED, **options) as folder:
        (folder / "table.csv").write_text(content)
        (folder / "figures").mkdir()
        (folder / "figures" / "track.png").write_text(content)
        (folder / "result.json").write_text(content)


# Every command that writes, with TRIAL, RESULT and OUT to be put in.
COMMANDS = {
    "solve": ("solve", "TRIAL", "--out", "OUT"),
    "replay": ("replay", "TRIAL", "--out", "OUT"),
    "kalman": ("kalman", "TRIAL", "--out", "OUT"),
    "observability": ("observability", "TRIAL", "--out", "OUT"),
    "deadreckon": ("deadreckon", "TRIAL", "RESULT", "--out", "OUT"),
    "correct": ("correct", "TRIAL", "RESULT", "--out", "OUT"),
    "crosscheck": ("crosscheck", "RESULT", "RESULT", "--reference", "TRIAL", "--out", "OUT"),
    "plan": ("plan", CONFIGS / "plans" / "harbour.yaml", "--out", "OUT"),
    "simulate": ("simulate", CONFIGS / "seed-a-phase-0.yaml", "--out", "OUT"),
    "reproduce": ("reproduce", "chen-2021", "--out", "OUT"),
    "allan": ("allan", "IMU", "--out", "OUT"),
    "campaign": ("campaign", "TRIAL", "--out", "OUT"),
    "demo": ("demo", "--no-browser", "--out", "OUT"),
    "export": ("export", "RESULT", "--to", "tum", "--out", "OUT"),
    "import": ("import", "IMU", "--out", "OUT"),
    "report": ("report", "RESULT", "--out", "OUT"),
}


def test_every_command_with_an_output_is_here():
    from factorgraph_dvl.cli.commands import COMMANDS as NAMES
    from factorgraph_dvl.cli.commands import command

    writing = {name for name in NAMES if any(p.name == "out" for p in command(name).params)}
    assert writing == set(COMMANDS)


@pytest.mark.parametrize("force", [(), ("--force",)])
@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_writes_over_a_trial(tmp_path, capsys, command, force):
    trial = write_trial(tmp_path)
    for name in ("beams.csv", "trajectory.csv", "notes.txt"):
        (trial / name).write_text("mine")
    (trial / "figures").mkdir()
    (trial / "figures" / "track.png").write_text("mine")
    result = tmp_path / "result"
    save_solution(build_solution(), result)
    (tmp_path / "link").symlink_to(trial)
    before = files(tmp_path)
    for out in (trial, tmp_path / "link", trial / ".." / "trial"):
        named = {"TRIAL": trial, "RESULT": result, "OUT": out, "IMU": trial / "imu.csv"}
        code = run(*(named.get(word, word) for word in COMMANDS[command]), *force)
        assert code == 2
        said = capsys.readouterr().err
        assert "trial" in said or "is a folder" in said
    assert files(tmp_path) == before


@pytest.mark.parametrize("where", ["named file", "named calibration", "linked table", "parent"])
@pytest.mark.parametrize("command", ["solve", "replay", "kalman", "observability"])
def test_no_command_writes_over_what_a_trial_names(tmp_path, capsys, command, where):
    trial, out = write_trial(tmp_path), tmp_path / "out"
    out.mkdir()
    save_solution(build_solution(), out, force=True)
    if where == "parent":
        trial = trial.rename(out / "trial")
    elif where == "named calibration":
        edit(trial / "trial.yaml", "dvl:\n", "dvl:\n  calibration: ../out\n")
    else:
        (trial / "imu.csv").rename(out / "raw.csv")
        if where == "named file":
            edit(trial / "trial.yaml", "file: imu.csv", "file: ../out/raw.csv")
        else:
            (trial / "imu.csv").symlink_to(out / "raw.csv")
    before = files(tmp_path)
    assert run(command, trial, "--out", out, "--force") == 2
    assert "which this command reads" in capsys.readouterr().err
    assert files(tmp_path) == before


@pytest.mark.parametrize("option", ["RESULT", "--segments", "--truth"])
def test_no_command_writes_over_its_other_inputs(tmp_path, capsys, option):
    trial, out = write_trial(tmp_path), tmp_path / "out"
    save_solution(build_solution(), out)
    (out / "extra.yaml").write_text("{}")
    commands = {
        "RESULT": ("deadreckon", trial, out / "calibration.json"),
        "--segments": ("observability", trial, "--segments", out / "extra.yaml"),
        "--truth": ("crosscheck", trial, trial, "--truth", out / "extra.yaml"),
    }
    before = files(tmp_path)
    assert run(*commands[option], "--out", out, "--force") == 2
    assert "which this command reads" in capsys.readouterr().err
    assert files(tmp_path) == before


def test_simulate_replaces_only_what_it_wrote(tmp_path, capsys):
    config, out = CONFIGS / "one-beacon.yaml", tmp_path / "out"
    assert run("simulate", config, "--out", out, "--seed", 1) == 0
    (out / "notes.txt").write_text("mine")
    first = files(out)
    assert run("simulate", config, "--out", out, "--seed", 2) == 2
    assert run("simulate", config, "--out", out, "--seed", 2, "--force") == 0
    second = files(out)
    assert second.keys() == first.keys()
    assert second["notes.txt"] == b"mine"
    assert second["beacon.csv" if "beacon.csv" in second else "beacons.csv"] != first.get(
        "beacon.csv", first.get("beacons.csv")
    )
    raw = tmp_path / "raw"
    raw.mkdir()
    (raw / "imu.csv").write_text("mine")
    assert run("simulate", config, "--out", raw, "--force") == 2
    assert "contains imu.csv but no trial.yaml" in capsys.readouterr().err
    assert files(raw) == {"imu.csv": b"mine"}


def test_the_working_folder_and_a_mounted_disk_are_not_replaced(tmp_path, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.chdir(out)
    with pytest.raises(DataError, match="working folder"):
        write(Path(), "new")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == out)
    with pytest.raises(DataError, match="mounted"):
        write(out, "new", force=True)
    assert files(tmp_path) == {"out": None}


def test_force_keeps_every_file_of_others(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write(out, "old")
    (out / "figures" / "mine.jpg").write_text("mine")
    (out / "notes" / "deep").mkdir(parents=True)
    (out / "notes" / "deep" / "a.txt").write_text("mine")
    (out / "notes" / "link").symlink_to("nowhere")
    (out / "empty").mkdir(mode=0o750)
    out.chmod(0o755)
    others = {name: text for name, text in files(out).items() if text != b"old"}
    for round_, how in enumerate(("exchange", "no links", "no exchange", "neither")):
        with monkeypatch.context() as patch:
            if how in ("no links", "neither"):
                patch.setattr(os, "link", _fails)
            if how in ("no exchange", "neither"):
                patch.setattr(folders, "_exchange", _fails)
            write(out, f"new {round_}", force=True)
        now = files(out)
        assert {name: now[name] for name in others} == others
        assert (out / "notes" / "link").readlink() == Path("nowhere")
        assert now.keys() - others.keys() == {"result.json", "table.csv", "figures/track.png"}
        assert now["table.csv"] == f"new {round_}".encode()
        assert out.stat().st_mode & 0o777 == 0o755
        assert [path.name for path in tmp_path.iterdir()] == ["out"]


def _fails(*_, **__):
    raise OSError(1, "not on this disk")


def test_force_replaces_no_file_of_a_name_it_did_not_write(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "table.csv").write_text("mine")
    with pytest.raises(DataError, match=r"contains table\.csv but no result\.json"):
        write(out, "new", force=True)
    assert files(tmp_path) == {"out": None, "out/table.csv": b"mine"}


# For each line `content step` a process of its own writes a result, and kills itself at that line
# of what replaces the old one; answers how it ended, and how many lines it took.
_KILLED = """
import os, signal, sys
from pathlib import Path
from factorgraph_dvl.files import folders

out = Path(sys.argv[1])
if sys.argv[2] == "no":
    def fails(*_):
        raise OSError(22, "not on this disk")
    folders._exchange = fails

def write(content, step):
    count = 0
    def watch(frame, event, argument):
        nonlocal count
        if frame.f_code.co_filename != folders.__file__:
            return None
        count += 1
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return watch
    sys.settrace(watch)
    with folders.new_folder(out, force=True, owned=("result.json", "table.csv")) as folder:
        (folder / "table.csv").write_text(content)
        (folder / "result.json").write_text(content)
    sys.settrace(None)
    return count

for line in sys.stdin:
    content, step = line.split()
    read, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(written, str(write(content, int(step))).encode())
        os._exit(0)
    os.close(written)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(status, os.read(read, 20).decode() or 0, flush=True)
    os.close(read)
"""
_KILLS = 50


@contextmanager
def killer(out, exchange):
    """Yield what writes to a folder and is killed at a step: returns exit code and lines."""
    command = [sys.executable, "-c", _KILLED, str(out), exchange]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:

        def ask(content, step):
            process.stdin.write(f"{content} {step}\n")
            code, lines = process.stdout.readline().split()
            return int(code), int(lines)

        yield ask
        process.stdin.close()


@pytest.mark.parametrize("exchange", ["yes", "no"])
def test_a_complete_result_stands_after_every_kill(tmp_path, exchange):
    out = tmp_path / "out"
    with killer(out, exchange) as killed:
        _kill_at_every_step(out, killed, exchange)
    with claim(out, force=True):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def _kill_at_every_step(out, killed, exchange):
    assert killed("first", 0)[0] == 0
    (out / "notes").mkdir()
    (out / "notes" / "a.txt").write_text("mine")
    _, lines = killed("0", 0)
    missing = replaced = 0
    for i, step in enumerate(np.linspace(1, lines, _KILLS).astype(int), 1):
        code, _ = killed(str(i), step)
        assert code == -signal.SIGKILL
        if not out.exists():
            # Two renames, where the file system cannot trade names: the next run repairs it.
            assert exchange == "no"
            missing += 1
            with claim(out, force=True):
                pass
        now = files(out)
        assert now.keys() == {"result.json", "table.csv", "notes", "notes/a.txt"}
        assert now["result.json"] == now["table.csv"]
        assert int(now["table.csv"]) <= i
        assert now["notes/a.txt"] == b"mine"
        replaced += now["table.csv"] == str(i).encode()
    assert 0 < replaced < _KILLS
    assert missing <= 5


def test_a_killed_run_leaves_no_new_folder_behind(tmp_path):
    out = tmp_path / "out"
    with killer(out, "yes") as killed:
        _, lines = killed("0", 0)
        for step in range(1, lines, 7):
            shutil.rmtree(out)
            code, _ = killed("half", step)
            assert code == -signal.SIGKILL
            if out.exists():
                assert files(out) == {"result.json": b"half", "table.csv": b"half"}
            write(out, "whole", force=True)
            assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_second_run_into_one_output_fails_at_once(tmp_path, capsys, monkeypatch):
    out, trial = tmp_path / "out", write_trial(tmp_path)
    codes = []

    def solve(*_, **__):
        # While the first run computes, another process starts the same.
        codes.append(
            subprocess.run(
                [sys.executable, "-m", "factorgraph_dvl.cli", "solve", trial, "--out", out],
                capture_output=True,
                text=True,
                check=False,
            )
        )
        return (solution := build_solution()), build_history(solution)

    module = factorgraph_dvl.solvers.information_along_trial
    monkeypatch.setattr(module, "solve_with_history", solve)
    assert run("solve", trial, "--out", out, "--no-figures") == 0
    (second,) = codes
    assert second.returncode == 2
    assert "another run is writing to this folder" in second.stderr
    assert json.loads((out / "calibration.json").read_text())["trial"] == "by hand"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "trial"]
    # The folder is free again.
    assert run("solve", trial, "--out", out, "--no-figures") == 2
    assert "--force" in capsys.readouterr().err


def test_of_two_runs_that_know_nothing_of_each_other_one_fails(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(DataError, match="not empty"), new_folder(out) as folder:  # noqa: PT012
        (folder / "result.json").write_text("second")
        # As on disks whose locks other machines do not see.
        out.mkdir()
        (out / "result.json").write_text("first")
    assert files(tmp_path) == {"out": None, "out/result.json": b"first"}


def test_an_output_that_cannot_appear_leaves_no_folder(tmp_path):
    trial = write_trial(tmp_path)
    (trial / "imu.csv").unlink()
    assert run("solve", trial, "--out", tmp_path / "deep" / "out") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["trial"]


def test_only_what_a_run_wrote_is_listed(tmp_path, capsys):
    line = ["--json", "simulate", CONFIGS.parent / "examples" / "short.yaml", "--out"]
    out = tmp_path / "out"
    assert run(*line, out) == 0
    first = capsys.readouterr().out
    (out / "notes.json").write_text("mine, and no JSON")
    (out / "mine").mkdir()
    (out / "mine" / "notes.txt").write_text("mine")
    assert run(*line, out, "--force") == 0
    assert capsys.readouterr().out == first
    (written,) = (e for e in map(json.loads, first.splitlines()) if e["event"] == "written")
    assert set(written["files"]) == {p.name for p in out.iterdir()} - {"notes.json", "mine"}


def test_an_output_that_is_a_loop_of_links_is_refused(tmp_path, capsys):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    trial = write_trial(tmp_path)
    before = sorted(tmp_path.iterdir())
    for out in (tmp_path / "a", tmp_path / "a" / "result"):
        for options in ((), ("--force",)):
            assert run("solve", trial, "--out", out, *options) == 2
            said = capsys.readouterr().err
            assert f"error: {out}: is a link that leads back to itself; expected a folder" in said
    assert run("export", trial, "--to", "netcdf", "--out", tmp_path / "a") == 2
    assert "a: the file exists; expected a new file" in capsys.readouterr().err
    assert run("export", trial, "--to", "netcdf", "--out", tmp_path / "a" / "x.nc") == 2
    assert "the folder does not exist" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_is_not_written_below_what_is_no_folder(tmp_path, capsys):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    trial = write_trial(tmp_path)
    assert run("solve", trial, "--out", pipe / "result") == 2
    assert f"result: {pipe} is not a folder; expected a folder" in capsys.readouterr().err


def test_an_output_file_takes_the_place_of_no_device(tmp_path, capsys):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    trial = write_trial(tmp_path)
    assert run("export", trial, "--to", "netcdf", "--out", pipe, "--force") == 2
    assert "is a pipe or a device; expected the name of a file" in capsys.readouterr().err
    assert pipe.is_fifo()


@pytest.mark.parametrize(
    ("owner", "name"), [(shutil, "rmtree"), (Path, "unlink"), (Path, "rmdir"), (os, "close")]
)
def test_an_interrupt_while_a_run_cleans_up_leaves_nothing(tmp_path, monkeypatch, owner, name):
    done, came = getattr(owner, name), []

    def interrupted(*args, **options):
        if not came:
            came.append(name)
            raise KeyboardInterrupt
        return done(*args, **options)

    def fail():
        with new_folder(tmp_path / "deep" / "out", owned=OWNED):
            monkeypatch.setattr(owner, name, interrupted)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert came == [name]
    assert list(tmp_path.iterdir()) == []
