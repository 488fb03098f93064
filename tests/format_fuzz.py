"""Feed readers damaged input: `python tests/format_fuzz.py COUNT [SEED [READERS]] [--import]`.

COUNT inputs of at most 64 kB for each reader of this package, or for those named (with commas
between). Readers of third-party libraries are named: `bag`, `ardupilot`, `ulog`, `tlog` and
`nucleus`; their process has limits of time and memory. With `--import`, all of `import` reads
each input, from recognising it to writing the trial.
"""

from __future__ import annotations

import json
import resource
import sqlite3
import sys
import tempfile
import time
import tracemalloc
import warnings
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import format_logs as logs
import format_samples as samples
import format_writers as writers
import msgspec
import numpy as np

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.catalogue import FORMATS
from factorgraph_dvl.files.formats.mapping import MappingSettings
from factorgraph_dvl.files.importing.guess import guess_all
from factorgraph_dvl.files.importing.raw_files import import_files
from factorgraph_dvl.settings.yaml_file import parse_yaml

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LIMIT = 1 << 16
WHEN = datetime(2021, 3, 4, 5, 6, 7, 120000, UTC)
# Of the process that runs a third-party library: address space, bytes, and processor time, s, for
# each input besides that for starting.
MOST_MEMORY = 4 << 30
SLOWEST, STARTING = 2.0, 60.0
# Tables of a velocity log with a compass of its own.
LOG = "time_s,vel_x_m_s,vel_y_m_s,vel_z_m_s,roll_deg,pitch_deg,heading_deg\n" + "".join(
    f"{1e9 + i},1.5,{0.01 * i:.2f},-0.1,1.0,2.0,{30 + i % 7}\n" for i in range(200)
)
TABLES = [("", LOG.encode()), ("", LOG.replace(",", ";").replace("m_s", "mm_s").encode())]


def head(path, count=LIMIT):
    path = DATA / path
    return path.read_bytes()[:count] if path.exists() else b""


def own_files():
    more = [
        writers.winriver_gga(0.4, "120953.25", 44.9, -66.9, 2, 9.3, -28.1),
        writers.winriver_text(
            204, 0.1, writers.nmea("GPGGA,123519,4807.0,N,01131.0,E,1,8,1,5,M,1,M,,")
        ),
    ]
    vm = writers.vmdas(
        datetime(2020, 8, 20),
        (1.0, 48, -123),
        (2.0, 48, -123),
        0,
        datetime(2020, 8, 20),
        3.0,
        1.0,
        0x7FF,
    )
    made = b"".join(samples.ensemble(i, more=[*more, vm]) for i in range(20))
    text = "".join(
        writers.nmea(t).decode()
        for i in range(60)
        for t in (
            f"GPGGA,1235{i:02d},4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,1.5,0001",
            f"GPRMC,1235{i:02d},A,2246.08,N,15755.97,W,0.05,253.92,250722,9.9,E,D",
            "GPVTG,253.92,T,243.98,M,0.05,N,0.10,K,D",
            f"GPZDA,1235{i:02d}.00,25,07,2022,00,00",
            f"GPGST,1235{i:02d}.00,0.30,0.28,0.17,19.72,0.27,0.19,0.45",
            "PASHR,085335.000,224.19,T,-01.26,+00.83,+00.01,0.101,0.113,0.267,1,0",
            "PRDID,1,2,3",
            "PIXSE,ATITUD,1,2",
            "PIXSE,TIME__,123456.7",
            "PADCP,1,20200820,010203.4,-0.5",
        )
    ).encode()
    echo = head("adcp_raw/VelEchoBT01.ad2cp")
    own = b"".join(
        writers.ad2cp(
            0x17,
            writers.df20(
                WHEN, (1.5, 2, 3, 4), (10, 11, 12, 13), (1, 2, 3, 4), ahrs=np.arange(16.0)
            ),
        )
        for _ in range(50)
    )
    track = writers.df21(WHEN, (1.5, 2, 3, 4), (1, 2, 3, 4), (10, 11, 12, 13))
    own += b"".join(writers.ad2cp(kind, track) for kind in (0x1B, 0x1D)) * 30
    nortek = b"".join(
        writers.nmea(f"PNORBT7,145224491{i % 10}.75,1,2,0.1,0.2,0.3,0.01,1,2,3,4")
        + writers.nmea(
            f"PNORBT1,BEAM={i % 4 + 1},DATE=040721,TIME=131335.1,DT1=0,DT2=0,BV=1,FM=0.1,"
            "DIST=1,STAT=0x1"
        )
        for i in range(100)
    )
    dvext = "DVEXT,T,A,3333,1.5,-2.5,90.0,0,0.01,5.5,1.25,-0.75,48.1,-123.0,0.1,1,0,0,0,6,6,6,6,"
    dvext += "T,T,F,T,0.1,0.2,0.3,0.4,5,6,7,8,"
    cerulean = (
        writers.nmea("DVPDL,101234000,50000,0.0,-0.0,-0.7,0.0,0.001,-0.005,100")
        + writers.nmea(dvext)
    ) * 50
    pd4s = b"".join(
        writers.pd4(i % 4, (0.1, 0.2, 0.3, 0.0), (1, 2, 3, 4), (1, 2, 3, 4), long=i % 2 == 0)
        for i in range(200)
    )
    beam = {"id": 0, "velocity": 0.1, "distance": 1.0, "beam_valid": True}
    report = {"time": 100.0, "vx": 0.5, "vy": 0.1, "vz": 0.2, "fom": 0.01, "altitude": 1.0}
    report |= {"transducers": [beam], "velocity_valid": True, "type": "velocity"}
    report |= {"time_of_validity": 1638191471563017}
    json_lines = (json.dumps(report).encode() + b"\n") * 50
    smooth = writers.sbet(samples.rows(200))
    pos = (
        samples.HEADER
        + b"%  GPST "
        + samples.COLUMNS
        + b"\n"
        + b"".join(
            b"2019/06/08 08:04:%02d.500" % (i % 60) + samples.VALUES + b"\n" for i in range(100)
        )
    )
    recordings = (
        "nenana_river/nenana_2010-09-23.PD0",
        "adcp_raw/vmdas01_wh.ENX",
        "adcp_raw/winriver01.PD0",
    )
    heading = writers.nmea("GPHDT,85.5,T")
    rowe = (samples.rowe_ensemble(i, heading, pings=1.0 + i % 3) for i in range(30))
    return {
        "nmea": [text],
        "underwater-gps": [
            data for name, data in samples.underwater_gps(60).items() if name != "orientation"
        ],
        "usbl-sentences": [samples.usbl_sentences()],
        "pixse": [samples.PIXSE * 40],
        "pd0": [made, *map(head, recordings)],
        "ad2cp": [own, echo],
        "winriver": [samples.winriver_settings(*((f"a{i}.PD0", i) for i in range(30)))],
        "pd4": [pd4s],
        "pd6": [samples.PD13.encode() * 40],
        "pd6-table": [samples.stamped_lines(100)],
        "nortek": [nortek],
        "cerulean": [cerulean],
        "water-linked": [
            samples.SERIAL * 20,
            json_lines,
            json.dumps([report] * 30, indent=4).encode(),
            json.dumps([report] * 30).encode(),
            # A recording without lock: here it has some.
            head("recordings/water_linked_a50.json").replace(b'_valid": false', b'_valid": true'),
        ],
        "water-linked-table": [samples.WATER_LINKED_TABLE],
        "rowe": [b"".join(rowe), head("recordings/rowe_boat_turns.ens")],
        "sbet": [smooth],
        "smrmsg": [np.ascontiguousarray(samples.deviations(300)).tobytes()],
        "rtklib": [pos],
    }


def guessed(path):
    """Return the mapping that is proposed for a table."""
    return parse_yaml(guess_all([path]), MappingSettings, source="guess")


def database():
    """Return a ROS 2 bag in SQLite, as recorders before definitions were stored wrote it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db3"
        tables = sqlite3.connect(path)
        tables.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        tables.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        topics = {}
        for topic, kind, seconds, data in logs.sea_trial():
            if topic not in topics:
                topics[topic] = len(topics) + 1
                row = (topics[topic], topic, kind.replace("/", "/msg/"), "cdr", "")
                tables.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
            row = (topics[topic], round(seconds * 1e9), data)
            tables.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        tables.commit()
        tables.close()
        return path.read_bytes()


def of_libraries():
    """Return files of the formats that libraries read: ending, and what makes the bytes."""
    return {
        "bag": [
            (".bag", lambda: logs.ros_1_bag(logs.sea_trial())),
            (".mcap", lambda: logs.mcap(logs.sea_trial(), 4000)),
            (".db3", database),
        ],
        "ardupilot": [(".bin", lambda: logs.ardupilot_log(logs.ardupilot_trial()))],
        "ulog": [(".ulg", lambda: logs.ulog(logs.ulog_trial()))],
        "nucleus": [(".nucleus", logs.nucleus_trial)],
        "tlog": [
            (".tlog", lambda: logs.telemetry_trial()),
            (".tlog", lambda: logs.telemetry_trial(gps=False)),
        ],
    }


OWN = [form.name for form in FORMATS if not form.module]
LIBRARIES = [form.name for form in FORMATS if form.module]


@cache
def files():
    """Return whole files, as (ending, bytes), by the names of the formats here."""
    return {name: [("", data) for data in all_ if data] for name, all_ in own_files().items()}


def limit(count):
    """Limit this process, which reads `count` inputs, in time and memory."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    seconds = int(STARTING + SLOWEST * count)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))


def damage(data, rng):
    """Return a part of the data with one to three faults; one in twenty is no such file at all."""
    if rng.random() < 0.05:
        return garbage(rng)
    data = bytearray(data)
    if rng.random() < 0.5 and len(data) > 2000:
        at = int(rng.integers(0, len(data) - 1000))
        data = data[at : at + int(rng.integers(500, len(data) - at))]
    for _ in range(int(rng.integers(1, 4))):
        kind = int(rng.integers(0, 8))
        size = max(len(data), 1)
        at = int(rng.integers(0, size))
        if kind == 0:
            for i in rng.integers(0, size, int(rng.integers(1, 200))):
                if i < len(data):
                    data[i] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = rng.bytes(int(rng.integers(1, 3000)))
        elif kind == 3:
            del data[at : at + int(rng.integers(1, 500))]
        elif kind == 4:
            data += data[: int(rng.integers(1, 20000))]
        elif kind == 5:
            data[at : at + 300] = bytes(
                [int(rng.choice([0, 0x7F, 0xA5, 0x80, 0xFF, 0x24, 0x7B, 0x0A]))]
            ) * int(rng.integers(1, 3000))
        elif kind == 6:
            long = int(rng.integers(1, 1 + size // 2))
            first, second = sorted(rng.integers(0, size, 2))
            second = max(second, first + long)
            parts = data[first : first + long], data[second : second + long]
            data[second : second + long], data[first : first + long] = parts
        else:
            for i in rng.integers(0, size, 20):
                if i < len(data):
                    data[i] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF]))
    return bytes(data[:LIMIT])


def garbage(rng):
    """Return nothing, bytes, or words and numbers as text."""
    kind = int(rng.integers(0, 4))
    if kind == 0:
        return b""
    if kind == 1:
        return rng.bytes(int(rng.integers(1, 5000)))
    words = ["time", "vx", "nan", "-1e999", "1", "2.5", "$GPGGA", *'{}[]":\0\n']
    between = [" ", ",", ";", "\t", "\n", "*"][int(rng.integers(0, 6))]
    text = between.join(rng.choice(words, int(rng.integers(1, 2000))))
    # As an editor on Windows saves it.
    return text.encode("utf-16" if kind == 3 else "utf-8")


def run(name, count, seed, *, whole=False):
    """Feed the reader of a format `count` inputs, the whole files first; or, `whole`, `import`.

    Returns
    -------
    dict
        The numbers `refused` and `useful`, with records; the `slowest`, s; and for readers of
        this package the largest traced memory of every twentieth, `most`, bytes.
    """
    (form,) = (form for form in FORMATS if form.name == name)
    if form.module:
        bases = [(ending, make()) for ending, make in of_libraries()[name]]
    else:
        bases = TABLES if name == "table" else files()[name]
    rng = np.random.default_rng([seed, *name.encode()])
    out = {"refused": 0, "useful": 0, "slowest": 0.0, "most": 0}
    with tempfile.TemporaryDirectory() as folder:
        for index in range(count):
            ending, base = bases[index % len(bases)]
            data = damage(base, rng) if index >= len(bases) else base
            path = Path(folder) / f"log{ending}"
            path.write_bytes(data)
            # Not the first one, for which modules are loaded.
            is_measured = not form.module and index % 20 == 19
            start = time.process_time()
            if is_measured:
                tracemalloc.start()
            try:
                mapping = guessed(path) if name == "table" else None
                if whole:
                    import_files([path], Path(folder) / "trial", mapping=mapping, force=True)
                    out["useful"] += 1
                else:
                    form.share(path, data)
                    plain = None if mapping is None else msgspec.to_builtins(mapping)
                    batches = [len(batch.records) > 0 for batch in form.read(path, plain)]
                    out["useful"] += any(batches)
            except (ConfigError, DataError):
                # With which a command ends with exit code 2.
                out["refused"] += 1
            if is_measured:
                out["most"] = max(out["most"], tracemalloc.get_traced_memory()[1])
                tracemalloc.stop()
            else:
                out["slowest"] = max(out["slowest"], time.process_time() - start)
            assert index >= len(bases) or out["useful"] == index + 1, f"{name} {index} as written"
    return out


def main():
    args = [arg for arg in sys.argv[1:] if arg != "--import"]
    count, seed = int(args[0]), int(args[1]) if len(args) > 1 else 0
    warnings.simplefilter("error")
    for name in args[2].split(",") if len(args) > 2 else OWN:
        if name in LIBRARIES:
            limit(count)
        found = run(name, count, seed, whole="--import" in sys.argv)
        print(
            f"{name:13} {count} inputs, {found['refused']} refused, {found['useful']} with "
            f"records, slowest {found['slowest'] * 1e3:.0f} ms, at most {found['most'] >> 10} kB",
            flush=True,
        )


if __name__ == "__main__":
    main()
