"""Honest trials: whether the solver settles, what it says of them, and its steps.

    python benchmarks/honest.py [--seeds 15] [--jobs 2] [--only REGEX] [--out DIR]

writes `honest.md` into out/benchmarks, or with `--out docs` that of the documentation. Runs that
are done are kept in `honest.jsonl` beside it, for the same commit.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from typing import Any

import common
import numpy as np

from factorgraph_dvl.analysis.error_statistics import nees_band
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve

PAGE = "honest.md"
# Scenarios of configs/ whose trials have a DVL to calibrate.
SCENARIOS = (
    "data-sheet-mix-navigation", "data-sheet-mix-tactical", "data-sheet-mix-mems",
    "seed-a-phase-0", "seed-a-phase-90", "seed-a-star", "dive", "dive-stars",
    "luo-2024-turning", "luo-2024-accelerating", "luo-2024-steady", "beams-turntable",
    "cruise", "cruise-mems", "ship", "ship-water",
)  # fmt: skip
INTRODUCTION = """\
# Honest trials

{origin}

Simulated trials of the shipped scenarios, without a fault. A false reason is any reason of the
verdict but `uncertain` and `heading_unknown`, which say that a manoeuvre is missing. NEES/7 is
that of misalignment, scale and lever arm: 1 on average where standard deviations are right.

| scenario | runs | not converged | good, doubtful, do not use | false reasons | NEES/7 \
| steps: mean, most | objective rises | CPU, s |
|---|---:|---:|---|---|---:|---|---:|---:|
"""
# What an honest trial may be told: that it lacks a manoeuvre. Without a turn it has no heading.
HONEST = {"uncertain", "heading_unknown"}


def outcome(scenario: str, seed: int) -> dict[str, Any]:
    """Solve one trial; return what became of it."""
    trial = simulate(parse_scenario(common.config(scenario)), seed)
    start = time.process_time()
    solution = solve(trial, rate_hz=1.0)
    cpu = time.process_time() - start
    return {
        "scenario": scenario,
        "seed": seed,
        "cpu_s": round(cpu, 1),
        "converged": solution.converged,
        "grade": solution.verdict.grade,
        "reasons": [
            f"{r.code} {r.sensor} {r.parameter}".strip() for r in solution.verdict.reasons
        ],
        "nees": common.nees(solution, trial.calibration_truth),
        "steps": [step.change for step in solution.steps[1:]],
        "iterations": solution.iterations,
        "rises": common.rises(solution),
    }


def page(origin: str, runs: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the page."""
    out = INTRODUCTION.format(origin=origin).splitlines()
    for name in dict.fromkeys(r["scenario"] for r in runs):
        out.append(row(name, [r for r in runs if r["scenario"] == name]))
    out.append(row("all", runs))
    mix = [r["nees"] for r in runs if r["scenario"].startswith("data-sheet-mix")]
    if mix:
        low, high = nees_band(7, len(mix), 0.99)
        band = f"{low / 7:.2f}–{high / 7:.2f}"
        of_mix = f"Data-sheet mix, {len(mix)} runs: NEES/7 {np.mean(mix):.2f}"
        out += ["", f"{of_mix}; 99 % of right ones are within {band}."]
    return out


def row(name: str, runs: list[dict[str, Any]]) -> str:
    """Return the line of some runs."""
    grades = Counter(r["grade"] for r in runs)
    wrong = Counter(
        reason for r in runs for reason in r["reasons"] if reason.split()[0] not in HONEST
    )
    named = ", ".join(f"{reason} ({n})" for reason, n in wrong.most_common()) or "–"
    steps = [len(r["steps"]) for r in runs]
    nees = [r["nees"] for r in runs if np.isfinite(r["nees"])]
    return (
        f"| {name} | {len(runs)} | {sum(not r['converged'] for r in runs)} "
        f"| {grades['good']}, {grades['doubtful']}, {grades['do not use']} | {named} "
        f"| {f'{np.mean(nees):.2f}' if nees else '–'} | {np.mean(steps):.1f}, {max(steps)} "
        f"| {sum(r['rises'] for r in runs)} | {np.mean([r['cpu_s'] for r in runs]):.1f} |"
    )


def main() -> None:
    """Make the runs that are not kept, and write the page."""
    parser = common.parser(__doc__, seeds=15)
    parser.add_argument("--only", default="", help="regular expression of scenarios")
    args = common.parse(parser)
    wanted = [
        (name, seed)
        for seed in range(args.seeds)
        for name in SCENARIOS
        if re.search(args.only, name)
    ]
    runs = common.kept_runs(args, "honest.jsonl", wanted, outcome)
    runs.sort(key=lambda r: (SCENARIOS.index(r["scenario"]), r["seed"]))
    print(common.write_page(args.out / PAGE, page(args.origin, runs)))


if __name__ == "__main__":
    main()
