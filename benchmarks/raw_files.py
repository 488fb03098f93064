"""Measure what `import` takes for large raw files: memory must not grow with them.

    python benchmarks/raw_files.py [--size GB ...] [--format NAME ...] [--out DIR]

writes `raw_files.md` into out/benchmarks, or with `--out benchmarks` that of the repository. Each
file repeats whole records of 0.1 s to 1 s with new times and checksums, and is deleted at once. It
stands in the folder of temporary files, which needs four times the largest size.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable
from datetime import UTC, date, datetime
from pathlib import Path
from time import perf_counter

import common
import numpy as np
from common import ROOT
from run import run_python

sys.path.append(str(ROOT / "tests"))
import format_writers as writers

PAGE = "raw_files.md"
GB = 10**9
# In GB, each four times the one before: what takes each reader a minute at most.
SIZES = {"pd0": (0.25, 1.0), "ad2cp": (0.02, 0.08), "nmea": (0.02, 0.08), "csv": (0.25, 1.0)}
START = datetime(2021, 3, 4, 5, 6, 7, tzinfo=UTC)
# Records that are made at a time.
PART = 20_000
# The largest memory that a process counts for itself: what `wait` reports is at least that of the
# process that started it.
IMPORT = """
import atexit, runpy
status = lambda: print(*(x for x in open("/proc/self/status") if x.startswith("VmHWM")))
atexit.register(status)
runpy.run_module("factorgraph_dvl.cli", run_name="__main__")
"""
MAPPING = """tables:
  - file: "*"
    kind: imu
    time: {column: time_s, clock: utc}
    axes: FRD
    columns: {gyro_x: 2, gyro_y: 3, gyro_z: 4, accel_x: 5, accel_y: 6, accel_z: 7}
"""


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--size", type=float, action="append", help="in GB")
    parser.add_argument("--format", choices=list(MAKERS), action="append", help="of these (all)")
    args = common.parse(parser)
    lines = [
        "# Import of large files\n",
        f"{args.origin}\n",
        f"- date: {date.today().isoformat()}",
        f"- machine at the start: {common.machine()}\n",
        "| format | file, GB | records | most memory, MB | processor time, s | wall time, s |",
        "|---|---|---|---|---|---|",
    ]
    for name in args.format or MAKERS:
        for size in args.size or SIZES[name]:
            row = measured(name, round(size * GB))
            print(row, flush=True)
            lines.append(row)
    common.write_page(args.out / PAGE, lines)
    print(f"\nwrote {args.out / PAGE}")


def measured(name: str, size: int) -> str:
    """Return the row of one file, which is made and deleted here."""
    with tempfile.TemporaryDirectory(prefix="factorgraph-dvl-benchmark-") as folder:
        path, mapping = Path(folder) / f"log.{name}", Path(folder) / "mapping.yaml"
        mapping.write_text(MAPPING, encoding="utf-8")
        count = 0
        with path.open("wb") as file:
            if name == "csv":
                file.write(b"time_s,gx,gy,gz,ax,ay,az\n")
            while file.tell() < size:
                file.write(MAKERS[name](np.arange(count, count + PART)))
                count += PART
        written = path.stat().st_size
        more = ["--map", str(mapping)] if name == "csv" else []
        start = perf_counter()
        trial = str(Path(folder) / "trial")
        run, text = run_python("-c", IMPORT, "import", str(path), "--out", trial, "--quiet", *more)
        peak = int(re.search(r"VmHWM:\s*(\d+) kB", text)[1]) * 1024
        wall = perf_counter() - start
    cells = (name, f"{written / GB:.2f}", f"{count:,}", f"{peak / 1e6:.0f}")
    return "| " + " | ".join((*cells, f"{run.cpu:.0f}", f"{wall:.0f}")) + " |"


def pd0(number: np.ndarray) -> bytes:
    """Return ensembles of 1 s with bottom track, 30 cells and a fix of WinRiver."""
    cells = [(100, -200, 3, 1)] * 30
    parts = [
        writers.fixed_leader(frame=1, cells=30),
        writers.variable_leader(0, START),
        writers.bottom_track((0.1, -1.5, 0.0, 0.01), (20.0,) * 4),
        writers.water_profile(cells),
        writers.winriver_gga(0.4, "000000.00", 44.9, -66.9, 2, 9.3, -28.1),
    ]
    template = writers.pd0(parts)
    out = tiled(template, len(number))
    clock = calendar(number.astype(float))
    leader = template.index(parts[1])
    out[:, leader + 2 : leader + 4] = (number[:, None] >> [0, 8]) & 255
    out[:, leader + 4 : leader + 11] = clock % 100
    out[:, leader + 11] = (number >> 16) & 255
    out[:, leader + 58 : leader + 65] = clock % 100
    # The second of the day of the fix, `hhmmss`.
    text = template.index(b"000000.00")
    out[:, text : text + 6] = digits(clock[:, 3:6] @ [10000, 100, 1], 6)
    total = out[:, :-2].astype(np.int64).sum(axis=1) % 65536
    out[:, -2:] = (total[:, None] >> [0, 8]) & 255
    return out.tobytes()


def ad2cp(number: np.ndarray) -> bytes:
    """Return bottom track at 2 Hz."""
    record = writers.df20(START, (1.5, -0.25, 0.1, 0.1), (10.0,) * 4, (5,) * 4, frame=1)
    out = tiled(writers.ad2cp(0x17, record), len(number))
    clock = calendar(number * 0.5)
    out[:, 18:24] = clock[:, :6] - [1900, 1, 0, 0, 0, 0]
    out[:, 24:26] = (clock[:, 6:] * 100 >> [0, 8]) & 255
    for sum_at, first, stop in ((6, 10, out.shape[1]), (8, 0, 8)):
        words = np.ascontiguousarray(out[:, first:stop]).view("<u2").astype(np.int64)
        total = (words.sum(axis=1) + 0xB58C) & 0xFFFF
        out[:, sum_at : sum_at + 2] = (total[:, None] >> [0, 8]) & 255
    return out.tobytes()


def nmea(number: np.ndarray) -> bytes:
    """Return RMC, GGA and HDT at 1 Hz."""
    clock = calendar(number.astype(float))
    time = digits(clock[:, 3:6] @ [10000, 100, 1], 6)
    day = digits(clock[:, [2, 1, 0]] % 100 @ [10000, 100, 1], 6)
    minutes = digits(number % 1_000_000, 6)
    sentences = []
    for text in (
        "GPRMC,HHMMSS.00,A,4808.MMMMMM,N,01131.000000,E,2.916,0.0,DDMMYY,,,A",
        "GPGGA,HHMMSS.00,4808.MMMMMM,N,01131.000000,E,2,8,0.9,545.4,M,46.9,M,,",
        "GPHDT,123.4,T",
    ):
        out = tiled(writers.nmea(text), len(number))
        for mark, value in (("HHMMSS", time), ("DDMMYY", day), ("MMMMMM", minutes)):
            if mark in text:
                at = text.index(mark) + 1
                out[:, at : at + len(mark)] = value
        star = len(text) + 1
        total = np.bitwise_xor.reduce(out[:, 1:star], axis=1)
        letters = np.frombuffer(b"0123456789ABCDEF", np.uint8)
        out[:, star + 1], out[:, star + 2] = letters[total >> 4], letters[total & 15]
        sentences.append(out)
    return np.concatenate(sentences, axis=1).tobytes()


def csv(number: np.ndarray) -> bytes:
    """Return an IMU at 100 Hz."""
    row = b"0000000000.00,+1.000000e-04,-2.000000e-04,+3.000000e-04,+1.0e-02,-2.0e-02,-9.81e+00\n"
    out = tiled(row, len(number))
    hundredths = round(START.timestamp()) * 100 + number
    out[:, :10], out[:, 11:13] = digits(hundredths // 100, 10), digits(hundredths % 100, 2)
    return out.tobytes()


def tiled(template: bytes, count: int) -> np.ndarray:
    return np.tile(np.frombuffer(template, np.uint8), (count, 1))


def digits(values: np.ndarray, width: int) -> np.ndarray:
    """Return decimal digits (N, width) as text."""
    return values[:, None] // 10 ** np.arange(width - 1, -1, -1) % 10 + ord("0")


def calendar(seconds: np.ndarray) -> np.ndarray:
    """Return year, month, day, hour, minute, second and hundredths (N, 7) since the start."""
    hundredths = np.round(seconds * 100).astype("timedelta64[ms]") * 10
    time = np.datetime64(START.replace(tzinfo=None), "ms") + hundredths
    months = time.astype("datetime64[M]")
    day = time.astype("datetime64[D]")
    left = (time - day).astype(np.int64) // 10
    second = left // 100
    date_parts = (
        months.astype(int) // 12 + 1970,
        months.astype(int) % 12 + 1,
        (day - months).astype(int) + 1,
    )
    return np.stack(
        [*date_parts, second // 3600, second // 60 % 60, second % 60, left % 100], axis=1
    )


MAKERS: dict[str, Callable[[np.ndarray], bytes]] = {
    "pd0": pd0,
    "ad2cp": ad2cp,
    "nmea": nmea,
    "csv": csv,
}


if __name__ == "__main__":
    main()
