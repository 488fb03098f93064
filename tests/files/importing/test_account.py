"""No record is lost in silence: read and skipped by type, with the reason."""

from __future__ import annotations

import csv
import gzip
import json
import re
from collections import Counter
from functools import partial
from pathlib import Path

import format_fuzz as fuzz
import format_logs as logs
import format_writers as writers
import numpy as np
import pytest
import yaml
from running import run  # noqa: F401

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.files.formats import rowe
from factorgraph_dvl.files.formats.catalogue import FORMATS
from factorgraph_dvl.files.formats.format import Batch, empty
from factorgraph_dvl.files.formats.losses import Losses
from factorgraph_dvl.files.importing.account import Account
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.importing.spool import Spool
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.files.trial_folder import load_trial
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import rotate

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
RECORDINGS = DATA / "recordings"


def gga(i, quality=1):
    return writers.nmea(f"GPGGA,1235{i:02d},4807.038,N,01131.000,E,{quality},08,0.9,5.4,M,6.9,M,,")


def accounted(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    decisions = import_files([path], tmp_path / "trial")
    (account,) = decisions.accounts
    log = (tmp_path / "trial" / "import.log").read_text()
    for line in account.lines():
        assert f"{name}: records: {line}\n" in log
    return {kind: (read, reasons) for kind, read, _, reasons in account.rows()}, decisions


def test_sentences(tmp_path):
    wrong = bytearray(gga(40))
    wrong[20] ^= 1
    other = writers.nmea("GPGSV,3,1,11,03,03,111,00")
    data = b"".join(map(gga, range(20))) + gga(30, 0) * 3 + other * 4 + bytes(wrong)
    data += writers.nmea("GPZDA,123520.00,25,07,2022,00,00") + writers.nmea("PASHR,ATT,1,2")
    found, decisions = accounted(tmp_path, "a.nmea", data)
    assert found == {
        "GGA (fix)": (20, "no fix"),
        "GPGSV": (0, "type not read"),
        "PASHR of another form": (0, "type not read"),
        "ZDA": (1, ""),
        "damaged": (0, "sentence with a wrong checksum"),
    }
    assert decisions.warnings == ["a.nmea: GGA (fix): 3 of 23 records skipped (no fix)"]
    assert "warning: a.nmea: GGA (fix)" in (tmp_path / "trial" / "import.log").read_text()


def test_a_tenth_is_not_worth_a_warning(tmp_path):
    data = b"".join(map(gga, range(27))) + gga(30, 0) * 3
    assert accounted(tmp_path, "a.nmea", data)[1].warnings == []


def batch_of(time, valid, kind="imu"):
    records = empty(kind, len(time))
    records["time"] = time
    for name in ("gyro", "accel"):
        records[name] = 1.0
    return Batch(kind, records, "own", "IMU", valid=np.array(valid, bool))


@pytest.fixture
def spool(tmp_path):
    said = []
    out = Spool(tmp_path, lambda *_: None, said.append)
    return out, said


def test_a_status_that_is_never_set_drops_nothing(spool):
    store, said = spool
    for start in (0.0, 10.0):
        store.append("f", "nucleus", batch_of(start + np.arange(5.0), [False] * 5))
    (tally,) = store.tallies("f").values()
    assert (tally.read, tally.skipped) == (10, {})
    assert said == [
        "f: IMU (imu): the status calls all 10 records invalid → kept, as a status that is never "
        "set says nothing"
    ]
    (stream,) = store.streams()
    np.testing.assert_array_equal(stream.records[:]["time"], [0, 1, 2, 3, 4, 10, 11, 12, 13, 14])


def test_a_status_that_is_set_once_counts_from_the_start(spool):
    store, said = spool
    store.append("f", "nucleus", batch_of(np.arange(5.0), [False] * 5))
    store.append("f", "nucleus", batch_of(5.0 + np.arange(3.0), [True, False, True]))
    store.append("f", "nucleus", batch_of(np.array([9.0]), [False]))
    (tally,) = store.tallies("f").values()
    assert (tally.read, tally.skipped) == (2, {"status": 7})
    (stream,) = store.streams()
    np.testing.assert_array_equal(stream.records[:]["time"], [5.0, 7.0])
    assert said == []


def test_records_without_time_or_value(spool):
    store, _ = spool
    batch = batch_of(np.array([0.0, np.nan, 2.0, 3.0]), [True] * 4)
    batch.records["accel"][2, 1] = np.nan
    store.append("f", "nucleus", batch)
    (tally,) = store.tallies("f").values()
    assert (tally.read, tally.skipped) == (2, {"no time": 1, "no value": 1})
    assert tally.reasons == "no time: 1, no value: 1"


def whole_files():
    for name, files in fuzz.files().items():
        yield from (pytest.param(name, ending, lambda d=d: d, id=name) for ending, d in files)
    for name, files in fuzz.of_libraries().items():
        yield from (pytest.param(name, ending, make, id=name) for ending, make in files)


@pytest.mark.parametrize(("name", "ending", "make"), list(whole_files()))
def test_every_reader_accounts_for_what_it_read(tmp_path, name, ending, make):
    (form,) = (form for form in FORMATS if form.name == name)
    if form.module:
        pytest.importorskip(form.module.partition(".")[0])
    path = tmp_path / f"log{ending}"
    path.write_bytes(make())
    spool = Spool(tmp_path, lambda *_: None)
    losses, count, has_losses = Losses(), 0, False
    for batch in form.read(path, None):
        spool.append("f", name, batch)
        count += len(batch.records)
        if batch.losses is not None:
            losses.include(batch.losses)
            has_losses = True
    account = Account("f", spool.tallies("f"))
    assert sum(read + skipped for _, read, skipped, _ in account.rows()) == count
    assert has_losses, "the reader does not say what it left out"
    account.include(losses)
    assert sum(row[1] for row in account.rows()) > 0


def test_the_table_is_an_event(tmp_path, run):  # noqa: F811
    (tmp_path / "a.nmea").write_bytes(b"".join(map(gga, range(5))) + gga(30, 0))
    done = run("import", tmp_path / "a.nmea", "--out", tmp_path / "trial", "--json")
    events = [json.loads(line) for line in done.out.splitlines()]
    (table,) = (event for event in events if event["event"] == "table")
    assert table["columns"] == ["type", "read", "skipped", "reasons"]
    assert table["rows"] == [["GGA (fix)", "5", "1", "no fix"]]
    warned = [event["text"] for event in events if event["event"] == "warning"]
    assert "a.nmea: GGA (fix): 1 of 6 records skipped (no fix)" in warned


class TestRecordings:
    """Counts by type against decoders of others, on recordings outside this repository."""

    def accounted(self, tmp_path, name, folder=RECORDINGS):
        if not (folder / name).is_file():
            pytest.skip(f"no recording {name}")
        decisions = import_files([folder / name], tmp_path / "trial")
        return {kind: (read, skipped) for kind, read, skipped, _ in decisions.accounts[0].rows()}

    def test_nucleus(self, tmp_path):
        parser = pytest.importorskip("nucleus_driver._parser")
        found = self.accounted(tmp_path, "nucleus_at_rest.nucleus")
        data = (RECORDINGS / "nucleus_at_rest.nucleus").read_bytes()
        # By the maker's parser alone: header of 10 bytes, its length of the rest at byte 4.
        silent = type("", (), dict.fromkeys(("write_warning", "write_exception"), print))()
        decoder, counts, at = parser.Parser(messages=silent), {}, 0
        while (at := data.find(b"\xa5\x0a", at)) >= 0 and at + 10 <= len(data):
            stop = at + 10 + int.from_bytes(data[at + 4 : at + 6], "little")
            header, content, _ = decoder.get_packet(bytearray(data[at:stop]))
            if stop <= len(data) and header and content:
                counts[data[at + 2]] = counts.get(data[at + 2], 0) + 1
                at = stop
            else:
                at += 1
        kinds = {
            "IMU (imu)": 0x82,
            "AHRS (attitude)": 0xD2,
            "bottom track (dvl)": 0xB4,
            "water track (water)": 0xBE,
            "magnetometer (packet 0x87)": 0x87,
            "altimeter (packet 0xAA)": 0xAA,
        }
        assert {name: sum(found[name]) for name in kinds} == {
            name: counts[kind] for name, kind in kinds.items()
        }
        assert found["IMU (imu)"] == (17_773, 0)

    @pytest.mark.parametrize(
        ("name", "by_mhkit"),
        [
            # Of mhkit 1.1.2: pings, and those with bottom lock. It leaves out the last ping of
            # what WinRiver wrote, and most sentences.
            ("nenana_river/nenana_2010-09-23.PD0", (830, 610)),
            ("adcp_raw/winriver01.PD0", (261, 261)),
            ("adcp_raw/vmdas01_wh.ENX", (3713, 0)),
        ],
    )
    def test_pd0(self, tmp_path, name, by_mhkit):
        found = self.accounted(tmp_path, Path(name).name, (DATA / name).parent)
        data, at = (DATA / name).read_bytes(), 0
        types, last, locked = Counter(), False, 0
        while (at := data.find(b"\x7f\x7f", at)) >= 0:
            size = int.from_bytes(data[at + 2 : at + 4], "little")
            part = data[at : at + size + 2]
            if len(part) < size + 2 or sum(part[:size]) % 65536 != int.from_bytes(
                part[size:], "little"
            ):
                at += 1
                continue
            at, last = at + size + 2, False
            for start in np.frombuffer(part, "<u2", part[5], 6):
                kind = int.from_bytes(part[start : start + 2], "little")
                types[kind] += 1
                if kind == 0x0600:
                    last = (np.frombuffer(part, "<i2", 3, start + 24) != -32768).all()
            locked += last
        pings = types[0x0000]
        lost = int(0x2022 in types)
        assert by_mhkit == (pings - lost, locked - lost * last)
        assert sum(found["leader (attitude)"]) == sum(found["cells (water)"]) == pings
        if 0x0600 in types:
            assert found["bottom (dvl)"] == (locked, pings - locked)
        sentences = sum(sum(found.get(n, (0, 0))) for n in ("GGA (fix)", "VTG (course)"))
        # 0x2022 has any sentence; 0x2101 and 0x2102 are GGA and VTG; 0x2000 has two fixes.
        assert sentences == types[0x2022] + types[0x2101] + types[0x2102]
        assert sum(found.get("VmDas (fix)", (0, 0))) == 2 * types[0x2000]

    def test_ad2cp(self, tmp_path):
        found = self.accounted(tmp_path, "VelEchoBT01.ad2cp", DATA / "adcp_raw")
        data, at, types = (DATA / "adcp_raw" / "VelEchoBT01.ad2cp").read_bytes(), 0, Counter()
        while 0 <= (at := data.find(b"\xa5\x0a", at)) <= len(data) - 10:
            words = np.frombuffer(data, "<u2", 5, at)
            stop = at + 10 + int(words[2])
            if (int(words[:4].sum()) + 0xB58C) % 65536 == words[4] and stop <= len(data):
                types[data[at + 2]] += 1
                at = stop
            else:
                at += 1
        names = {
            "bottom (dvl)": 0x17,
            "leader (attitude)": 0x17,
            "record 0x18": 0x18,
            "record 0x15": 0x15,
            "record 0x1C": 0x1C,
            "text": 0xA0,
        }
        assert {name: sum(count) for name, count in found.items()} == {
            name: types[kind] for name, kind in names.items()
        }
        # Of mhkit 1.1.2: `vel_bt`, and none of them with lock.
        assert found["bottom (dvl)"] == (0, 159)

    def test_water_linked(self, tmp_path):
        found = self.accounted(tmp_path, "water_linked_a50.json")
        text = (RECORDINGS / "water_linked_a50.json").read_text()
        assert sum(found["dvl"]) == text.count('"velocity_valid"') == 232
        assert found["dvl"][0] == text.count('"velocity_valid": true')
        assert found["position_local"] == (0, text.count('"type": "position_local"'))

    def test_rowe(self, tmp_path):
        found = self.accounted(tmp_path, "rowe_boat_turns.ens")
        data = (RECORDINGS / "rowe_boat_turns.ens").read_bytes()
        assert sum(found["dvl"]) == data.count(b"\x80" * 16) == 267
        # One data set of each ensemble repeats sentences of another one, and is not read.
        assert found["data set R000003"] == (0, 267)
        repeated = b"".join(part[:158] for part in data.split(b"R000003\0")[1:])
        for name in ("GGA (fix)", "RMC (fix)", "VTG (course)", "HDT (attitude)", "ZDA"):
            pattern = rb"\$[A-Z]{2}" + name[:3].encode() + rb",[^$]*?\*[0-9A-F]{2}"
            again = len(re.findall(pattern, repeated))
            assert sum(found[name]) == len(re.findall(pattern, data)) - again

    def test_speeds_of_rowe_are_those_of_its_gnss(self, tmp_path):
        """On the straight legs, where 1 % is ten times what single pings scatter in their mean."""
        self.accounted(tmp_path, "rowe_boat_turns.ens")
        names = ("time_s", "vel_x_m_s", "vel_y_m_s")
        time, x, y = read_table(tmp_path / "trial" / "dvl.parquet", names).values()
        stamp, east, north = read_table(
            tmp_path / "trial" / "gnss.parquet", ("time_s", "vel_e_m_s", "vel_n_m_s")
        ).values()
        known = np.isfinite(east)
        over_ground = np.interp(time, stamp[known], np.hypot(east, north)[known])
        legs = (over_ground > 1.5) & np.isfinite(x)
        assert legs.sum() > 80
        assert np.median(np.hypot(x, y)[legs] / over_ground[legs]) == pytest.approx(1.0, abs=0.01)
        # The spread of the error velocity, scaled, is that of the velocity across the way.
        settings = yaml.safe_load((tmp_path / "trial" / "trial.yaml").read_text())["dvl"]
        steps = np.diff(y[legs])[np.diff(time[legs]) < 2.0] / np.sqrt(2.0)
        assert settings["velocity_std_m_s"] == pytest.approx(np.std(steps), rel=0.25)
        assert settings["averaging_s"] == pytest.approx(1.1, abs=0.05)

    def test_axes_of_rowe_are_those_of_its_earth_velocities(self):
        """Forward, starboard, down, by heading, pitch and roll of the same ping."""
        path = RECORDINGS / "rowe_boat_turns.ens"
        if not path.is_file():
            pytest.skip(f"no recording {path.name}")
        data = path.read_bytes()
        (found, _), *_ = rowe.read_rowe(data)
        known = np.isfinite(found["velocity"]).all(axis=1)
        rph = np.stack([found[name] for name in ("roll", "pitch", "heading")], axis=1)[known]
        turned = rotate(rotation_from_rph(rph, "FRD"), found["velocity"][known])
        # Behind the name: 14 floats, then ten arrays of four, of which the ninth is in Earth axes.
        starts = [m.end() + 4 * (14 + 8 * 4) for m in re.finditer(b"E000010\0", data)]
        earth = np.array([np.frombuffer(data[at : at + 12], "<f4") for at in starts])[known]
        assert len(earth) == 239
        np.testing.assert_allclose(turned, earth, atol=2e-6)

    def test_ardupilot(self, tmp_path):
        reader = pytest.importorskip("pymavlink.DFReader")
        found = self.accounted(tmp_path, "ardusub_small.BIN")
        log = reader.DFReader_binary(str(RECORDINGS / "ardusub_small.BIN"))
        counts = {}
        for message in iter(partial(log.recv_match, strict=True), None):
            counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
        log.close()
        assert {
            name.partition("[")[0]: sum(count) for name, count in found.items() if count != (0, 0)
        } == counts

    def test_telemetry(self, tmp_path):
        library = pytest.importorskip("pymavlink.mavutil")
        found = self.accounted(tmp_path, "ardusub_small.tlog")
        log = library.mavlink_connection(str(RECORDINGS / "ardusub_small.tlog"))
        counts, ours = {}, {}
        for message in iter(log.recv_match, None):
            counts[message.get_type()] = counts.get(message.get_type(), 0) + 1
        log.close()
        for name, count in found.items():
            kind = name.partition(" ")[0]
            ours[kind] = ours.get(kind, 0) + sum(count)
        ours["BAD_DATA"] = ours.pop("damaged")
        assert ours == counts

    def test_underwater_gps(self, tmp_path):
        """Counts by the module csv."""
        parts = ("g2_acoustic", "g2_position", "g2_orientation", "nmea_GGA", "nmea_HDT")
        files, tables = [], []
        for part in parts:
            packed = RECORDINGS / f"ugps_g2_{part}.csv.gz"
            if not packed.is_file():
                pytest.skip(f"no recording {packed.name}")
            files.append(tmp_path / f"{part}.csv")
            files[-1].write_bytes(gzip.decompress(packed.read_bytes()))
            tables.append(list(csv.DictReader(files[-1].read_text().splitlines())))
        decisions = import_files(files, tmp_path / "trial")
        found = [
            {kind: (read, skipped) for kind, read, skipped, _ in account.rows()}
            for account in decisions.accounts
        ]
        contents = [[v for k, v in row.items() if k != "timestamp"] for row in tables[0]]
        new = [i for i, row in enumerate(contents) if not i or row != contents[i - 1]]
        valid = [i for i in new if tables[0][i]["position_valid"] == "True"]
        assert found[0]["locator (acoustic)"] == (len(valid), len(new) - len(valid))
        # By the file, errors are of metres; they change by a tenth of a metre.
        text = decisions.text("")
        assert "from one fix to the next, errors differ by 0.13 m; stated are 3.5 m" in text
        assert "smoothed, or errors that last" in text
        lacks = [line for line in decisions.missing if "no file has" in line]
        assert [line.partition(":")[0] for line in lacks] == ["velocities", "attitude"]
        with pytest.raises(ConfigError, match="positions alone have nothing to calibrate"):
            load_trial(tmp_path / "trial")
        assert found[0]["row"] == (0, len(contents) - len(new))
        assert found[1] == {"position (topside)": (len(tables[1]), 0)}
        assert found[2] == {"orientation of the housing": (0, len(tables[2]))}
        assert found[3]["GGA (topside)"] == found[3]["GGA (clock)"] == (len(tables[3]), 0)
        assert found[4] == {"HDT (topside)": (len(tables[4]), 0)}
        assert 1700 < len(valid) < 1800

    def test_pd6_table(self, tmp_path):
        """Counts by the module csv."""
        packed = RECORDINGS / "h1000_pd6_pool.csv.gz"
        if not packed.is_file():
            pytest.skip(f"no recording {packed.name}")
        path = tmp_path / "a.csv"
        path.write_bytes(gzip.decompress(packed.read_bytes()))
        decisions = import_files([path], tmp_path / "trial")
        found = {kind: (read, skipped) for kind, read, skipped, _ in decisions.accounts[0].rows()}
        text = path.read_text().rstrip("\0").splitlines()
        lines = [row["RawLine"] for row in csv.DictReader(text)]
        counts = {}
        for line in lines:
            counts.setdefault(line[:4], Counter())[len(line)] += 1
        whole = {kind: lengths.most_common(1)[0][1] for kind, lengths in counts.items()}
        for kind in (":TS", ":BI", ":BS", ":BE", ":BD"):
            assert sum(found[kind]) == whole[kind + ","]
        assert sum(found["dvl"]) == whole[":SA,"] == 6183
        typed = sum(sum(c.values()) for k, c in counts.items() if re.fullmatch(":[A-Z]{2},", k))
        cut = typed - sum(n for kind, n in whole.items() if re.fullmatch(":[A-Z]{2},", kind))
        # The rest of the file is zeros.
        assert found["damaged"] == (0, len(lines) - typed + cut + 1)

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "lacks"),
        [
            ("nucleus_at_rest.nucleus", ["positions", "velocities: 266 pings, and none"]),
            ("water_linked_a50.json", ["positions", "velocities: 232 pings", "attitude"]),
            ("h1000_pd6_pool.csv.gz", ["positions"]),
            ("ardusub_small.BIN", ["positions", "velocities: no file has any"]),
            ("ardusub_small.tlog", ["velocities: no file has any"]),
            ("px4_small.ulg", ["velocities: no file has any"]),
            ("rowe_boat_turns.ens", []),
        ],
    )
    def test_what_is_missing_for_a_calibration_is_said(self, tmp_path, name, lacks):
        path = RECORDINGS / name
        if not path.is_file():
            pytest.skip(f"no recording {name}")
        if path.suffix == ".gz":
            packed, path = path, tmp_path / path.stem
            path.write_bytes(gzip.decompress(packed.read_bytes()))
        for form in FORMATS:
            if form.module and path.suffix.lower() in form.endings:
                pytest.importorskip(form.module.partition(".")[0])
        missing = import_files([path], tmp_path / "trial").missing
        assert len(missing) == len(lacks)
        assert all(text.startswith(start) for text, start in zip(missing, lacks, strict=True))

    def test_ulog(self, tmp_path):
        pyulog = pytest.importorskip("pyulog")
        found = self.accounted(tmp_path, "px4_small.ulg")
        counts, ours = {}, {}
        for data in pyulog.ULog(str(RECORDINGS / "px4_small.ulg")).data_list:
            counts[data.name] = counts.get(data.name, 0) + len(data.data["timestamp"])
        for name, count in found.items():
            topic = name.partition("[")[0]
            ours[topic] = ours.get(topic, 0) + sum(count)
        assert ours == counts


@pytest.mark.parametrize(("step", "used"), [(0.05, "imu"), (0.25, "attitude")])
def test_an_imu_that_is_too_slow_gives_way_to_an_attitude(tmp_path, step, used):
    pytest.importorskip("pymavlink")
    data = b""
    for i in range(20):
        own = 100.0 + step * i
        at = logs.START + own
        data += logs.telemetry("RAW_IMU", at, round(own * 1e6), 1, 2, -1000, *[0] * 8)
        data += logs.telemetry("ATTITUDE", at, round(own * 1e3), 0.1, 0.2, 0.3, 0, 0, 0)
    (tmp_path / "a.tlog").write_bytes(data)
    decisions = import_files([tmp_path / "a.tlog"], tmp_path / "trial")
    sections = yaml.safe_load((tmp_path / "trial" / "trial.yaml").read_text())
    assert {"imu", "attitude"} & set(sections) == {used}
    assert ("do not show how" in decisions.text("")) is (used == "attitude")
