"""Velocity logs from PD4 to Rowe: written by their documents, read back."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import format_writers as writers
import numpy as np
import pytest
from format_samples import PD13, SERIAL, WHEN, rowe_ensemble, stamped_lines
from format_writers import nmea

from factorgraph_dvl.files.formats import framing, water_linked
from factorgraph_dvl.files.formats.catalogue import FORMATS
from factorgraph_dvl.files.formats.dvl_sentences import read_cerulean, read_nortek
from factorgraph_dvl.files.formats.janus import from_beams
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.formats.pd4 import read_pd4
from factorgraph_dvl.files.formats.pd6 import read_pd6
from factorgraph_dvl.files.formats.rowe import read_rowe
from factorgraph_dvl.files.formats.velocities import BEAM, EARTH, INSTRUMENT, SHIP, attitude
from factorgraph_dvl.files.formats.water_linked import FORMATS as WATER_LINKED
from factorgraph_dvl.files.formats.water_linked import crc8, read_water_linked
from factorgraph_dvl.files.formats.water_linked_table import FORMATS as WATER_LINKED_TABLES
from factorgraph_dvl.files.importing.recognition import recognise

DEG = np.pi / 180.0


def test_pd4_and_pd5():
    data = writers.pd4(1, (0.123, -0.456, 1.0, 0.002), (10, 11, 0, 12.34), (23, 59, 58, 7))
    data += b"\r\n>" + writers.pd4(0, (0.1, 0.2, None, 0.3), (1, 2, 3, 4), (0, 0, 0, 0))
    data += writers.pd4(
        2, (1.0, 2.0, 3.0, 0.0), (1, 2, 3, 4), (1, 2, 3, 4), long=True, heading=350.5
    )
    (found,) = read_pd4(data)
    short, long = found[:2], found[2:]
    np.testing.assert_allclose(short["velocity"][0], [0.123, -0.456, 1.0])
    np.testing.assert_array_equal(short["axes"], [INSTRUMENT, BEAM])
    np.testing.assert_allclose(short["range"][0], [10, 11, np.nan, 12.34])
    assert short["second"][0] == pytest.approx(86398.07)
    np.testing.assert_allclose(short["beam_velocity"][1], [0.1, 0.2, np.nan, 0.3])
    assert np.isnan(short["velocity"][1]).all()
    assert np.isnan(short["heading"]).all()
    assert short["at"][0] == 0
    assert long["axes"][0] == SHIP
    np.testing.assert_allclose(
        [long[n][0] / DEG for n in ("pitch", "roll", "heading")], [1.5, -2.5, 350.5]
    )
    assert (long["depth"][0], long["temperature"][0], long["sound_speed"][0]) == (
        pytest.approx(12.3),
        10.5,
        1501,
    )


def test_pd4_damage():
    good = writers.pd4(1, (0.1, 0.2, 0.3, 0.0), (1, 2, 3, 4), (1, 2, 3, 4))
    bad = bytearray(good)
    bad[7] ^= 4
    found = [part for part in read_pd4(good[:20] + good + bytes(bad) + good) if len(part)]
    assert sum(map(len, found)) == 2


def test_pd6_and_pd13():
    second = ":SA,0,0,0\n:TS,21030405060812,35,10,1,1500,0\n"
    second += ":BI,-32768,-32768,-32768,-32768,V\n:BE,+5,+6,+7,V\n"
    third = ":SA,0,0,0\n:BE,+5,+6,+7,A\n"
    (found,) = read_pd6((PD13 + second + third).replace("\n", "\r\n").encode())
    assert len(found) == 3
    np.testing.assert_allclose(found["velocity"][0], [0.123, -0.456, 1.0])
    assert found["axes"][0] == INSTRUMENT
    assert found["time"][0] == pytest.approx(WHEN.timestamp(), abs=1e-6)
    np.testing.assert_allclose(found["range"][0], [10.05, 9.9, np.nan, 10.125])
    assert found["altitude"][0] == 10.1
    np.testing.assert_allclose(
        [found[n][0] / DEG for n in ("pitch", "roll", "heading")], [1.5, -2.25, 181.02]
    )
    assert np.isnan(found["velocity"][1]).all()
    np.testing.assert_allclose(found["velocity"][2], [0.005, 0.006, 0.007])
    assert found["axes"][2] == EARTH


def test_nortek_published_sentences():
    data = (
        b"$PNORBT0,1,040721,131335.3341,23.961,-48.122,-32.76800,10.00000,0.00,0x00000000*48\r\n"
        b"$PNORBT7,1452244916.7508,1.234,-1.234,0.1234,0.1234,0.1234,12.34,23.45,23.45,23.45,23.45*39\r\n"
        b"$PNORBT9,1452244916.7508,1.234,-1.234,0.1234,0.1234,0.1234,12.34,23.45,23.45,23.45,23.45,23.4,1567.8,1.2,12.3,0x000FFFFF*1E\r\n"
        b"$PNORBT,3,112813,072228.2345,0.1234,0.1234,1.11111,122.2,36.66,2.22222,F7*7A\r\n"
    )
    (found,) = read_nortek(data)
    assert len(found) == 4
    assert np.isnan(found["beam_velocity"][0]).all()
    assert found["time"][0] == pytest.approx(
        datetime(2021, 4, 7, 13, 13, 35, 334100, UTC).timestamp(), abs=1e-4
    )
    np.testing.assert_allclose(found["velocity"][1], 0.1234)
    assert found["time"][2] == 1452244916.7508
    assert found["sound_speed"][2] == 1567.8
    assert found["beam_velocity"][3][2] == 1.11111


def test_nortek_beams_of_one_time_and_tags():
    data = b"".join(
        nmea(
            f"PNORBT1,BEAM={i},DATE=040721,TIME=131335.{k},DT1=0,DT2=0,BV={i}.5,FM=0.1,DIST=1{i}.0,STAT=0x1"
        )
        for k in (1, 2)
        for i in (1, 2, 3, 4)
    )
    data += nmea(
        "PNORBT6,TIME=1452244916.75,DT1=1.2,DT2=-1.2,VX=0.1,VY=-32.768,VZ=0.3,FOM=0.002,D1=1.0,D2=0.0,D3=3.0,D4=4.0"
    )
    (found,) = read_nortek(data)
    assert len(found) == 3
    np.testing.assert_allclose(found["beam_velocity"][:2], [[1.5, 2.5, 3.5, 4.5]] * 2)
    np.testing.assert_allclose(found["range"][0], [11, 12, 13, 14])
    np.testing.assert_allclose(found["velocity"][2], [0.1, np.nan, 0.3])
    np.testing.assert_allclose(found["range"][2], [1, np.nan, 3, 4])
    assert found["merit"][2] == 0.002


def test_cerulean():
    # Cerulean's example, whose own checksum is not that of its text.
    data = nmea("DVPDL,101234000,50000,0.001263,-0.019663,-0.745226,-0.000,0.001,-0.005,100")
    data += nmea("DVPDX,101334000,100000,0,0,0,0.1,0.2,0.3,0,1,0.1,0.2,3.0")
    fields = "T,A,3333,1.5,-2.5,90.0,0,0.01,5.5,1.25,-0.75,48.1,-123.0,0.1,1,0,0,0,6,6,6,6,"
    fields += "T,T,F,T,0.1,0.2,0.3,0.4,5,6,7,8,"
    data += nmea("DVEXT," + fields) + nmea("DVEXT," + fields.replace("T,A", "F,A", 1))
    (increments, extended) = next(iter(read_cerulean(data)))
    np.testing.assert_allclose(increments["velocity"][0], [0.0, 0.02, -0.1])
    assert increments["second"][0] == 101.234
    assert np.isnan(increments["velocity"][1]).all()
    np.testing.assert_allclose(extended["velocity"][0], [-0.75, 1.25, 0.01])
    np.testing.assert_allclose(extended["beam_velocity"][0], [0.1, 0.2, np.nan, 0.4])
    np.testing.assert_allclose(extended["second"], [0.1, 0.2])
    assert np.isnan(extended["velocity"][1]).all()
    assert extended["axes"][0] == EARTH


def test_water_linked_published_reports():
    found, water, positions, _ = next(iter(read_water_linked(SERIAL)))
    assert not len(water)
    assert len(found) == 2
    np.testing.assert_allclose(found["velocity"][0], [0.12, -0.4, 2.0])
    np.testing.assert_allclose(found["beam_velocity"][0], [0.07, -0.5, 2.2, 1.8])
    np.testing.assert_allclose(found["range"][0], [1.1, 1.25, 1.4, 1.35])
    assert found["time"][0] == pytest.approx(7e-6)
    assert np.isnan(found["velocity"][1]).all()
    np.testing.assert_allclose(found["second"], [0.123, 1.19851])
    assert positions["x"][0] == 0.41
    assert positions["yaw"][0] / DEG == pytest.approx(19.3)


def reports(count):
    return [
        {
            "time": 100.0 + i,
            **{"vx": 0.5 + i, "vy": -0.1, "vz": 0.2, "fom": 0.01, "altitude": 1.5},
            "transducers": [
                {"id": k, "velocity": 0.1 * k, "distance": 1.0 + k, "beam_valid": k != 2}
                for k in range(4)
            ],
            **{"velocity_valid": i % 3 != 1, "status": 0, "type": "velocity"},
        }
        for i in range(count)
    ]


def joined(batches):
    return np.concatenate([batch.records for batch in batches if batch.kind == "dvl"])


def read_format(formats, path):
    (form,) = formats
    assert form.share(path, path.read_bytes()) > 0.01
    return list(form.read(path, None))


class TestReportsInOneFile:
    def lines(self, tmp_path, count=30):
        path = tmp_path / "lines.json"
        path.write_text("".join(json.dumps(report) + "\n" for report in reports(count)))
        return joined(read_format(WATER_LINKED, path))

    def same(self, found, expected):
        for name in ("time", "velocity", "beams", "range", "std"):
            np.testing.assert_array_equal(found[name], expected[name])

    @pytest.mark.parametrize("between", [",", ",\n", ",\r\n  ", " , "])
    @pytest.mark.parametrize("indent", [1, 4])
    def test_an_array_on_several_lines(self, tmp_path, between, indent):
        path = tmp_path / "log.json"
        path.write_text(
            "[" + between.join(json.dumps(r, indent=indent) for r in reports(30)) + "]\n"
        )
        self.same(joined(read_format(WATER_LINKED, path)), self.lines(tmp_path))
        path.write_text(json.dumps(reports(30), indent=indent))
        self.same(joined(read_format(WATER_LINKED, path)), self.lines(tmp_path))

    def test_an_array_on_one_line(self, tmp_path, monkeypatch):
        path = tmp_path / "log.json"
        path.write_text(json.dumps(reports(300)))
        expected = self.lines(tmp_path, 300)
        assert path.stat().st_size > framing.LONGEST_LINE
        self.same(joined(read_format(WATER_LINKED, path)), expected)
        # Nothing depends on where its parts end.
        monkeypatch.setattr(water_linked, "LONGEST_LINE", 997)
        self.same(joined(read_format(WATER_LINKED, path)), expected)
        # A report without its end costs itself alone.
        texts = [json.dumps(report) for report in reports(300)]
        texts[7] = texts[7][: texts[7].index('"id": 2')]
        path.write_text("[" + ", ".join(texts))
        batches = read_format(WATER_LINKED, path)
        whole = np.delete(expected, 7)
        np.testing.assert_array_equal(joined(batches)["velocity"], whole["velocity"])
        assert str(batches[-1].losses).startswith("1 line of damaged JSON, at byte")

    @pytest.mark.parametrize("form", ["{:.3f} ", "[{:.3f}] ", "iso", "iso, "])
    def test_stamps_of_a_computer_before_reports(self, tmp_path, form):
        times = 1638191471.5 + 0.25 * np.arange(30)
        lines = []
        for report, time in zip(reports(30), times, strict=True):
            iso = str(np.datetime64(round(time * 1e3), "ms"))
            stamp = form.replace("iso", iso) if "iso" in form else form.format(time)
            lines.append(stamp + json.dumps(report))
        path = tmp_path / "log.txt"
        path.write_text("\n".join(lines))
        found = joined(read_format(WATER_LINKED, path))
        np.testing.assert_allclose(found["time"], times, rtol=0, atol=1e-5)

    def test_a_report_that_was_cut_costs_no_other(self, tmp_path):
        texts = [json.dumps(report, indent=4) for report in reports(30)]
        texts[7] = texts[7][: texts[7].index("distance")]
        path = tmp_path / "log.json"
        path.write_text("[" + ",\n".join(texts) + "]")
        batches = read_format(WATER_LINKED, path)
        expected = np.delete(self.lines(tmp_path), 7)
        np.testing.assert_array_equal(joined(batches)["velocity"], expected["velocity"])
        assert str(batches[-1].losses).startswith("1 line of damaged JSON, at byte")

    def flat(self, report):
        out = {}
        for name, value in report.items():
            if name == "transducers":
                for index, beam in enumerate(value):
                    out |= {f"transducers_{index}_{key}": x for key, x in beam.items()}
            else:
                out[name] = value
        return out

    def table(self, tmp_path, times=None, separator=","):
        rows = [self.flat(report) for report in reports(30)]
        for row, time in zip(rows, times or [], strict=False):
            row["time"] = time
        lines = [separator.join(rows[0]), *(separator.join(map(str, r.values())) for r in rows)]
        path = tmp_path / "log.csv"
        path.write_text("\n".join(lines) + "\n")
        return read_format(WATER_LINKED_TABLES, path)

    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_a_table_is_what_its_reports_are(self, tmp_path, separator):
        times = [100.0 + i % 7 for i in range(30)]
        found = joined(self.table(tmp_path, times, separator))
        expected = self.lines(tmp_path)
        np.testing.assert_allclose(found["time"], np.cumsum(times) * 1e-3)
        for name in ("velocity", "beams", "range", "std"):
            np.testing.assert_array_equal(found[name], expected[name])
        # By hand: the second is not valid, and its third beam neither.
        assert np.isnan(found["velocity"][1]).all()
        np.testing.assert_array_equal(found["velocity"][2], [2.5, -0.1, 0.2])
        np.testing.assert_array_equal(found["range"][0], [1.0, 2.0, np.nan, 4.0])

    @pytest.mark.parametrize(
        "stamp",
        [
            lambda t: t,
            lambda t: round(t * 1e3),
            lambda t: round(t * 1e6),
            lambda t: str(np.datetime64(round(t * 1e3), "ms")) + "Z",
        ],
    )
    def test_stamps(self, tmp_path, stamp):
        times = [1638191471.5 + 0.25 * i for i in range(30)]
        batches = self.table(tmp_path, [stamp(t) for t in times])
        np.testing.assert_allclose(joined(batches)["time"], times, rtol=0, atol=1e-5)
        assert "stamps" in batches[0].notes[0]

    @pytest.mark.parametrize("name", ["timestamp", "log_time", "time_of_validity"])
    def test_columns_of_stamps(self, tmp_path, name):
        """A stamp of the logger is better than the time since the report before."""
        self.table(tmp_path, [100.0 + i % 7 for i in range(30)])
        path = tmp_path / "log.csv"
        head, *rows = path.read_text().splitlines()
        times = 1638191471.5 + 0.25 * np.arange(30)
        unit = 1e6 if name == "time_of_validity" else 1.0
        stamps = [f"{time * unit:.2f}" for time in times]
        for keep in (head, head.removeprefix("time,")):
            begin = 0 if keep == head else 1
            cut = [row.split(",", begin)[-1] for row in rows]
            lines = (f"{row},{stamp}" for row, stamp in zip(cut, stamps, strict=True))
            path.write_text("\n".join([f"{keep},{name}", *lines]))
            found = joined(read_format(WATER_LINKED_TABLES, path))
            np.testing.assert_allclose(found["time"], times, rtol=0, atol=1e-5)

    def test_rows_that_were_cut_are_counted(self, tmp_path):
        self.table(tmp_path)
        path = tmp_path / "log.csv"
        path.write_text(path.read_text() + "1,2,3\n")
        batches = read_format(WATER_LINKED_TABLES, path)
        assert batches[-1].losses.counts == {"row with another number of cells": 1}

    def test_other_tables_are_not_taken(self, tmp_path):
        path = tmp_path / "log.csv"
        path.write_text("time,vx,vy,vz\n" + "1,2,3,4\n" * 9)
        assert WATER_LINKED_TABLES[0].share(path, path.read_bytes()) == 0.0


def test_water_linked_json():
    beam = {
        "id": 0,
        "velocity": 0.1,
        "distance": 0.55,
        "rssi": -30,
        "nsd": -88,
        "beam_valid": True,
    }
    report = {"time": 106.5, "vx": 0.5, "vy": -0.25, "vz": 0.1, "fom": 0.002, "altitude": 0.49}
    report |= {
        "transducers": [beam, beam | {"id": 1, "beam_valid": False}],
        "velocity_valid": True,
    }
    report |= {
        "status": 0,
        "format": "json_v3",
        "type": "velocity",
        "time_of_validity": 1638191471563017,
    }
    data = b"2021-11-29 " + json.dumps(report).encode() + b"\n"
    data += json.dumps(report | {"velocity_valid": False}).encode() + b"\n{broken\n[1]\n"
    data += json.dumps({"ts": 49056.809, "x": 1.0, "type": "position_local"}).encode()
    found, _, positions, _ = next(iter(read_water_linked(data)))
    np.testing.assert_allclose(found["velocity"], [[0.5, -0.25, 0.1], [np.nan] * 3])
    np.testing.assert_allclose(found["beam_velocity"][0], [0.1, np.nan, np.nan, np.nan])
    assert found["time"][0] == pytest.approx(1638191471.563017, abs=1e-6)
    assert found["second"][1] == pytest.approx(0.213)
    assert positions["time"][0] == 49056.809


def serial(text):
    return f"{text}*{crc8(text.encode()):02x}\r\n".encode()


def test_water_linked_through_the_water(tmp_path):
    """Serial protocol 2.7 and json_v3.2: a mode that tracks the water, and the configuration."""
    covariance = ";".join(["1e-7"] * 9)
    text = f"0.1,-0.4,2.0,y,0.01,{covariance},7000000,7100000,123.0,0"
    report = {"time": 500, "vx": 0.5, "vy": 0.2, "vz": 0.1, "fom": 0.02, "velocity_valid": True}
    config = {"speed_of_sound": 1475.0, "mounting_rotation_offset": 20.0}
    reply = {"response_to": "get_config", "result": config, "type": "response"}
    lines = [
        serial("wrs," + text),
        serial("wra"),
        serial("wrc,1475.00,20.00,y,n,auto,y"),
        json.dumps(report | {"type": "velocity_water"}).encode() + b"\n",
        json.dumps(report | {"type": "velocity", "tracking_mode": "water"}).encode() + b"\n",
        json.dumps(reply).encode() + b"\n",
    ]
    path = tmp_path / "log.json"
    path.write_bytes(b"".join(lines))
    (form,) = recognise(path)
    batches = list(form.read(path, None))
    (water,) = (batch for batch in batches if len(batch.records))
    assert water.kind == "water"
    np.testing.assert_allclose(water.records["velocity"][0], [0.1, -0.4, 2.0])
    np.testing.assert_allclose(water.records["time"][0], 7.0)
    np.testing.assert_allclose(water.records["velocity"][1:], [[0.5, 0.2, 0.1]] * 2)
    assert water.notes[0].startswith("mounting_rotation_offset was 20° in the DVL")
    assert batches[-1].losses.skipped == {
        name: {"type not read": 1} for name in ("wra", "wrc", "response")
    }


def test_crc_of_the_standard_check():
    assert crc8(b"123456789") == 0xF4


@pytest.mark.parametrize(
    "text", [b"[" * 60000, b'{"vx":' * 9000, b'{"vx":' + b"9" * 6000 + b',"velocity_valid":true}']
)
def test_hostile_json_is_passed_over(text):
    for found, _, _, _ in read_water_linked(text):
        assert not np.isfinite(found["velocity"]).any()


def test_rowe():
    data = (
        rowe_ensemble(sentence=nmea("GPHDT,85.5,T"))
        + b"\x80" * 20
        + rowe_ensemble(2)[:-1]
        + rowe_ensemble(3)
    )
    (found, sentences) = next(iter(read_rowe(data)))
    assert len(found) == 2
    np.testing.assert_allclose(found["velocity"][0], [0.5, -0.6, 0.7], atol=1e-6)
    np.testing.assert_allclose(found["beam_velocity"][0], [0.1, np.nan, 0.3, 0.4], atol=1e-6)
    np.testing.assert_allclose(found["range"][0], [10, np.nan, 11, 12])
    assert found["time"][0] == pytest.approx(WHEN.timestamp(), abs=1e-6)
    np.testing.assert_allclose(
        [found[n][0] / DEG for n in ("heading", "pitch", "roll")], [123, 2, 1], atol=1e-5
    )
    assert sentences["HDT"]["received"][0] == pytest.approx(WHEN.timestamp(), abs=1e-6)


def test_rowe_means_of_several_pings_and_errors_like_those_of_horizontal_velocities():
    """The error velocity has σ/2 of a beam, horizontal velocities √2/(2 sin θ) of it."""
    sine, cosine = np.sin(25.0 * DEG), np.cos(25.0 * DEG)
    rng = np.random.default_rng(4)
    x, y, z, e = rng.normal(size=(4, 50))
    beams = np.array(
        [sine * x + cosine * z + e, -sine * x + cosine * z + e,
         sine * y + cosine * z - e, -sine * y + cosine * z - e]
    )  # fmt: skip
    data = b"".join(
        rowe_ensemble(i, beams=beams[:, i], instrument=(x[i], y[i], z[i], e[i]), pings=3.0)
        for i in range(50)
    )
    (found, _) = next(iter(read_rowe(data)))
    np.testing.assert_allclose(found["error"], from_beams(beams.T, 25.0 * DEG)[:, 3], rtol=1e-5)
    # Pings at 0, 0.5 and 1 s.
    np.testing.assert_allclose(found["delay"], 0.5)
    np.testing.assert_allclose(found["window"], np.sqrt(12.0 * np.var([0.0, 0.5, 1.0])))
    # Where no ping shows the angle of the beams, nothing is known of errors.
    (found, _) = next(iter(read_rowe(rowe_ensemble())))
    assert np.isnan(found["error"]).all()
    assert np.isnan(found["window"]).all()


def test_rowe_with_other_numbers_of_beams():
    """Three beams have no error velocity; a vertical beam has ensembles of its own."""

    def ensemble(beams, number):
        arrays = [[10.0] * beams, *[[1.0] * beams] * 3, [0.1] * beams, [1.0] * beams]
        arrays += [[0.5, -0.6, 0.7, 0.01][:beams], [1.0] * beams, [1.0] * beams, [1.0] * beams]
        return writers.rowe(number, WHEN, [value for part in arrays for value in part])

    losses = Losses()
    data = ensemble(3, 1) + ensemble(1, 2) + ensemble(4, 3)
    (found, _) = next(iter(read_rowe(data, losses=losses)))
    np.testing.assert_allclose(found["velocity"], [[0.5, -0.6, 0.7]] * 2)
    assert np.isnan(found["error"][0])
    assert losses.skipped == {"ensemble without bottom track of three beams": {"type not read": 1}}


def test_instruments_without_tilt_sensors_send_zeros():
    lines = b":SA, +0.00, +0.00,  0.00\n:BI, +500, -600,   +7,  +8,A\n" * 3
    (found,) = read_pd6(lines)
    assert not list(attitude(found, "own"))
    (found,) = read_pd6(lines + b":SA, +0.00, +0.10,  0.00\n:BI, +500, -600,   +7,  +8,A\n")
    (batch,) = attitude(found, "own")
    np.testing.assert_array_equal(np.isfinite(batch.records["heading"]), [False] * 3 + [True])


def test_pd6_through_the_water(tmp_path):
    lines = (":SA, +1.50, -2.25,181.02\n:WS, +120,  -30,   +5,A\n:WI, +100, -200,   +3,  +4,A\n"
             ":BI, +500, -600,   +7,  +8,A\n")  # fmt: skip
    path = tmp_path / "a.pd6"
    path.write_text(lines * 3)
    (form,) = (form for form in FORMATS if form.name == "pd6")
    batches = {batch.kind: batch.records for batch in form.read(path, None) if len(batch.records)}
    np.testing.assert_allclose(batches["water"]["velocity"], [[0.1, -0.2, 0.003]] * 3)
    np.testing.assert_allclose(batches["dvl"]["velocity"], [[0.5, -0.6, 0.007]] * 3)
    (found,) = read_pd6(b":SA,1,2,3\n:WI,1,2,3,4,V\n", track="W")
    assert np.isnan(found["velocity"]).all()
    # A line within quotes, as a cell of a table.
    (found,) = read_pd6(b'7,":SA,1,2,3",\n7,":BI,1000,2000,3,4,A",RESP\n')
    np.testing.assert_allclose(found["velocity"], [[1.0, 2.0, 0.003]])


def test_pd6_with_stamps(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(stamped_lines())
    assert [form.name for form in recognise(path)] == ["pd6-table"]
    (form,) = recognise(path)
    batches = list(form.read(path, None))
    found = {batch.kind: batch.records for batch in batches if len(batch.records)}
    dvl = found["dvl"]
    np.testing.assert_allclose(dvl["time"], 300.0 + 0.1 * np.arange(40), atol=1e-9)
    expected = 0.1 + 0.001 * np.arange(40)
    # One is invalid, and two have lost a digit.
    expected[[5, 7, 27]] = np.nan
    np.testing.assert_allclose(dvl["velocity"][:, 0], expected)
    np.testing.assert_allclose(found["water"]["velocity"][:, 1], -0.001 * np.arange(40))
    np.testing.assert_allclose(found["attitude"]["heading"] / DEG % 360, 181.0 + np.arange(40))
    lines = path.read_bytes().split(b"\n")
    assert lines[3].startswith(path.read_bytes()[dvl["at"][0] :][:20])
    losses = batches[-1].losses
    assert losses.counts == {"line of no type": 1, "line of another length": 2}
    assert losses.skipped == {":CS": {"type not read": 1}}
