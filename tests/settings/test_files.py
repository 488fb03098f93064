"""Files that are read whole."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from builders import build_solution, write_trial
from running import Run, run

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.solution_folder import save_solution
from factorgraph_dvl.settings.files import read_bytes

__all__ = ["run"]


def test_a_file_is_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"a: 1\n")
    assert read_bytes(path, limit=5, expected="settings") == b"a: 1\n"


def socket_at(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))
    return path


def loop_at(path):
    path.symlink_to(path)
    return path


def test_what_is_no_file_of_moderate_size_is_refused_with_its_reason(tmp_path):
    large = tmp_path / "large"
    large.write_bytes(b"x" * 2_000_001)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, said in (
        (large, "2 MB.*settings, at most 1 MB"),
        (pipe, "is a pipe; expected a regular file: settings"),
        (socket_at(tmp_path / "socket"), "is a socket"),
        ("/dev/zero", "is a device"),
        (tmp_path, "is a folder"),
        (loop_at(tmp_path / "loop"), "is a link that leads back to itself; expected settings"),
        (tmp_path / "none", "does not exist"),
        (large / "below", "does not exist"),
        ("a\0b", "is not the name of a file"),
    ):
        with pytest.raises(DataError, match=said):
            read_bytes(path, limit=1_000_000, expected="settings")


def test_the_kind_of_error_is_the_callers(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        read_bytes(tmp_path / "none", limit=1, expected="settings", kind=ConfigError)


# Commands, and the files that they read: of a trial T, of a result S, a file F, a file in JSON J.
READ = (
    ("inspect T", ["T/trial.yaml", "T/imu.csv", "T/gnss.csv", "T/dvl.csv", "T/truth.json"]),
    ("solve T --out O", ["T/trial.yaml", "T/imu.csv", "T/gnss.csv", "T/dvl.csv"]),
    ("replay T --out O", ["T/dvl.csv"]),
    ("kalman T --out O", ["T/dvl.csv"]),
    ("observability T --out O", ["T/dvl.csv"]),
    ("observability T --out O --segments F", ["F"]),
    ("observability S --out O", ["S/calibration.json", "S/trajectory.csv"]),
    ("campaign T --out O --covariates F", ["F"]),
    ("correct T S --out O", ["S/calibration.json", "T/dvl.csv"]),
    ("instrument S", ["S/calibration.json"]),
    ("deadreckon T S --out O", ["S/calibration.json", "T/dvl.csv"]),
    ("crosscheck S S --out O", ["S/calibration.json", "S/trajectory.csv"]),
    ("crosscheck S J --out O", ["J"]),
    ("crosscheck S S --reference T/imu.csv --out O", ["T/imu.csv"]),
    ("crosscheck S S --truth J --out O", ["J"]),
    ("report S", ["S/calibration.json", "S/trajectory.csv", "S/run.json", "S/history.csv"]),
    ("export S --to tum", ["S/calibration.json", "S/trajectory.csv"]),
    ("export T --to netcdf", ["T/imu.csv"]),
    ("allan T/imu.csv --out O", ["T/imu.csv"]),
    ("plan F --out O", ["F"]),
    ("simulate F --out O", ["F"]),
    ("import F --out O", ["F"]),
    ("import F --guess", ["F"]),
    ("import T/imu.csv --map F --out O", ["F"]),
    *((f"import F --out O --format {name}", ["F"]) for name in ("pd0", "ulog", "ardupilot")),
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "loop"])
@pytest.mark.parametrize(
    ("line", "file"), [(line, file) for line, files in READ for file in files]
)
def test_commands_read_regular_files_only(
    tmp_path: Path, run: Run, line: str, file: str, kind: str
) -> None:
    places = {"T": write_trial(tmp_path), "S": tmp_path / "solution"}
    places |= {"F": tmp_path / "file", "J": tmp_path / "file.json", "O": tmp_path / "out"}
    save_solution(build_solution(), places["S"])

    def place(word: str) -> str:
        head, _, rest = word.partition("/")
        return str(places[head] / rest) if head in places else word

    given = Path(place(file))
    given.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(given)
    elif kind == "device":
        given.symlink_to("/dev/zero")
    elif kind == "socket":
        socket_at(given)
    else:
        loop_at(given)
    done = run(*map(place, line.split()))
    assert done.code == 2
    assert given.name in done.err
    if kind != "loop":
        assert f"is a {kind}; expected a regular file: " in done.err
    assert "internal error" not in done.err
    assert not places["O"].exists()


@pytest.mark.parametrize("name", ["metadata.yaml", "part.db3", "part.mcap"])
def test_a_bag_holds_regular_files_only(tmp_path: Path, run: Run, name: str) -> None:
    pytest.importorskip("rosbags")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (bag / name).unlink(missing_ok=True)
    os.mkfifo(bag / name)
    done = run("import", bag, "--format", "bag", "--out", tmp_path / "out")
    assert done.code == 2
    assert f"{bag / name}: is a pipe; expected a regular file: a file of a bag" in done.err
