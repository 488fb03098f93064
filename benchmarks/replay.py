"""Measure what an update of the replay costs, and whether that and memory stay flat.

    python benchmarks/replay.py [--long] [--isam2] [--rate HZ] [--out DIR]

writes `replay.md` into out/benchmarks, or with `--out benchmarks` that of the repository. `--long`
adds a trial of 8 h, which takes some minutes and a gigabyte of memory to simulate; `--isam2` the
growth of full iSAM2.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from time import perf_counter, process_time

import common
import numpy as np
from common import config

from factorgraph_dvl.replay import Replay
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.scenario import Scenario
from factorgraph_dvl.trial import Trial

PAGE = "replay.md"
LONG = 8 * 3600.0
# Without a lag updates grow, and 4800 s of them would take hours.
GROWTH = 1200.0
# The cruise takes 80 minutes.
LONG_TIMES = 7


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--long", action="store_true", help="add 8 h")
    parser.add_argument("--isam2", action="store_true", help="add full iSAM2")
    parser.add_argument("--rate", type=float, default=5.0, help="states a second")
    args = common.parse(parser)
    machine = common.machine()
    trial = simulate(parse_scenario(config("cruise")), 1)
    duration = float(trial.imu.time[-1])
    lines = [
        "# Cost of an update of the replay\n",
        f"{args.origin}\n",
        f"- date: {date.today().isoformat()}",
        f"- machine at the start: {machine}",
        f"- states at {args.rate:g} Hz, lag 30 s",
        "- the state, the calibration and the trajectory of an update are computed when they are "
        "read, which is measured apart\n",
        "| what | median | 99 % | processor time, median | 99 % | last / first steady tenth, "
        "of both | state read | calibration | trajectory | batch solutions | memory |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    jobs = [("fixed lag", "fixed-lag", duration)]
    if args.isam2:
        jobs.append(("iSAM2", "isam2", GROWTH))
    if args.long:
        jobs.append(("fixed lag", "fixed-lag", LONG))
    for name, kind, seconds in jobs:
        if seconds > duration:
            trial = simulate(long_cruise(), 1)
        lines.append(measure(trial, f"{name}, {seconds:.0f} s", kind, seconds, args.rate))
        print(lines[-1], flush=True)
    common.write_page(args.out / PAGE, lines)


def long_cruise() -> Scenario:
    """Return the cruise with its manoeuvres over and over for 8 h."""
    data = config("cruise")
    data["manoeuvres"] = [{"repeat": LONG_TIMES, "manoeuvres": data["manoeuvres"]}]
    return parse_scenario(data)


def measure(trial: Trial, name: str, kind: str, seconds: float, rate: float) -> str:
    session = Replay(trial, smoother=kind, rate_hz=rate)
    latency, solved, memory, busy = [], [], [], []
    read: dict[str, list[float]] = {"state": [], "calibration": [], "trajectory": []}
    gc.collect()
    began = perf_counter()
    cpu = process_time()
    for updates in feed(session, trial, seconds, 1.0 / rate):
        for u in updates:
            latency.append(u.latency)
            solved.append(u.solved)
            if len(latency) % 5000 == 1:
                memory.append(resident())
        # The machine may be busy with something else: processor time tells what is ours.
        now = process_time()
        if len(updates) == 1 and not updates[0].solved:
            busy.append(1e3 * (now - cpu))
            for what, times in read.items():
                began_read = perf_counter()
                getattr(updates[0], what)
                times.append(1e3 * (perf_counter() - began_read))
        cpu = process_time()
    wall = perf_counter() - began
    plain = 1e3 * np.array(latency)[~np.array(solved)]
    tenth = plain.size // 10
    # The first tenth has the start in it; the second is the first steady one.
    ratio = np.median(plain[-tenth:]) / np.median(plain[tenth : 2 * tenth])
    tenth = len(busy) // 10
    steady = np.median(busy[-tenth:]) / np.median(busy[tenth : 2 * tenth])
    print(f"{name}: {seconds / wall:.1f} times real time")
    return (
        f"| {name} | {np.median(plain):.2f} ms | {np.percentile(plain, 99):.2f} ms "
        f"| {np.median(busy):.2f} ms | {np.percentile(busy, 99):.2f} ms "
        f"| {ratio:.2f}, {steady:.2f} "
        f"| {' | '.join(f'{np.median(times):.2f} ms' for times in read.values())} "
        f"| {sum(solved)}, the longest "
        f"{max(latency):.2f} s | {memory[1] if len(memory) > 1 else memory[0]} to "
        f"{memory[-1]} MiB |"
    )


def feed(session: Replay, trial: Trial, seconds: float, step: float) -> Iterator[list]:
    """Feed a trial in pieces of `step` seconds, and yield the updates."""
    imu = trial.imu
    now = 0.0
    while now < min(seconds, float(imu.time[-1])):
        end = now + step
        for aid in trial.aids:
            rows = slice(*np.searchsorted(aid.time, [now, end]))
            if rows.stop > rows.start:
                session.add(rows_of(aid, rows))
        a, b = np.searchsorted(imu.time, [now, end])
        yield session.add_imu(imu.time[a:b], imu.gyro[a:b], imu.accel[a:b])
        now = end
    yield session.finish()


def resident() -> int:
    """Return the memory that is in use now, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 2**20


if __name__ == "__main__":
    main()
