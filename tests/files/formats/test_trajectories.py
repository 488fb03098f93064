"""SBET, smrmsg and RTKLIB: written by their descriptions, read back."""

from __future__ import annotations

import struct
from datetime import UTC, datetime

import format_writers as writers
import numpy as np
import pytest
from format_samples import COLUMNS, HEADER, VALUES, rows

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats import rtklib, sbet
from factorgraph_dvl.files.formats.clocks import gps_to_utc

DEG = np.pi / 180.0


def test_a_trajectory_comes_back():
    values = rows(1000)
    found = np.concatenate(list(sbet.read_sbet(writers.sbet(values))))
    assert len(found) == 1000
    for index, name in enumerate(sbet.SBET.names):
        np.testing.assert_array_equal(found[name], values[:, index])


def test_lost_and_added_bytes_cost_the_records_they_hit():
    values = rows(300)
    data = writers.sbet(values)
    damaged = (
        data[: 100 * 136 + 50] + data[101 * 136 + 3 : 200 * 136] + b"xyz" + data[200 * 136 : -5]
    )
    found = np.concatenate(list(sbet.read_sbet(damaged)))
    kept = np.isin(values[:, 0], found["second"])
    assert kept[:100].all()
    assert kept[102:299].all()
    assert len(found) <= 300


def test_a_long_trajectory_crosses_windows(monkeypatch):
    values = rows(2000)
    monkeypatch.setattr(sbet, "_STEP", 10_000)
    found = np.concatenate(list(sbet.read_sbet(writers.sbet(values))))
    np.testing.assert_array_equal(found["second"], values[:, 0])


def test_standard_deviations_are_in_arc_minutes():
    data = struct.pack("<10d", 1000.0, 0.01, 0.02, 0.03, 0.001, 0.002, 0.003, 6.0, 12.0, 30.0) * 2
    (found,) = sbet.read_smrmsg(data)
    np.testing.assert_allclose(
        [found[n][0] / DEG for n in ("roll_std", "pitch_std", "heading_std")], [0.1, 0.2, 0.5]
    )
    assert found["std_d"][0] == 0.03


def test_wander_angle():
    """The same motion in a frame whose x axis points 30 degrees west of north."""
    record = np.zeros(1, sbet.SBET)
    record["wander"], record["heading"] = 30.0 * DEG, 50.0 * DEG
    # A unit velocity to the true heading of 20 degrees.
    record["vel_x"], record["vel_y"] = np.cos(50.0 * DEG), np.sin(50.0 * DEG)
    north, east = sbet.north_east(record)
    np.testing.assert_allclose([north[0], east[0]], [np.cos(20.0 * DEG), np.sin(20.0 * DEG)])
    assert sbet.true_heading(record)[0] / DEG == pytest.approx(20.0)


COLUMNS += b"  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
VALUES += b"  -0.0001   0.0002   0.0003   0.50   12.3"


def read(data):
    return np.concatenate(list(rtklib.read_rtklib(data)))


@pytest.mark.parametrize(
    ("system", "stamp"),
    [
        (b"GPST", b"2019/06/08 08:04:13.500"),
        (b"UTC ", b"2019/06/08 08:03:55.500"),
        (b"JST ", b"2019/06/08 17:03:55.500"),
        (b"GPST", b"2056 547453.500"),
    ],
)
def test_a_solution_in_every_time_system(system, stamp):
    (row,) = read(
        HEADER + b"%  " + system + b"                  " + COLUMNS + b"\n" + stamp + VALUES + b"\n"
    )
    assert row["time"] == pytest.approx(
        datetime(2019, 6, 8, 8, 3, 55, 500000, UTC).timestamp(), abs=1e-6
    )
    assert row["lat"] / DEG == pytest.approx(47.060027749)
    assert (row["height"], row["quality"], row["std_u"], row["age"], row["ratio"]) == (
        84.86,
        1,
        0.0068,
        0.5,
        12.3,
    )
    assert np.isnan(row["vel_n"])


def test_velocities_by_their_names():
    header = (
        b"% UTC " + COLUMNS + b"    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu\n"
    )
    (row,) = read(header + b"2019/06/08 08:03:55" + VALUES + b" 1.5 -2.5 0.1 0.01 0.02 0.03\n")
    assert (row["vel_n"], row["vel_e"], row["vel_std_u"]) == (1.5, -2.5, 0.03)


def test_a_cut_line_is_no_solution():
    data = HEADER + b"%  GPST  " + COLUMNS + b"\n2019/06/08 08:04:13.500   47.0"
    assert len(read(data)) == 0


def test_other_coordinates_are_refused():
    with pytest.raises(DataError, match="latitude and longitude in degrees"):
        read(b"%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns\n2019/06/08 08:03:55 1 2 3 1 9\n")
    with pytest.raises(DataError, match="before a line that names"):
        read(b"2019/06/08 08:03:55.0 47.0 -1.3 84.8 1 12\n")


def test_leap_seconds():
    # 2016-12-31T23:59:59 UTC was 2016-12-31T... + 17 s in GPS time, 2017-01-01 + 18 s.
    epoch = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
    for when, ahead in (
        (datetime(2016, 12, 31, 23, 59, 59, 0, UTC), 17),
        (datetime(2017, 1, 1, tzinfo=UTC), 18),
        (datetime(1980, 2, 1, tzinfo=UTC), 0),
        (datetime(1999, 6, 1, tzinfo=UTC), 13),
    ):
        gps = when.timestamp() - epoch + ahead
        assert gps_to_utc(gps // 604800, gps % 604800) == when.timestamp()
