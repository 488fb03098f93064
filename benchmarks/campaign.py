"""Measure a campaign whose workers are killed: nothing lost, nothing solved twice, time.

    python benchmarks/campaign.py [--trials N] [--workers N] [--out DIR]

writes `campaign.md` into out/benchmarks, or with `--out benchmarks` that of the repository. Trials
of 450 s are simulated, twenty of them solved one after the other, and all of them by a campaign,
of which a worker is killed every minute.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from statistics import mean
from time import perf_counter, sleep
from typing import Any

import common
import psutil

from factorgraph_dvl.io.trial_folder import save_trial
from factorgraph_dvl.simulation import simulate

PAGE = "campaign.md"
SCENARIO = common.ROOT / "configs" / "seed-a-phase-90.yaml"
SINGLE = 20
# Time between two kills, s.
BETWEEN = 60.0


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--trials", type=int, default=200, help="number of trials (200)")
    parser.add_argument("--workers", type=int, default=2, help="number of workers (2)")
    args = common.parse(parser)
    machine = common.machine()
    with tempfile.TemporaryDirectory(prefix="factorgraph-dvl-campaign-") as name:
        rows = measured(Path(name), args.trials, args.workers)
    lines = [
        "# A campaign whose workers are killed\n",
        f"{args.origin}\n",
        f"- machine: {machine}\n",
    ]
    lines += ["| what | measured | limit |", "|---|---|---|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    print(common.write_page(args.out / PAGE, lines))


def measured(folder: Path, count: int, workers: int) -> list[tuple[str, str, str]]:
    trials = [folder / "trials" / f"{seed:04d}" for seed in range(count)]
    for seed, path in enumerate(trials):
        save_trial(simulate(SCENARIO, seed), path, parquet=True, seed=seed)
    single = []
    for path in trials[:SINGLE]:
        start = perf_counter()
        solve = ["solve", str(path), "--out", str(folder / "single" / path.name), "--quiet"]
        subprocess.run(command(*solve), check=True, stdout=subprocess.DEVNULL)
        single.append(perf_counter() - start)
    out = folder / "campaign"
    start = perf_counter()
    with open(folder / "log", "w", encoding="utf-8") as log:
        run = command("campaign", *map(str, trials), "--out", str(out), "--workers", str(workers))
        process = subprocess.Popen(run, stdout=log, stderr=log)
        kills = kill_workers(process)
    wall = perf_counter() - start
    assert process.returncode == 0, (folder / "log").read_text()
    content: dict[str, Any] = json.loads((out / "campaign.json").read_text())
    solved = [t for t in content["trials"] if t["solved"]]
    ideal = count * mean(single) / workers
    largest = max(t["peak_bytes"] for t in solved) / 2**20
    return [
        ("trials solved", f"{len(solved)} of {count}", f"{count}"),
        ("workers killed", f"{kills}", ""),
        (f"single solve, mean of {len(single)}", f"{mean(single):.2f} s", ""),
        ("processor time of a trial", f"{mean(t['cpu_s'] for t in solved):.2f} s", ""),
        ("largest memory of a trial", f"{largest:.0f} MiB", ""),
        ("campaign", f"{wall:.0f} s", ""),
        ("**over trials times single solve over workers**", f"{wall / ideal:.2f}", "1.25"),
    ]


def kill_workers(process: subprocess.Popen[bytes]) -> int:
    """Kill a worker that is solving every minute until the campaign ends; return how many."""
    kills, since = 0, perf_counter()
    while process.poll() is None:
        sleep(0.5)
        if perf_counter() - since < BETWEEN:
            continue
        solving = []
        for child in psutil.Process(process.pid).children(recursive=True):
            with suppress(psutil.NoSuchProcess):
                if "solve" in child.cmdline():
                    solving.append(child.ppid())
        if solving:
            os.kill(random.choice(solving), signal.SIGKILL)
            kills, since = kills + 1, perf_counter()
    return kills


def command(*args: str) -> list[str]:
    return [sys.executable, "-m", "factorgraph_dvl.cli", *args]


if __name__ == "__main__":
    main()
