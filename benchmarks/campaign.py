"""Measure campaigns: workers that are killed, a mount that moved, recorded trials.

    python benchmarks/campaign.py [--trials N] [--seconds S] [--between S] [--single N]
                                  [--workers N] [--remount N] [--recorded FOLDER] [--out DIR]

writes `campaign-results.md` into out/benchmarks, or with `--out docs` that of the documentation.
Trials are simulated, some of them solved one after the other, and all of them by a campaign of
which a worker is killed every `--between` seconds. `--remount` trials have a mount that moved by
0.1 deg after the 23rd of 40. `--recorded` adds the campaign of the trials in a folder.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import mean
from time import perf_counter, sleep
from typing import Any

import common
import numpy as np
import psutil

from factorgraph_dvl.files.trial_folder import save_trial
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.scenario import Scenario

PAGE = "campaign-results.md"
# Step of the mount, and standard deviation of each angle between trials, deg; and the share of
# the trials before the step.
STEP = 0.1
BETWEEN_TRIALS = 0.03
BEFORE = 23 / 40
# Length of the scenario without its straight legs, s, and their number.
MANOEUVRES = 153.0
LEGS = 3
# Time between two looks at the processes, s: a solve takes longer.
LOOK = 0.2

Row = tuple[str, str]


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--trials", type=int, default=200, help="trials with kills (200)")
    parser.add_argument("--seconds", type=float, default=453.0, help="length of each (453)")
    parser.add_argument("--between", type=float, default=60.0, help="time between kills, s (60)")
    parser.add_argument("--single", type=int, default=20, help="trials solved alone (20)")
    parser.add_argument("--workers", type=int, default=2, help="number of workers (2)")
    parser.add_argument("--remount", type=int, default=40, help="trials with a remount (40)")
    parser.add_argument("--recorded", type=Path, help="folder of trials, such as recorded dives")
    args = common.parse(parser)
    lines = ["# Campaigns: measured\n", f"{args.origin}\n", f"- machine: {common.machine()}"]
    lines += [f"- trials: the scenario of Luo et al., {args.seconds:.0f} s each, IMU at 100 Hz"]
    with tempfile.TemporaryDirectory(prefix="factorgraph-dvl-campaign-") as name:
        for title, rows in sections(Path(name), args):
            lines += [f"\n## {title}\n", "| what | measured |", "|---|---|"]
            lines += ["| " + " | ".join(row) + " |" for row in rows]
            print(*lines[-len(rows) - 3 :], sep="\n", flush=True)
    common.write_page(args.out / PAGE, lines)


def sections(folder: Path, args: Any) -> Iterator[tuple[str, list[Row]]]:
    """Yield title and rows of what was measured."""
    if args.trials:
        title = f"Workers that are killed every {args.between:g} s"
        yield title, killed(folder / "killed", args)
    if args.remount:
        yield "A mount that moved", remount(folder / "remount", args)
    if args.recorded:
        trials = sorted(p for p in args.recorded.iterdir() if (p / "trial.yaml").exists())
        yield "Recorded trials", joint(folder / "recorded", trials, args.workers)


def scenario(name: str, seconds: float, turned_deg: Sequence[float] = (0.0, 0.0, 0.0)) -> Scenario:
    """Return the scenario with straight legs so long that it takes some seconds."""
    data = common.config("seed-a-phase-90", name=name)
    for each in data["manoeuvres"]:
        if "straight_s" in each:
            each["straight_s"] = (seconds - MANOEUVRES) / LEGS
    angles = np.add(data["dvl"]["misalignment_deg"], turned_deg)
    data["dvl"]["misalignment_deg"] = angles.tolist()
    return parse_scenario(data)


def killed(folder: Path, args: Any) -> list[Row]:
    """Measure a campaign of which workers are killed against trials one after the other."""
    trials = [folder / "trials" / f"{seed:04d}" for seed in range(args.trials)]
    for seed, path in enumerate(trials):
        save_trial(
            simulate(scenario(path.name, args.seconds), seed), path, parquet=True, seed=seed
        )
    single = []
    for path in trials[: args.single]:
        start = perf_counter()
        solve = ["solve", str(path), "--out", str(folder / "single" / path.name), "--quiet"]
        subprocess.run(command(*solve), check=True, stdout=subprocess.DEVNULL)
        single.append(perf_counter() - start)
    start = perf_counter()
    content, kills, starts = campaign(folder, trials, args.workers, args.between)
    wall = perf_counter() - start
    solved = [t for t in content["trials"] if t["solved"]]
    start = perf_counter()
    _, _, again = campaign(folder, trials, args.workers, np.inf)
    ideal = args.trials * mean(single) / args.workers
    largest = max(t["peak_bytes"] for t in solved) / 2**20
    return [
        ("trials solved", f"{len(solved)} of {args.trials}"),
        ("workers killed while they solved", f"{kills}"),
        ("solves started, at most one more for each kill", f"{starts}"),
        (f"single solve on one core, mean of {len(single)}", f"{mean(single):.2f} s"),
        ("processor time of a trial", f"{mean(t['cpu_s'] for t in solved):.2f} s"),
        ("largest memory of a trial", f"{largest:.0f} MiB"),
        ("campaign", f"{wall:.0f} s"),
        ("**over trials times single solve over workers**", f"{wall / ideal:.2f}"),
        (
            "the same campaign again: solves started, time",
            f"{again}, {perf_counter() - start:.1f} s",
        ),
    ]


def remount(folder: Path, args: Any) -> list[Row]:
    """Measure whether a campaign finds a mount that moved."""
    rng = np.random.default_rng(0)
    trials = [folder / "trials" / f"{seed:04d}" for seed in range(args.remount)]
    last = round(BEFORE * args.remount) - 1
    for seed, path in enumerate(trials):
        turned = BETWEEN_TRIALS * rng.standard_normal(3)
        turned[2] += STEP * (seed > last)
        save_trial(
            simulate(scenario(path.name, args.seconds, turned), seed),
            path,
            parquet=True,
            seed=seed,
        )
    content, _, _ = campaign(folder, trials, args.workers, np.inf)
    rows = [
        ("trials", f"{args.remount}"),
        ("simulated", f"misalignment_z by {STEP:g} deg after the trial {trials[last].name}"),
    ]
    rows += [
        (
            "found",
            f"{c['parameter']} by {c['step']:.3f} ± {c['std']:.3f} deg after the trial "
            f"{c['after']}, p = {c['p']:.1g}",
        )
        for c in content["changes"]
    ]
    return [*rows, *spread(content)]


def joint(folder: Path, trials: Sequence[Path], workers: int) -> list[Row]:
    """Measure the joint calibration of some trials."""
    content, _, _ = campaign(folder, trials, workers, np.inf)
    rows = [("trials", ", ".join(t["name"] for t in content["trials"]))]
    rows += [("used", f"{sum(t['used'] for t in content['trials'])}")]
    rows += [
        (name, ", ".join(f"{v:.4g} ± {s:.2g}" for v, s in zip(p["value"], p["std"], strict=True)))
        for name, p in content["joint"]["parameters"].items()
    ]
    return [*rows, *spread(content)]


def spread(content: dict[str, Any]) -> list[Row]:
    """Return the variation between trials, and whether the trials fit together with it."""
    chi = content["chi_square"]
    rows = [
        (f"between trials, {name}", f"{std:.2g} (p = {content['between_trials_p'][name]:.1g})")
        for name, std in content["between_trials_std"].items()
        if std > 0.0
    ]
    text = f"{chi['statistic']:.1f}, {chi['freedom']:.1f} expected, p = {chi['p']:.3g}"
    return [*rows, ("**χ² of all trials with this variation**", text)]


def campaign(
    folder: Path, trials: Sequence[Path], workers: int, between: float
) -> tuple[dict[str, Any], int, int]:
    """Run a campaign; return its result, and how many workers were killed and solves started."""
    out = folder / "campaign"
    folder.mkdir(exist_ok=True)
    with open(folder / "log", "w", encoding="utf-8") as log:
        run = command("campaign", *map(str, trials), "--out", str(out), "--workers", str(workers))
        process = subprocess.Popen(run, stdout=log, stderr=log)
        kills, starts = watched(process, between)
    if process.returncode != 0:
        raise SystemExit((folder / "log").read_text())
    return json.loads((out / "campaign.json").read_text()), kills, starts


def watched(process: subprocess.Popen[bytes], between: float) -> tuple[int, int]:
    """Kill a worker that is solving every so often; return how many, and the solves that ran."""
    kills, since = 0, perf_counter()
    seen: set[tuple[int, float]] = set()
    while process.poll() is None:
        sleep(LOOK)
        solving = []
        with suppress(psutil.NoSuchProcess):
            for child in psutil.Process(process.pid).children(recursive=True):
                with suppress(psutil.NoSuchProcess):
                    if "solve" in child.cmdline():
                        seen.add((child.pid, child.create_time()))
                        solving.append(child.ppid())
        if solving and perf_counter() - since > between:
            os.kill(random.choice(solving), signal.SIGKILL)
            kills, since = kills + 1, perf_counter()
    return kills, len(seen)


def command(*args: str) -> list[str]:
    return [sys.executable, "-m", "factorgraph_dvl.cli", *args]


if __name__ == "__main__":
    main()
