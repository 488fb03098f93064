"""Sentences, against the published examples, a writer of its own, and pynmeagps."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from format_writers import nmea

from factorgraph_dvl.files.formats.clocks import in_order, posix
from factorgraph_dvl.files.formats.nmea import KINDS, join, read_nmea, utc

DEG = np.pi / 180.0


def read(data):
    return join(read_nmea(data))


def test_a_position_has_its_height_above_the_ellipsoid():
    (gga,) = read(
        nmea("GNGGA,123519.25,4807.038,S,01131.000,W,4,08,0.9,545.4,M,-46.9,M,1.5,0001")
    )["GGA"]
    assert gga["second"] == 12 * 3600 + 35 * 60 + 19.25
    assert gga["lat"] / DEG == pytest.approx(-(48 + 7.038 / 60), abs=1e-12)
    assert gga["lon"] / DEG == pytest.approx(-(11 + 31.0 / 60), abs=1e-12)
    assert (gga["quality"], gga["satellites"], gga["age"]) == (4, 8, 1.5)
    assert gga["height"] == pytest.approx(545.4 - 46.9)
    assert gga["talker"] == b"GN"


def test_a_height_without_separation_is_unknown():
    (gga,) = read(
        nmea("GPGGA,210932.00,6433.411559,N,14903.800578,W,5,11,0.8,117.9,M,,,1.0,0000")
    )["GGA"]
    assert gga["altitude"] == 117.9
    assert np.isnan(gga["height"])


def test_published_sentences_of_an_inertial_system():
    found = read(
        b"$HEHDT,116.581,T*25\r\n$PIXSE,ATITUD,-1.641,-0.490*6D\r\n"
        b"$PIXSE,POSITI,53.10245714,8.83994382,-0.115*71\r\n$PIXSE,SPEED_,-0.802,-1.243,0.000*6F\r\n"
        b"$PIXSE,TIME__,003356.016693*64\r\n$PIXSE,STDHRP,1.997,0.082,0.101*7C\r\n"
    )
    assert found["HDT"]["heading"] / DEG == pytest.approx(116.581)
    assert found["ATITUD"]["roll"] / DEG == pytest.approx(-1.641)
    assert found["ATITUD"]["pitch"] / DEG == pytest.approx(-0.490)
    assert found["POSITI"]["lon"] / DEG == pytest.approx(8.83994382)
    assert (found["SPEED_"]["vel_e"], found["SPEED_"]["vel_n"]) == (-0.802, -1.243)
    assert found["TIME__"]["second"] == pytest.approx(2036.016693)
    assert found["STDHRP"]["std_pitch"] / DEG == pytest.approx(0.101)


def test_attitudes():
    found = read(
        nmea("PASHR,085335.000,224.19,T,-01.26,+00.83,+00.01,0.101,0.113,0.267,1,0")
        + nmea("PRDID,-1.31,7.81,47.31")
        + nmea("PASHR,ATT,310378,123.4,1.2,0.3,0.001,0.002,0,1,2,3")
    )
    (pashr,) = found["PASHR"]
    assert pashr["second"] == 8 * 3600 + 53 * 60 + 35
    np.testing.assert_allclose(
        [pashr["heading"], pashr["roll"], pashr["pitch"]], np.array([224.19, -1.26, 0.83]) * DEG
    )
    assert pashr["std_heading"] / DEG == pytest.approx(0.267)
    np.testing.assert_allclose(
        [found["PRDID"][0][n] for n in ("pitch", "roll", "heading")],
        np.array([-1.31, 7.81, 47.31]) * DEG,
    )


def test_speeds_in_old_and_new_form():
    found = read(
        nmea("GPVTG,054.7,T,034.4,M,005.5,N,010.2,K")
        + nmea("GPVTG,054.7,034.4,005.5,010.2")
        + nmea("GPVTG,,T,,M,,N,3.6,K,A")
    )
    np.testing.assert_allclose(found["VTG"]["speed"], [5.5 * 1852 / 3600, 5.5 * 1852 / 3600, 1.0])


def test_a_wrong_checksum_a_cut_line_and_noise_cost_only_themselves():
    good = nmea("GPHDT,10.0,T")
    data = (
        good[:-3]
        + b"0\r\n"
        + b"\xff\x00$GPHDT,1"
        + good
        + b"$GPHDT,20.0,T\r\n"
        + good
        + b"$GPHDT,30"
    )
    found = read(data)["HDT"]
    np.testing.assert_allclose(found["heading"] / DEG, [10.0, 20.0, 10.0, 30.0])
    np.testing.assert_array_equal(found["checked"], [True, False, True, False])


@pytest.mark.parametrize(
    ("prefix", "when"),
    [
        (b"NAV 2013/11/20 05:00:04.561 GPS ", datetime(2013, 11, 20, 5, 0, 4, 561000, UTC)),
        (b"cnav\t2010:258:01:05:34.0656\t", datetime(2010, 9, 15, 1, 5, 34, 65600, UTC)),
        (b"1383926404.561 ", datetime(2013, 11, 8, 16, 0, 4, 561000, UTC)),
        (b"1383926404561,", datetime(2013, 11, 8, 16, 0, 4, 561000, UTC)),
        (b"2021-03-04T05:06:07Z ", datetime(2021, 3, 4, 5, 6, 7, 0, UTC)),
        (b"\\g:1-2-34,c:1383926404*5B\\", datetime(2013, 11, 8, 16, 0, 4, 0, UTC)),
    ],
)
def test_times_before_a_sentence(prefix, when):
    (hdt,) = read(b"junk\r\n" + prefix + nmea("GPHDT,10.0,T"))["HDT"]
    assert hdt["received"] == pytest.approx(when.timestamp(), abs=1e-6)


def test_dates_come_from_others_and_pass_midnight():
    data = b"".join(
        nmea(text)
        for text in (
            "GPGGA,235958.00,4807.0,N,01131.0,E,1,8,1,5,M,1,M,,",
            "GPRMC,235959.00,A,4807.0,N,01131.0,E,0.5,54.7,311299,,,A",
            "GPGGA,000000.00,4807.0,N,01131.0,E,1,8,1,5,M,1,M,,",
            "GPGGA,000001.00,4807.0,N,01131.0,E,1,8,1,5,M,1,M,,",
        )
    )
    eve = datetime(1999, 12, 31, 23, 59, 58, 0, UTC).timestamp()
    np.testing.assert_allclose(utc(read(data), "GGA") - eve, [0.0, 2.0, 3.0])
    assert np.isnan(utc(read(data[:70]), "GGA")).all()


def test_two_digit_years():
    times = posix([80, 99, 0, 26, 79], 1, 1)
    years = [datetime.fromtimestamp(t, UTC).year for t in times]
    assert years == [1980, 1999, 2000, 2026, 2079]
    assert np.isnan(posix([20, 21, 21, 21], [2, 2, 13, 1], [30, 29, 1, 0])).all()


def test_order_without_dates_is_nan():
    assert np.isnan(in_order(np.array([1.0, 2.0]), np.array([np.nan, np.nan]))).all()


def test_every_kind_comes_back_as_random_numbers_were_written():
    rng = np.random.default_rng(3)
    lat, lon = rng.uniform(-89, 89, 200), rng.uniform(-179, 179, 200)
    data = b""
    for a, o in zip(lat, lon, strict=True):
        p, q = abs(a), abs(o)
        data += nmea(
            f"GPGGA,120000.00,{int(p):02d}{p % 1 * 60:010.7f},{'S' if a < 0 else 'N'},"
            f"{int(q):03d}{q % 1 * 60:010.7f},{'W' if o < 0 else 'E'},1,8,1.0,1.0,M,2.0,M,,"
        )
    found = read(data)["GGA"]
    # 1e-7 minutes.
    np.testing.assert_allclose(found["lat"] / DEG, lat, atol=1e-9)
    np.testing.assert_allclose(found["lon"] / DEG, lon, atol=1e-9)


def test_pynmeagps_reads_the_same():
    reader = pytest.importorskip("pynmeagps").NMEAReader
    texts = [
        "GPGGA,123519.25,4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,1.5,0001",
        "GPRMC,040001.00,A,2246.08014690,N,15755.97486679,W,0.05,253.92,250722,9.9,E,D",
        "GPVTG,253.92,T,243.98,M,0.05,N,0.10,K,D",
        "GPZDA,040001.00,25,07,2022,00,00",
        "GPGST,040000.00,0.30,0.28,0.17,19.72,0.27,0.19,0.45",
        "GPHDT,85.89,T",
    ]
    found = read(b"".join(map(nmea, texts)))
    gga, rmc, vtg, zda, gst, _ = (reader.parse(nmea(text)) for text in texts)
    assert found["GGA"]["lat"][0] / DEG == pytest.approx(gga.lat, abs=1e-9)
    assert found["GGA"]["height"][0] == gga.alt + gga.sep
    assert found["RMC"]["lon"][0] / DEG == pytest.approx(rmc.lon, abs=1e-9)
    assert found["RMC"]["course"][0] / DEG == pytest.approx(rmc.cog)
    assert (
        found["RMC"]["date"][0] == datetime.combine(rmc.date, datetime.min.time(), UTC).timestamp()
    )
    assert found["VTG"]["speed"][0] * 3600 / 1852 == pytest.approx(vtg.sogn)
    assert (zda.day, zda.month, zda.year) == (25, 7, 2022)
    assert found["ZDA"]["date"][0] == datetime(2022, 7, 25, tzinfo=UTC).timestamp()
    np.testing.assert_allclose(
        [found["GST"][0][n] for n in ("rms", "std_lat", "std_lon", "std_height")],
        [gst.rangeRms, gst.stdLat, gst.stdLong, gst.stdAlt],
    )
    assert found["HDT"]["heading"][0] / DEG == pytest.approx(85.89)


def test_blocks_hold_what_one_block_holds():
    data = nmea("GPHDT,10.0,T") * 25
    blocks = list(read_nmea(data, block=10))
    assert [len(block["HDT"]) for block in blocks] == [10, 10, 5]
    assert set(blocks[0]) == set(KINDS)
