"""What is whole in a damaged file is kept, and nothing is made up."""

from __future__ import annotations

import tracemalloc
from datetime import UTC, datetime, timedelta
from pathlib import Path

import format_writers as writers
import numpy as np
import pytest
from format_samples import ensemble, rowe_ensemble, rows

from factorgraph_dvl.files.formats.ad2cp import read_ad2cp
from factorgraph_dvl.files.formats.framing import WINDOW, lines, map_file
from factorgraph_dvl.files.formats.nmea import read_nmea
from factorgraph_dvl.files.formats.pd0 import read_pd0
from factorgraph_dvl.files.formats.pd4 import read_pd4
from factorgraph_dvl.files.formats.rowe import read_rowe
from factorgraph_dvl.files.formats.sbet import read_sbet

WHEN = datetime(2021, 3, 4, tzinfo=UTC)


def pd4_record(i):
    return writers.pd4(1, (i * 1e-3, 0, 0, 0), (1, 1, 1, 1), (0, 0, 0, 0))


def ad2cp_record(i):
    when = WHEN + timedelta(seconds=i)
    return writers.ad2cp(0x17, writers.df20(when, (1.0,) * 4, (9.0,) * 4, (1,) * 4))


# A record by its number, and the numbers of the records found.
FORMATS = {
    "pd0": (ensemble, lambda data: [n for b in read_pd0(data) for n in b.pings["number"]]),
    "pd4": (
        pd4_record,
        lambda data: [round(v[0] * 1e3) for b in read_pd4(data) for v in b["velocity"]],
    ),
    "ad2cp": (
        ad2cp_record,
        lambda data: [
            round(t - WHEN.timestamp()) for b in read_ad2cp(data) for t in b.bottom["time"]
        ],
    ),
    "nmea": (
        lambda i: writers.nmea(f"GPHDT,{i}.0,T"),
        lambda data: [
            round(np.degrees(h))
            for b in read_nmea(data)
            for h in b["HDT"]["heading"][b["HDT"]["checked"]]
        ],
    ),
    "rowe": (
        lambda i: rowe_ensemble(i, writers.nmea(f"GPHDT,{i}.0,T")),
        lambda data: [
            round(np.degrees(h)) for _, b in read_rowe(data) for h in b["HDT"]["heading"]
        ],
    ),
}


@pytest.mark.parametrize("name", FORMATS)
def test_records_survive_what_is_between_them(name):
    make, found = FORMATS[name]
    rng = np.random.default_rng(7)
    for _ in range(20):
        count = int(rng.integers(3, 12))
        data, whole = b"", []
        for i in range(1, count):
            record = make(i)
            damage = rng.integers(0, 4)
            if damage == 0:
                broken = bytearray(record)
                broken[int(rng.integers(0, len(broken) - 3))] ^= 1 << int(rng.integers(0, 7))
                record = bytes(broken)
            elif damage == 1:
                record = record[: int(rng.integers(1, len(record) - 2))] + b"\n"
            elif damage == 2:
                data += rng.bytes(int(rng.integers(1, 300))) + b"\n"
            if damage >= 2:
                whole.append(i)
            data += record
        kept = [i for i in found(data) if i in whole]
        assert kept == whole
        made_up = [i for i in found(data) if i not in whole]
        assert not made_up


@pytest.mark.parametrize(
    "reader", [read_pd0, read_pd4, read_ad2cp, read_nmea, read_rowe, read_sbet]
)
@pytest.mark.parametrize(
    "data",
    [b"", b"\x7f", b"\x7f\x7f", b"\x7f" * 5000, b"\xa5\x0a" * 3000, b"\x80" * 5000, b"$" * 5000],
)
def test_nothing_in_nothing_out(reader, data):
    for block in reader(data):
        parts = block.values() if isinstance(block, dict) else [getattr(block, "bottom", block)]
        assert not sum(len(p) for p in parts if isinstance(p, np.ndarray))


def test_records_across_windows_are_found_once(tmp_path):
    path = tmp_path / "long.pd0"
    one = ensemble(1)
    count = WINDOW // len(one) + 500
    path.write_bytes(b"x" * 11 + one * count)
    source = map_file(path)
    assert sum(len(block.pings) for block in read_pd0(source)) == count


def test_sentences_across_windows_are_found_once():
    one = writers.nmea("GPGGA,123519.25,4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,1.5,0001")
    count = WINDOW // len(one) + 500
    assert sum(len(block["GGA"]) for block in read_nmea(b"xy" + one * count)) == count


def test_text_without_ends_is_no_text():
    assert list(lines(b"a" * 100_000 + b"\nline\r\n")) == [(100_001, b"line")]


def test_a_trajectory_is_found_behind_other_bytes():
    found = np.concatenate(list(read_sbet(b"header" + writers.sbet(rows(50)))))
    assert len(found) == 50


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
def test_pages_of_a_file_do_not_stay_in_memory(tmp_path):
    def mapped():
        status = Path("/proc/self/status").read_text()
        return int(status.split("RssFile:")[1].split()[0]) * 1024

    size = 160 << 20
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(size)
        file.seek(size // 2)
        file.write(b"middle")
    source, before, most = map_file(path), mapped(), 0
    for at in range(0, size, WINDOW):
        part = source[at : at + WINDOW]
        assert part[:6] == (b"middle" if at == size // 2 else bytes(6))
        most = max(most, mapped() - before)
    assert most < size / 4
    assert source[size // 2] == b"m"[0]
    assert source.find(b"middle") == size // 2


@pytest.mark.parametrize("reader", [read_pd0, read_pd4, read_ad2cp])
def test_memory_does_not_grow_with_the_file(reader, tmp_path):
    record = {read_pd0: ensemble(1), read_pd4: pd4_record(1), read_ad2cp: ad2cp_record(1)}[reader]
    block = (100,) if reader is read_ad2cp else ()
    peaks = []
    for size in (4 * WINDOW, 12 * WINDOW):
        path = tmp_path / f"{size}.bin"
        # Mostly what is no record, as between the records of an echo sounder.
        path.write_bytes((record * 4 + bytes(20_000)) * (size // (4 * len(record) + 20_000)))
        source = map_file(path)
        tracemalloc.start()
        for _ in reader(source, *block):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
