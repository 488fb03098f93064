"""What was left out of a damaged file is counted, and nothing where nothing was lost."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

import format_writers as writers
import pytest
from format_samples import COLUMNS, HEADER, VALUES, deviations, ensemble, rowe_ensemble, rows

from factorgraph_dvl.files.formats.catalogue import FORMATS
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.sentences import text_losses

WHEN = datetime(2021, 3, 4, 5, 6, 7, tzinfo=UTC)
READERS = {form.name: form.read for form in FORMATS}
REPORT = {"type": "velocity", "vx": 0.5, "vy": 0.1, "vz": 0.2, "velocity_valid": True}
MAPPING = {
    "tables": [
        {"file": "*", "kind": "depth", "time": {"column": "t"}, "columns": {"depth": "depth"}}
    ]
}


def ad2cp(i):
    when = WHEN + timedelta(seconds=i)
    return writers.ad2cp(0x17, writers.df20(when, (1.0,) * 4, (9.0,) * 4, (1,) * 4))


def pd4(i):
    return writers.pd4(1, (0.1, 0.2, 0.3, 0.0), (1,) * 4, (1, 2, i, 0), long=i % 2 == 0)


def losses(tmp_path, name, data, mapping=None):
    path = tmp_path / "file"
    path.write_bytes(data)
    out = Losses()
    for batch in READERS[name](path, mapping):
        if batch.losses is not None:
            out.include(batch.losses)
    return str(out)


@pytest.mark.parametrize(
    ("name", "record", "noun"),
    [
        ("pd0", ensemble, "ensemble"),
        ("pd4", pd4, "ensemble"),
        ("ad2cp", ad2cp, "record"),
        ("rowe", rowe_ensemble, "ensemble"),
    ],
)
def test_binary_records(tmp_path, name, record, noun):
    records = [bytearray(record(i)) for i in range(12)]
    assert losses(tmp_path, name, b"".join(records)) == ""
    for i in (4, 5, 8):
        records[i][-20:-10] = bytes(byte ^ 0x55 for byte in records[i][-20:-10])
    first = len(b"".join(records[:4]))
    data = b"".join(records[:10]) + b"?" * 1234 + b"".join(records[10:]) + records[0][:-1]
    found = losses(tmp_path, name, data)
    outside = 1234 + len(records[0]) - 1
    assert found == (
        f"3 {noun}s with a wrong checksum and {outside:,} bytes outside records, "
        f"the first at byte {first:,}"
    )


def test_ensembles_without_leaders(tmp_path):
    data = ensemble(1) + writers.pd0([writers.bottom_track((0, 0, 0, 0), (1, 1, 1, 1))])
    assert losses(tmp_path, "pd0", data).startswith("1 ensemble without leaders, at byte ")


@pytest.mark.parametrize(
    ("name", "values", "size"), [("sbet", rows(60), 136), ("smrmsg", deviations(60), 80)]
)
def test_trajectories(tmp_path, name, values, size):
    data = bytearray(values.astype("<f8").tobytes())
    assert losses(tmp_path, name, bytes(data)) == ""
    data[20 * size + 8 : 21 * size] = b"\xff" * (size - 8)
    assert (
        losses(tmp_path, name, bytes(data))
        == f"{size} bytes outside records, the first at byte {20 * size:,}"
    )


SOLUTIONS = [b"2019/06/08 08:04:%02d.500" % i + VALUES for i in range(6)]
TITLE = HEADER + b"%  GPST " + COLUMNS
BEAMS = [
    b":SA,1,2,3",
    b":TS,21030405060812,35,10,1,1500,0",
    b":BI,1,2,3,4,A",
    b":BD,1,2,3,4,5",
]
JSON = [json.dumps(REPORT).encode()] * 3
TABLE = [b"t,depth", *(b"%d.0,5.5" % i for i in range(9))]


@pytest.mark.parametrize(
    ("name", "lines", "damaged", "what"),
    [
        (
            "rtklib",
            [TITLE, *SOLUTIONS],
            b"2019/06/08 08:\x00\x00",
            "line without time and position",
        ),
        ("pd6", BEAMS, b":BI,1,2", "line with too few fields"),
        ("water-linked", JSON, JSON[0][:-5], "line of damaged JSON"),
        ("water-linked", JSON, b"wrz,1,2,3,y,4,5,6,7,8,9,0*00", "report with a wrong checksum"),
        ("nmea", [writers.nmea("GPHDT,5.0,T").strip()], b"$GPGGA,1,2*5A", "sentence with too few"),
        ("nortek", [writers.nmea("PNORBT7" + ",1" * 11).strip()], b"$PNORBT7,1", "sentence with"),
        ("cerulean", [writers.nmea("DVPDL" + ",1" * 9).strip()], b"$DVPDL,1", "sentence with"),
        ("table", TABLE, b"7,8,9", "row with another number of cells"),
        ("table", [b"t depth", *(b"  %d   5" % i for i in range(9))], b" 7  8 9", "row with"),
    ],
)
def test_lines(tmp_path, name, lines, damaged, what):
    if name == "nmea":
        damaged = writers.nmea("GPGGA,1,2").strip()
    whole = b"\r\n".join(lines) + b"\r\n"
    assert losses(tmp_path, name, whole, MAPPING) == ""
    found = losses(tmp_path, name, whole + damaged + b"\r\n" + lines[-1] + b"\r\n", MAPPING)
    assert found.startswith(f"1 {what}")
    assert found.endswith(f", at byte {len(whole):,}")


GGA = [
    writers.nmea(f"GPGGA,1235{i:02d},4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,")
    for i in range(40)
]


class TestText:
    def test_nothing_where_nothing_was_lost(self):
        tagged = b"".join(b"\\s:r003*04\\" + line for line in GGA)
        plain = b"$GPHDT,5.0,T\r\n" * 5
        stamped = b"".join(b"2021-03-04 05:06:07.123 " + line for line in GGA)
        serial = b"wrp,1,2,3*1f\r\n# a comment, 5*20 m\n"
        for data in (b"".join(GGA), tagged, plain, stamped, serial, b"".join(GGA)[30:]):
            assert str(text_losses(data)) == ""

    def test_wrong_checksums(self):
        data = bytearray(b"".join(GGA))
        for i in (3, 7):
            data[len(GGA[0]) * i + 20] ^= 1
        assert str(text_losses(data)) == (
            f"2 sentences with a wrong checksum, the first at byte {3 * len(GGA[0])}"
        )

    def test_zeros(self):
        one = len(GGA[0])
        data = bytearray(b"".join(GGA))
        data[one * 5 + 30 : one * 8 + 20] = bytes(3 * one - 10)
        assert text_losses(data).counts == {
            "byte without text": 3 * one - 10,
            "sentence without its start": 1,
        }

    def test_cut_sentences(self):
        data = GGA[0] + GGA[1][:25] + GGA[2] + GGA[3][30:] + GGA[4][:-3]
        assert text_losses(data).counts == {
            "sentence without its end": 1,
            "sentence without its start": 1,
            "sentence with a wrong checksum": 1,
        }

    def test_across_windows(self, monkeypatch):
        data = bytearray(b"".join(GGA))
        data[len(GGA[0]) * 8 + 20] ^= 1
        expected = text_losses(data)
        for window in range(60, 700, 37):
            monkeypatch.setattr("factorgraph_dvl.files.formats.sentences.WINDOW", window)
            assert text_losses(data) == expected


def test_counts_of_several_formats_in_one_file():
    one, other = Losses(), Losses()
    one.add("line of damaged JSON", 500)
    other.add("sentence with a wrong checksum", 40, 2)
    other.add("line of damaged JSON", 60, 0)
    one.include(other)
    assert str(one) == (
        "1 line of damaged JSON and 2 sentences with a wrong checksum, the first at byte 40"
    )
