"""The command `import`, and `export` of trials: exit codes, messages, files."""

import format_writers as writers
import yaml
from running import run  # noqa: F401


def write_fixes(folder):
    lines = [
        writers.nmea(f"GPRMC,0920{i:02d},A,5321.68{i:02d},N,00630.3372,W,1.5,10.0,250722,,,A")
        for i in range(30)
    ]
    path = folder / "receiver.log"
    path.write_bytes(b"".join(lines))
    return path


def test_imports_and_says_what_is_missing(tmp_path, run):  # noqa: F811
    out = tmp_path / "trial"
    done = run("import", write_fixes(tmp_path), "--out", out)
    assert done.code == 0
    assert "receiver.log: NMEA 0183" in done.out
    assert "missing: velocities: no file has any" in done.err
    assert yaml.safe_load((out / "trial.yaml").read_text())["epoch"] == "2022-07-25T09:20:00Z"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["receiver.log", "trial"]
    again = run("import", tmp_path / "receiver.log", "--out", out)
    assert again.code == 2
    assert "--force" in again.err


def test_bad_input_ends_with_2_and_writes_nothing(tmp_path, run):  # noqa: F811
    out = tmp_path / "trial"
    (tmp_path / "noise.bin").write_bytes(bytes(range(256)) * 20)
    for args, message in (
        ((tmp_path / "none.pd0",), "does not exist"),
        ((tmp_path / "noise.bin",), "noise.bin: not an instrument's file; expected one of the"),
        ((tmp_path,), "a folder, and not the bag"),
        ((write_fixes(tmp_path), "--format", "pd99"), "there is no format `pd99`"),
        ((write_fixes(tmp_path), "--map", tmp_path / "none.yaml"), "does not exist"),
    ):
        done = run("import", *args, "--out", out)
        assert done.code == 2, args
        assert message in done.err, done.err
        assert not out.exists()
    assert run("import", tmp_path / "receiver.log").code == 2


def test_guess_prints_a_mapping(tmp_path, run):  # noqa: F811
    table = tmp_path / "log.csv"
    table.write_text("t_ms,vx_mm_s,vy_mm_s,vz_mm_s\n" + "1000,1500,2,3\n" * 9)
    done = run("import", "--guess", table)
    assert done.code == 0
    found = yaml.safe_load(done.out)["tables"][0]
    assert found["kind"] == "dvl"
    assert found["columns"]["vel_x"] == {"column": "vx_mm_s", "unit": "mm/s"}
    assert found["time"]["unit"] == "ms"


def test_a_table_is_told_of_guess_first_and_no_error_lists_all_formats(tmp_path, run):  # noqa: F811
    (tmp_path / "log.csv").write_text("time;a;b\n1;2;3\n2;3;4\n")
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0" + bytes(range(256)) * 9)
    (tmp_path / "notes.txt").write_text("Monday, calm\nno wind\nleft at 9, back at 5, tired\n")
    said = {
        name: run("import", tmp_path / name, "--out", tmp_path / "trial").err
        for name in ("log.csv", "photo.jpg", "notes.txt")
    }
    assert "Run `factorgraph-dvl import --guess log.csv` first" in said["log.csv"]
    for name in ("photo.jpg", "notes.txt"):
        assert f"{name}: not an instrument's file" in said[name]
    assert all(len(text) < 250 for text in said.values())
