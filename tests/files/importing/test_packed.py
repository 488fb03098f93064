"""Raw files that were packed with gzip are imported as they are."""

from __future__ import annotations

import gzip

import format_writers as writers
import pytest

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.importing.raw_files import import_files

TEXT = b"".join(
    writers.nmea(f"GPGGA,1235{i % 60:02d},4807.{i:03d},N,01131.000,E,1,08,0.9,5.4,M,6.9,M,,")
    for i in range(60)
)


def imported(tmp_path, data, name="a.nmea.gz"):
    (tmp_path / name).write_bytes(data)
    return import_files([tmp_path / name], tmp_path / "trial")


def test_a_packed_file_is_what_it_was(tmp_path):
    packed = imported(tmp_path, gzip.compress(TEXT))
    (tmp_path / "other").mkdir()
    plain = imported(tmp_path / "other", TEXT, "a.nmea")
    assert f"a.nmea.gz: unpacked: {len(TEXT)} bytes" in packed.lines
    assert [a.rows() for a in packed.accounts] == [a.rows() for a in plain.accounts]
    tables = [(folder / "trial" / "gnss.parquet") for folder in (tmp_path, tmp_path / "other")]
    assert tables[0].read_bytes() == tables[1].read_bytes()
    assert "name: a\n" in (tmp_path / "trial" / "trial.yaml").read_text()


def test_packed_files_one_behind_the_other(tmp_path):
    found = imported(tmp_path, gzip.compress(TEXT[:2000]) + gzip.compress(TEXT[2000:]))
    assert f"a.nmea.gz: unpacked: {len(TEXT)} bytes" in found.lines


def test_what_is_whole_in_a_damaged_one_is_kept(tmp_path):
    data = gzip.compress(TEXT, 0)
    found = imported(tmp_path, data[: len(data) // 2])
    (line,) = (line for line in found.lines if "unpacked" in line)
    assert "damaged behind that" in line
    assert 20 < found.accounts[0].rows()[0][1] < 60


@pytest.mark.parametrize("data", [b"", b"no gzip", gzip.compress(TEXT)[:12]])
def test_what_cannot_be_unpacked_is_named(tmp_path, data):
    with pytest.raises(DataError, match=r"a\.nmea"):
        imported(tmp_path, data)
    assert not (tmp_path / "trial").exists()
