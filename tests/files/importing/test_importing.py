"""What an import decides: formats, clocks, order, axes, and what it leaves alone."""

import re
import tracemalloc
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import format_samples as samples
import format_writers as writers
import msgspec
import numpy as np
import pytest

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.format import Batch, empty
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing import merging, raw_files, spool, time_base
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.guess import guess_all
from factorgraph_dvl.files.importing.lag import lag_between
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.files.importing.recognition import recognise
from factorgraph_dvl.files.tables import read_table
from factorgraph_dvl.settings.yaml_file import parse_yaml, read_yaml

WHEN = datetime(2021, 3, 4, 5, 6, 7, tzinfo=UTC)


def ping(number, velocity, when, *, frame=1, **leader):
    angles = {name: leader.pop(name) for name in ("heading", "pitch", "roll") if name in leader}
    parts = [
        writers.fixed_leader(frame=frame, **leader),
        writers.variable_leader(number, when, **angles),
        writers.bottom_track(velocity, (20.0,) * 4),
    ]
    return writers.pd0(parts)


def pings(count=30, start=WHEN, velocity=(0.1, -1.5, 0.0, 0.01), **leader):
    moments = (start + timedelta(seconds=i) for i in range(count))
    return b"".join(ping(i, velocity, when, **leader) for i, when in enumerate(moments))


def fixes(count=30, start=WHEN, north=1.5):
    out = []
    for i in range(count):
        when = start + timedelta(seconds=i)
        minutes = 8.0 + i * north / 1852.0
        clock, date = when.strftime("%H%M%S"), when.strftime("%d%m%y")
        place = f"48{minutes:010.7f},N,01131.0000000,E"
        out.append(writers.nmea(f"GPRMC,{clock},A,{place},2.916,0.0,{date},,,A"))
        out.append(writers.nmea(f"GPGGA,{clock},{place},2,8,0.9,545.4,M,46.9,M,,"))
    return b"".join(out)


def imported(tmp_path, *contents, **options):
    files = []
    for i, content in enumerate(contents):
        files.append(tmp_path / f"file{i}")
        files[-1].write_bytes(content)
    out = tmp_path / "trial"
    return out, import_files(files, out, **options)


def column(out, table, *names):
    found = read_table(out / f"{table}.parquet", names)
    return np.stack([found[name] for name in names], axis=1)


def imu_table():
    rows = (f"{WHEN.timestamp() + 0.1 * i},0,0,0,0,0,9.8" for i in range(300))
    return "\n".join(["t,gx,gy,gz,ax,ay,az", *rows]).encode()


def imu_mapping(axes):
    names = {"gyro_x": "gx", "gyro_y": "gy", "gyro_z": "gz"}
    names |= {"accel_x": "ax", "accel_y": "ay", "accel_z": "az"}
    table = {"file": "file2", "kind": "imu", "axes": axes, "columns": names}
    table["time"] = {"column": "t", "clock": "utc"}
    return msgspec.convert({"tables": [table]}, MappingSettings)


VELOCITY = ("vel_x_m_s", "vel_y_m_s", "vel_z_m_s")
FIX = ("lat_deg", "lon_deg", "height_m", "vel_e_m_s", "vel_n_m_s")


def test_stamps_move_from_the_start_of_an_average_to_its_middle(tmp_path):
    usual, _ = imported(tmp_path, pings(velocity=(0.1, -1.5, 0.0, 0.01)), fixes())
    first = column(usual, "dvl", "time_s")[:, 0]
    out, decisions = imported(tmp_path, pings(pings=(4, 0.2)), fixes(), force=True)
    # Seconds since 1970 are exact to 2.4e-7 s.
    np.testing.assert_allclose(column(out, "dvl", "time_s")[:, 0] - first, 0.3, atol=1e-6)
    assert any("0.2 s apart" in line and "by 0.3 s" in line for line in decisions.lines)


def test_says_when_the_beams_contradict_each_other(tmp_path):
    def log(*wrong):
        errors = (0.5 if i in wrong else 0.01 * (-1) ** i for i in range(60))
        moments = (WHEN + timedelta(seconds=i) for i in range(60))
        return b"".join(
            ping(i, (0.1, -1.5, 0.0, error), when)
            for i, (error, when) in enumerate(zip(errors, moments, strict=True))
        )

    _, decisions = imported(tmp_path, log(), fixes())
    assert not decisions.warnings
    _, decisions = imported(tmp_path, log(40, 41, 42, 43, 44), fixes(), force=True)
    (warning,) = decisions.warnings
    assert "5 of 60 pings with an error velocity above 5 σ" in warning
    assert "from 41 to 43 s after the first ping" in warning


def test_says_that_pings_have_no_time(tmp_path):
    start = WHEN.replace(year=1970)
    unset = b"".join(ping(i, (0.1, -1.5, 0.0, 0.01), start) for i in range(30))
    _, decisions = imported(tmp_path, unset)
    assert "file0 bottom: 30 pings, none with a time → left out" in decisions.lines


def test_limits_are_said_before_reading_and_progress_while(tmp_path, monkeypatch):
    said = []

    def limited(path):
        return tuple(replace(form, limit="keeps all in memory") for form in recognise(path))

    monkeypatch.setattr(raw_files, "recognise", limited)
    imported(tmp_path, pings(), fixes(), progress=said.append)
    assert said[0] == "file0: keeps all in memory"
    assert all(re.fullmatch(r"read file0, \d+ %", line) for line in said[1:3])
    assert said.index("file1: keeps all in memory") > said.index(said[2])
    assert said[-1] == "assemble"


def test_damage_is_a_line_for_each_file(tmp_path):
    data, text = bytearray(pings()), fixes()
    size = len(data) // 30
    for i in (4, 9):
        data[i * size + 80] ^= 1
    out, decisions = imported(tmp_path, bytes(data), text[:500] + bytes(7) + text[507:])
    first, second = (line for line in decisions.lines if line.endswith(" → left out"))
    assert first == (
        f"file0: 2 ensembles with a wrong checksum, the first at byte {4 * size:,} → left out"
    )
    assert second.startswith("file1: 7 bytes without text")
    assert first in (out / "import.log").read_text()
    _, decisions = imported(tmp_path, pings(), text, force=True)
    assert not any(line.endswith(" → left out") for line in decisions.lines)


class TestRecognition:
    @pytest.mark.parametrize(
        ("name", "content"),
        [
            ("pd0", pings()),
            ("nmea", fixes()),
            (
                "rtklib",
                samples.HEADER
                + b"%  GPST "
                + samples.COLUMNS
                + b"\n"
                + b"2019/06/08 08:03:55.000"
                + samples.VALUES
                + b"\n",
            ),
            ("water-linked", samples.SERIAL),
            ("pd6", samples.PD13.encode() if isinstance(samples.PD13, str) else samples.PD13),
            ("sbet", writers.sbet(samples.rows(200))),
            ("rowe", b"".join(samples.rowe_ensemble(i) for i in range(3))),
            (
                "pd4",
                b"".join(
                    writers.pd4(1, (0.1, 0.2, 0.3, 0.0), (10.0,) * 4, (1, 2, i, 0))
                    for i in range(9)
                ),
            ),
        ],
    )
    def test_by_content(self, tmp_path, name, content):
        path = tmp_path / "unnamed"
        path.write_bytes(content)
        assert [found.name for found in recognise(path)] == [name]

    def test_several_sentences_in_one_text(self, tmp_path):
        path = tmp_path / "log.txt"
        path.write_bytes(fixes() + samples.SERIAL * 10)
        assert {found.name for found in recognise(path)} == {"nmea", "water-linked"}

    @pytest.mark.parametrize("content", [b"", b"nothing of the kind\n" * 50, bytes(5000)])
    def test_refuses_what_it_does_not_know(self, tmp_path, content):
        with pytest.raises(
            DataError, match=r"file0: (not an instrument's file|a table whose|the file is empty)"
        ):
            imported(tmp_path, content)
        assert not (tmp_path / "trial").exists()

    def test_names_formats(self, tmp_path):
        with pytest.raises(ConfigError, match="there is no format `pd99`; expected one of ad2cp"):
            imported(tmp_path, pings(), form="pd99")

    def test_refuses_a_file_without_records(self, tmp_path):
        with pytest.raises(DataError, match="contains no data that a trial can use"):
            imported(tmp_path, fixes(), form="pd0")


class TestClocks:
    def test_local_time_is_found_by_speeds(self, tmp_path):
        # A clock of local time, three hours and 2 s ahead; the speed says so.
        rng = np.random.default_rng(3)
        speed = 1.5 + np.convolve(rng.standard_normal(340), np.ones(20) / 8.0, "same")[:300]
        local = WHEN + timedelta(hours=3, seconds=2)
        dvl = b"".join(
            ping(i, (0.0, -v, 0.0, 0.01), local + timedelta(seconds=i))
            for i, v in enumerate(speed.tolist())
        )
        place = np.cumsum(speed)
        nmea = b"".join(
            writers.nmea(
                f"GPRMC,{(WHEN + timedelta(seconds=i)).strftime('%H%M%S')},A,"
                f"48{8 + place[i] / 1852:010.7f},N,01131.0,E,{v * 3600 / 1852:.4f},0.0,040321,,,A"
            )
            for i, v in enumerate(speed.tolist())
        )
        out, decisions = imported(tmp_path, dvl, nmea)
        assert any("+10802.0 s from UTC where its speeds agree" in x for x in decisions.lines)
        assert column(out, "dvl", "time_s")[0, 0] == pytest.approx(0.0, abs=0.06)

    def test_unrelated_files_are_refused(self, tmp_path):
        with pytest.raises(DataError, match="its clock cannot be related to that of GNSS"):
            imported(tmp_path, pings(start=WHEN + timedelta(days=40)), fixes())

    def test_lag_of_a_gap(self):
        time = np.arange(0.0, 2000.0, 1.0)
        rng = np.random.default_rng(0)
        speed = np.convolve(rng.standard_normal(2100), np.ones(40) / 6.0, "same")[:2000]
        late = (time[500:1500] + 123.4, speed[500:1500])
        found = lag_between(late, (time, speed), zones=False)
        assert found.clear
        assert found.lag == pytest.approx(123.4, abs=0.11)

    def test_steady_speed_says_nothing(self):
        time = np.arange(0.0, 500.0)
        rng = np.random.default_rng(1)
        a, b = (2.0 + 0.01 * rng.standard_normal(500) for _ in range(2))
        assert not lag_between((time, a), (time, b), zones=True).clear


class TestAxes:
    def test_ship_coordinates_are_turned_back(self, tmp_path):
        # Beam 3 is 30° to starboard of the bow; the boat moves ahead, the bottom astern.
        out, decisions = imported(
            tmp_path, pings(frame=2, velocity=(0.0, -2.0, 0.0, 0.0), alignment=3000), fixes()
        )
        expected = [-2.0 * np.sin(np.pi / 6), 2.0 * np.cos(np.pi / 6), 0.0]
        np.testing.assert_allclose(column(out, "dvl", *VELOCITY)[0], expected, atol=1e-3)
        assert any("ship coordinates → turned back" in line for line in decisions.lines)

    def test_earth_coordinates_are_turned_back(self, tmp_path):
        out, _ = imported(
            tmp_path, pings(frame=3, velocity=(-2.0, 0.0, 0.0, 0.0), heading=90.0), fixes()
        )
        np.testing.assert_allclose(column(out, "dvl", *VELOCITY)[0], [0.0, 2.0, 0.0], atol=1e-3)

    def test_beams_where_all_pings_are_along_beams(self, tmp_path):
        out, _ = imported(tmp_path, pings(frame=0, velocity=(0.1, -0.1, 0.5, -0.5)), fixes())
        settings = read_yaml(out / "trial.yaml", dict)
        assert "dvl" not in settings
        directions = np.array(settings["dvl_beams"]["directions"])
        beams = column(out, "dvl_beams", *(f"beam{i}_m_s" for i in range(1, 5)))
        # What is measured outward along a beam is the velocity's part along it.
        velocity = np.linalg.lstsq(directions, beams[0], rcond=None)[0]
        s = np.sin(np.deg2rad(20.0))
        np.testing.assert_allclose(velocity, [-0.1 / s, 0.5 / s, 0.0], atol=1e-6)

    def test_axes_are_named_as_those_of_the_body(self, tmp_path):
        """Forward 1.5, starboard 0.1, down 0.2 m/s, by a DVL in FRD on bodies of any axes."""
        names = ("vx", "vy", "vz", "fom", "velocity_valid", "timestamp")
        cells = ((1.5, 0.1, 0.2, 0.01, 1, WHEN.timestamp() + i) for i in range(30))
        rows = [names, *cells]
        log = "\n".join(",".join(map(str, row)) for row in rows).encode()
        headings = b"".join(
            writers.nmea(f"GPHDT,{90 + i}.0,T") + fixes(1, WHEN + timedelta(seconds=i))
            for i in range(30)
        )
        # A heading has no axes: the body has those of the DVL.
        out, _ = imported(tmp_path, log, headings)
        settings = read_yaml(out / "trial.yaml", dict)
        assert settings["body_axes"] == "FRD"
        assert settings["dvl"]["misalignment_std_deg"] == [30.0, 30.0, 180.0]
        np.testing.assert_allclose(column(out, "dvl", *VELOCITY)[0], [1.5, 0.1, 0.2])
        files = (log, headings, imu_table())
        out, decisions = imported(tmp_path, *files, force=True, mapping=imu_mapping("RFU"))
        assert read_yaml(out / "trial.yaml", dict)["body_axes"] == "RFU"
        np.testing.assert_allclose(column(out, "dvl", *VELOCITY)[0], [0.1, 1.5, -0.2])
        assert "axes FRD of the DVL → RFU" in decisions.text("")
        out, _ = imported(tmp_path, *files, force=True, mapping=imu_mapping("FLU"))
        np.testing.assert_allclose(column(out, "dvl", *VELOCITY)[0], [1.5, -0.1, -0.2])

    def test_lost_pings_are_empty(self, tmp_path):
        bad = ping(99, (None,) * 4, WHEN + timedelta(seconds=40))
        out, decisions = imported(tmp_path, pings() + bad, fixes())
        velocity = column(out, "dvl", *VELOCITY)
        assert np.isnan(velocity[-1]).all()
        assert any("30 of 31 pings with bottom lock" in line for line in decisions.lines)


class TestMerging:
    def test_files_overlap_in_any_order(self, tmp_path):
        first, second = pings(20), pings(40)
        out, decisions = imported(tmp_path, second, fixes(), first)
        time = column(out, "dvl", "time_s")[:, 0]
        np.testing.assert_allclose(np.diff(time), 1.0)
        assert len(time) == 40
        assert any("20 records repeat the time of another one" in x for x in decisions.lines)

    def test_parts_of_files_do_not_matter(self, tmp_path, monkeypatch):
        late = fixes(30, WHEN + timedelta(seconds=25))
        first, second = pings(20), pings(30, WHEN + timedelta(seconds=15))
        # One file runs backwards, as parts that were joined in the wrong order.
        size = len(second) // 30
        mixed = second[20 * size :] + second[: 20 * size]
        whole, decisions = imported(tmp_path, mixed, fixes(), first, late)
        names = {"dvl": VELOCITY, "gnss": FIX, "attitude": ("heading_deg",)}
        kept = {table: column(whole, table, "time_s", *of) for table, of in names.items()}
        for module in (spool, merging, time_base):
            monkeypatch.setattr(module, "CHUNK", 7)
        again, others = imported(tmp_path, mixed, fixes(), first, late, force=True)
        assert others.lines == decisions.lines
        for table, values in kept.items():
            found = column(again, table, "time_s", *names[table])
            np.testing.assert_array_equal(found, values)

    def test_memory_does_not_grow_with_files(self, tmp_path, monkeypatch):
        for module in (spool, merging, time_base):
            monkeypatch.setattr(module, "CHUNK", 2_000)
        monkeypatch.setattr(merging, "SAMPLE", 100)
        monkeypatch.setattr(merging, "_USUAL", 1_000)
        store = spool.Spool(tmp_path, lambda *_: None)
        for begin in range(0, 100_000, 2_000):
            batch = Batch("course", empty("course", 2_000))
            batch.records["time"] = 1e9 + begin + np.arange(2_000)
            store.append("file", "nmea", batch)
        tracemalloc.start()
        (timed,) = time_base.on_utc(store.streams(), store, Decisions())
        found = merging.merge([timed], Decisions())
        timed.stream.records.thinned(100)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert (found.count, len(found.sample)) == (100_000, 100)
        # All records take 4 MB.
        assert most < 1e6

    def test_gaps_are_counted_where_intervals_are_many(self, monkeypatch):
        monkeypatch.setattr(merging, "_USUAL", 50)
        time = np.arange(400.0)
        time[30:] += 20.0
        time[300:] += 40.0
        intervals = merging._Intervals()
        for part in np.split(time, [10, 11, 200]):
            intervals.add(part)
        text = "2 gaps longer than 10 s, 62 s in all, the longest 41 s"
        assert str(intervals) == text

    def test_two_instruments_are_no_trial(self, tmp_path):
        with pytest.raises(DataError, match="2 velocity logs"):
            imported(tmp_path, pings(), pings(angle=2), fixes())

    def test_keeps_what_is_whole_in_damaged_files(self, tmp_path):
        dvl, nmea = bytearray(pings(100)), bytearray(fixes(100))
        rng = np.random.default_rng(5)
        for content in (dvl, nmea):
            for at in rng.integers(0, len(content), 20).tolist():
                content[at] ^= 0x10
        out, _ = imported(tmp_path, bytes(dvl[:-7]), b"garbage" + bytes(nmea))
        assert 79 <= len(column(out, "dvl", "time_s")) < 100
        assert 79 <= len(column(out, "gnss", "time_s")) < 100


def test_damaged_files_end_in_a_trial_or_an_error(tmp_path):
    whole = [pings(40), fixes(40), pings(40, frame=3), pings(40, frame=0), samples.SERIAL * 10]
    whole.append(writers.sbet(samples.rows(60)))
    rng = np.random.default_rng(11)
    done, refused = 0, {}
    for number in range(30):
        files = []
        for which in rng.integers(0, len(whole), rng.integers(1, 3)).tolist():
            content = bytearray(whole[which])
            for at in rng.integers(0, len(content), rng.integers(0, 40)).tolist():
                content[at] ^= 1 << int(rng.integers(8))
            files.append(tmp_path / f"{number}-{len(files)}")
            cut = int(rng.integers(len(content))) if rng.random() < 0.3 else 0
            files[-1].write_bytes(bytes(content[cut:]) + rng.bytes(int(rng.integers(300))))
        try:
            import_files(files, tmp_path / f"trial{number}")
            done += 1
        except DataError as error:
            refused[number] = error.where
    assert done > 10
    for number, where in refused.items():
        # Errors name the file, or are about several.
        assert where.startswith((f"{number}-", "import"))
        assert not (tmp_path / f"trial{number}").exists()


class TestFolder:
    def test_an_edited_trial_is_never_overwritten(self, tmp_path):
        out, _ = imported(tmp_path, pings(), fixes())
        edited = (out / "trial.yaml").read_text() + "noise: stated\n"
        (out / "trial.yaml").write_text(edited)
        imported(tmp_path, pings(), fixes(), force=True)
        assert (out / "trial.yaml").read_text() == edited
        assert "noise" not in (out / "trial.yaml.new").read_text()
        # And again: the log has the digest of what the import would have written.
        imported(tmp_path, pings(), fixes(), force=True)
        assert (out / "trial.yaml").read_text() == edited

    def test_replaces_its_own_with_force_only(self, tmp_path):
        out, _ = imported(tmp_path, pings(), fixes())
        (out / "notes.txt").write_text("mine")
        with pytest.raises(DataError, match="not empty"):
            imported(tmp_path, pings(), fixes())
        imported(tmp_path, pings(10), fixes(), force=True)
        assert len(column(out, "dvl", "time_s")) == 10
        assert (out / "notes.txt").read_text() == "mine"
        assert not (out / "trial.yaml.new").exists()

    def test_a_trial_of_others_is_left_alone(self, tmp_path):
        (tmp_path / "trial").mkdir()
        (tmp_path / "trial" / "trial.yaml").write_text("format: 1\n")
        with pytest.raises(DataError, match=r"contains trial.yaml but no import.log"):
            imported(tmp_path, pings(), fixes(), force=True)

    def test_every_key_has_its_reason(self, tmp_path):
        out, decisions = imported(tmp_path, pings(), fixes())
        text = (out / "trial.yaml").read_text()
        for line in (x.strip()[2:] for x in text.splitlines()[1:] if x.strip().startswith("# ")):
            assert line in decisions.lines


class TestTables:
    MAPPING = """
tables:
  - file: "file0"
    kind: dvl
    time: {column: t, unit: ms, clock: utc}
    invalid: [-9999]
    axes: FRD
    columns:
      vel_x: {column: vx, unit: mm/s}
      vel_y: {column: vy, unit: mm/s, sign: -1}
      vel_z: {column: 4, unit: mm/s}
trial: {dvl: {lever_arm_m: [1, 2, 3]}}
"""

    def table(self, separator=","):
        stamp = WHEN.timestamp() * 1e3
        rows = [[f"{stamp + 1e3 * i:.0f}", "1500", "-20", "0"] for i in range(20)]
        rows[3][1] = "-9999"
        rows[4] = rows[4][:2]
        rows[5][2] = "x"
        return "\n".join(separator.join(row) for row in [["t", "vx", "vy", "vz"], *rows]).encode()

    @pytest.mark.parametrize("separator", [",", ";", "\t", "   "])
    def test_units_signs_and_invalid_values(self, tmp_path, separator):
        mapping = parse_yaml(self.MAPPING, MappingSettings, source="map.yaml")
        out, _ = imported(tmp_path, self.table(separator), fixes(), mapping=mapping)
        velocity = column(out, "dvl", *VELOCITY)
        assert len(velocity) == 19
        np.testing.assert_allclose(velocity[0], [1.5, 0.02, 0.0])
        assert np.isnan(velocity[3:5]).all(axis=1).all()
        assert read_yaml(out / "trial.yaml", dict)["dvl"]["lever_arm_m"] == [1, 2, 3]

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("vx, unit: mm/s", "vx, unit: mph", "`unit` must be one of rad"),
            ("vel_z:", "vel_w:", "unknown vel_w; there are vel_x"),
            ("column: vx", "column: v", "has no column v"),
            ("kind: dvl", "kind: sonar", "sonar"),
        ],
    )
    def test_wrong_mappings_are_explained(self, tmp_path, old, new, message):
        text = self.MAPPING.replace(old, new)

        def run():
            mapping = parse_yaml(text, MappingSettings, source="map.yaml")
            imported(tmp_path, self.table(), fixes(), mapping=mapping)

        with pytest.raises((ConfigError, DataError), match=message):
            run()

    def test_guess_is_a_mapping_that_works(self, tmp_path):
        time = np.arange(200) / 10.0
        rows = np.column_stack(
            [time, 0.1 * np.sin(time), *[0 * time] * 3, 0 * time, 0 * time - 9.8]
        )
        header = "Time [s],GYRO X [rad/s],GYRO Y [rad/s],GYRO Z [rad/s],ACC X [m/s^2]"
        header += ",ACC Y [m/s^2],ACC Z [m/s^2]"
        imu = tmp_path / "imu.csv"
        np.savetxt(imu, rows, delimiter=",", header=header, comments="")
        log = tmp_path / "log.csv"
        cells = np.column_stack([time, 1500 + 0 * time, 0 * time, 0 * time])
        cells[7, 1] = 88.888
        np.savetxt(log, cells, delimiter=";", header="time_s;vx;vy;vz", comments="")
        text = guess_all([imu, log])
        assert "invalid: [88.888]" in text
        assert "FRD" in text
        mapping = parse_yaml(text, MappingSettings, source="guess")
        out = tmp_path / "trial"
        decisions = import_files([imu, log], out, mapping=mapping)
        np.testing.assert_allclose(column(out, "dvl", "vel_x_m_s")[0], 1.5)
        assert read_yaml(out / "trial.yaml", dict)["body_axes"] == "FRD"
        assert decisions.missing == [decisions.missing[0]]

    @pytest.mark.parametrize(
        ("name", "header", "row"),
        [
            ("a.csv", "time_s,roll_deg,pitch_deg,heading true (deg)", "{t},1,2,30"),
            ("no", "time_s,heading_deg", "{t},30"),
            ("a: b.csv", "t_ms;sog_kn;cog_deg", "{t};2;30"),
            ("a #1.csv", "time_s,lat_deg,lon_deg,height_m", "{t},48.1,-11.5,300"),
            ('a"b.csv', "utc,v_x_m_s,v_y_m_s,v_z_m_s", "{t},1,0,0"),
            ("[a].csv", "time_s,beam1_m_s,beam2_m_s,beam3_m_s,beam4_m_s", "{t},1,0,0,1"),
            ("true", "time_s,depth_m", "{t},4"),
            ("a\\b.csv", "time_s,yaw true", "{t},0.5"),
        ],
    )
    def test_every_guess_is_accepted(self, tmp_path, name, header, row):
        path = tmp_path / name
        lines = [header, *(row.format(t=1e9 + t) for t in range(30))]
        path.write_text("\n".join(lines) + "\n")
        (table,) = parse_yaml(guess_all([path]), MappingSettings, source="guess").of(path)
        if "true" in header:
            assert table.heading_reference == "true"
        if table.kind in ("dvl", "fix", "attitude"):
            mapping = parse_yaml(guess_all([path]), MappingSettings, source="guess")
            (account,) = import_files([path], tmp_path / "out", mapping=mapping).accounts
            assert [(read, skipped) for _, read, skipped, _ in account.rows()] == [(30, 0)]

    @pytest.mark.parametrize("written", ["true", '"true"', "True"])
    def test_true_headings_may_be_a_truth_value(self, written):
        text = (
            "tables:\n  - kind: attitude\n    time: {column: t}\n    columns: {heading: h}\n"
            f"    heading: {written}\n"
        )
        (table,) = parse_yaml(text, MappingSettings, source="m").tables
        assert table.heading_reference == "true"
        with pytest.raises(ConfigError, match="heading"):
            parse_yaml(text.replace(written, "false"), MappingSettings, source="m")

    def test_guess_refuses_what_is_no_table(self, tmp_path):
        path = tmp_path / "x.csv"
        path.write_text("a,b\n1,2\n")
        with pytest.raises(DataError, match="is recognised"):
            guess_all([path])


@pytest.mark.parametrize(
    ("files", "variation"),
    [
        ((("other.PD0", 7.0), ("A.pd0", -3.25)), "-3.25"),
        ((("other.PD0", 7.0),), "+7.00"),
        ((("b.PD0", 7.0), ("c.PD0", 8.0)), None),
    ],
)
def test_the_variation_that_was_set_in_winriver(tmp_path, files, variation):
    # The heading is that of a compass inside.
    pings = b"".join(samples.ensemble(i, sensors=0b10000) for i in range(20))
    (tmp_path / "a.PD0").write_bytes(pings)
    (tmp_path / "a.mmt").write_bytes(samples.winriver_settings(*files))
    without = import_files([tmp_path / "a.PD0"], tmp_path / "first")
    decisions = import_files([tmp_path / "a.PD0", tmp_path / "a.mmt"], tmp_path / "trial")
    text = decisions.text("")
    assert f"{files[0][0]}: magnetic variation {files[0][1]:g}°, transducer 0.25 m" in text
    first, second = (
        read_table(tmp_path / name / "attitude.parquet", ["heading_deg"])["heading_deg"]
        for name in ("first", "trial")
    )
    if variation is None:
        assert "several magnetic variations were set" in text
        np.testing.assert_allclose(second, first)
    else:
        assert f"the variation that was set, {variation}°" in text
        np.testing.assert_allclose((second - first + 180) % 360 - 180, float(variation))
    assert "no position" in without.text("")
    assert "a.mmt: lies beside and was not given" in without.text("")
    assert "lies beside" not in text
