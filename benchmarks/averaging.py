"""A DVL that averages, stated or not, in three motions and a mixed sea.

    python benchmarks/averaging.py [--seeds 20] [--jobs 2] [--only REGEX] [--out DIR]

writes `averaging-results.md` into out/benchmarks, or with `--out docs` that of the documentation.
Runs that are done are kept in `averaging.jsonl` beside it, for the same commit.
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

PAGE = "averaging-results.md"
WINDOWS_S = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
# Windows of the mix of errors, one of them a seed.
MIXED_S = (0.0, 0.2, 0.5, 1.0)
# Grades of the IMU that are tried with one window alone.
OTHERS, OTHERS_S = ("tactical", "mems"), 0.5
STATED = {"averaging_std_s": 0.0, "stamp": "middle"}
# Frequencies of swell and of sway, Hz: one of each a seed. Amplitudes are of roll and pitch, deg.
SWELL_HZ, SWAY_HZ = (0.12, 0.2), (0.25, 0.5)
AMPLITUDES_DEG = (4.0, 2.0)
LEG = {"straight_s": 50}
MOTIONS = {
    "lawn-mower": (
        {"accelerate_m_s2": 0.5, "to_m_s": 3},
        LEG, {"turn_deg_s": 6, "duration_s": 30},
        LEG, {"turn_deg_s": -6, "duration_s": 30},
        LEG, {"turn_deg_s": 6, "duration_s": 30},
        LEG, {"accelerate_m_s2": -0.5, "to_m_s": 0},
    ),
    "circles": (
        {"accelerate_m_s2": 0.5, "to_m_s": 3},
        {"turn_deg_s": 4, "duration_s": 180}, {"turn_deg_s": -4, "duration_s": 90},
        {"straight_s": 40}, {"accelerate_m_s2": -0.5, "to_m_s": 0},
    ),
    "harbour": (
        {"accelerate_m_s2": 0.3, "to_m_s": 1.5},
        {"straight_s": 40}, {"turn_deg_s": 9, "duration_s": 20},
        {"straight_s": 40}, {"accelerate_m_s2": -0.3, "to_m_s": 0}, {"stop_s": 20},
        {"accelerate_m_s2": 0.3, "to_m_s": 1.5},
        {"turn_deg_s": -9, "duration_s": 30}, {"straight_s": 60},
        {"turn_deg_s": 9, "duration_s": 10}, {"accelerate_m_s2": -0.3, "to_m_s": 0},
    ),
}  # fmt: skip
INTRODUCTION = """\
# A DVL that averages: measured

{origin}

A DVL averages over a window, in roll and pitch of 4° at one frequency of 0.12 to 0.2 Hz and 2° at
one of 0.25 to 0.5 Hz, others for each seed. NEES/7 is that of misalignment, scale and lever arm:
the mean of the runs that are graded good, and the mean of all. 99 % of right covariances have a
mean within the band.
σ is the largest of these seven over that of the same trial without a window, where both state it.
The window's errors are over their σ, where it was estimated.

| motion, grade of the IMU | window | statement | runs | good, doubtful, do not use \
| first reasons | NEES/7: good, all | band of the good | σ | window estimated | its errors, RMS |
|---|---|---|---:|---|---|---|---|---:|---:|---:|
"""


def plan_of(motion: str, grade: str, length: float, seed: int) -> dict[str, Any]:
    """Return the scenario of a motion in the sea of a seed."""
    mix = common.config(f"data-sheet-mix-{grade}")
    plan = mix if motion == "mix" else common.config("seed-a-phase-90")
    if motion != "mix":
        plan["manoeuvres"] = list(MOTIONS[motion])
        if grade != "navigation":
            # The clocks are one.
            plan["imu"] = {k: v for k, v in mix["imu"].items() if not k.startswith("time_offset")}
            plan["trial"].pop("imu")
    rng = np.random.default_rng([seed, 38])
    hertz = [rng.uniform(*each) for each in (SWELL_HZ, SWAY_HZ)]
    plan["sway"] = {
        axis: [
            {"amplitude_deg": a, "frequency_hz": f, "phase_deg": rng.uniform(0.0, 360.0)}
            for a, f in zip(AMPLITUDES_DEG, hertz, strict=True)
        ]
        for axis in ("roll", "pitch")
    }
    plan["dvl"]["averaging_s"] = length
    return plan


def outcome(motion: str, grade: str, length: float, stated: bool, seed: int) -> dict[str, Any]:
    """Solve one trial; return what became of it."""
    plan = plan_of(motion, grade, length, seed)
    if stated:
        plan["trial"]["dvl"] |= {"averaging_s": length, **STATED}
    trial = simulate(parse_scenario(plan), seed)
    start = time.process_time()
    solution = solve(trial, rate_hz=1.0)
    found = [e for e in solution.estimates if e.name == "averaging_s"]
    sigma = np.sqrt(np.diag(solution.covariance))
    own = [sigma[solution.order.index(name)] for name in common.SEVEN if name in solution.order]
    return {
        "cpu_s": round(time.process_time() - start, 1),
        "grade": solution.verdict.grade,
        "reasons": [f"{r.code} {r.sensor}".strip() for r in solution.verdict.reasons],
        "nees": common.nees(solution, trial.calibration_truth),
        "sigma": own,
        "window": [float((e.value[0] - length) / e.std[0]) for e in found],
    }


def line(of: tuple[str, ...], runs: list[dict[str, Any]], without: list[dict[str, Any]]) -> str:
    """Return the line of some runs; `without` are those of the same trials without a window."""
    grades = Counter(r["grade"] for r in runs)
    first = Counter(r["reasons"][0] for r in runs if r["reasons"])
    named = ", ".join(f"{reason} ({n})" for reason, n in first.most_common(3)) or "–"
    good = [r["nees"] for r in runs if r["grade"] == "good" and np.isfinite(r["nees"])]
    band, of_good = "–", "–"
    if good:
        low, high = nees_band(7, len(good), 0.99)
        band, of_good = f"{low / 7:.2f}–{high / 7:.2f}", f"{np.mean(good):.2f}"
    ratio = [
        max(np.divide(a["sigma"], b["sigma"])) for a, b in zip(runs, without, strict=False)
        if len(a["sigma"]) == len(b["sigma"]) == len(common.SEVEN)
    ]  # fmt: skip
    windows = [z for r in runs for z in r["window"]]
    return (
        f"| {' | '.join(of)} | {len(runs)} "
        f"| {grades['good']}, {grades['doubtful']}, {grades['do not use']} | {named} "
        f"| {of_good}, {np.nanmean([r['nees'] for r in runs]):.2f} | {band} "
        f"| {f'{np.mean(ratio):.2f}' if ratio else '–'} | {len(windows)} "
        f"| {f'{common.rms(windows):.2f}' if windows else '–'} |"
    )


def cases(seeds: int) -> list[tuple[str, str, float, bool, int]]:
    """Return all runs: motion, grade, window, whether it is stated, and seed."""
    out = []
    for seed in range(seeds):
        for motion in MOTIONS:
            for length in WINDOWS_S:
                out += [(motion, "navigation", length, stated, seed) for stated in (True, False)]
            out += [(motion, grade, OTHERS_S, False, seed) for grade in OTHERS]
        length = MIXED_S[seed % len(MIXED_S)]
        out += [("mix", grade, length, False, seed) for grade in ("navigation", *OTHERS)]
    return out


def page(origin: str, runs: dict[tuple[Any, ...], dict[str, Any]]) -> list[str]:
    """Return the lines of the page."""
    out = INTRODUCTION.format(origin=origin).splitlines()
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for (motion, grade, length, stated, _), run in runs.items():
        of = (motion, grade, "drawn" if motion == "mix" else length, stated)
        groups.setdefault(of, []).append(run)
    for (motion, grade, length, stated), own in sorted(groups.items(), key=lambda g: str(g[0])):
        none = groups.get((motion, grade, 0.0, True), []) if stated else []
        window = f"{length:g} s" if motion != "mix" else str(length)
        of = f"{motion}, {grade}", window, "stated" if stated else "none"
        out.append(line(of, own, none))
    mix = [r for of, r in runs.items() if of[0] == "mix"]
    if mix:
        out += ["", f"The mix, {len(mix)} runs: NEES/7 {np.mean([r['nees'] for r in mix]):.2f}."]
    return out


def main() -> None:
    """Make the runs that are not kept, and write the page."""
    parser = common.parser(__doc__, seeds=20)
    parser.add_argument("--only", default="", help="regular expression of motions")
    args = common.parse(parser)
    wanted = [each for each in cases(args.seeds) if re.search(args.only, each[0])]
    runs = dict(
        zip(wanted, common.kept_runs(args, "averaging.jsonl", wanted, outcome), strict=True)
    )
    print(common.write_page(args.out / PAGE, page(args.origin, runs)))


if __name__ == "__main__":
    main()
