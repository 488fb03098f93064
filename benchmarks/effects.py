"""Errors as data sheets have them: one at a time, and all at once.

    python benchmarks/effects.py [--seeds 20] [--jobs 2] [--grade mems] [--only NAME] [--out DIR]

writes `effects.md` into out/benchmarks, or with `--out docs` that of the documentation. Runs that
are done are kept in `effects.jsonl` beside it, for the same commit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common
import msgspec
import numpy as np
from common import config

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    nees_band,
    trajectory_errors,
)
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.faults import (
    Fault,
    dvl_false_lock,
    dvl_outliers,
    filled,
    gnss_jumps,
    gnss_outliers,
    with_faults,
)
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

PAGE = "effects.md"
GRADES = ("navigation", "tactical", "mems")
SEVEN = (
    *(f"misalignment_{axis}_deg" for axis in "xyz"),
    "scale_error",
    *(f"lever_arm_{axis}_m" for axis in "xyz"),
)
# Straight legs, s: the trial then lasts ten minutes.
STRAIGHT_S = 150.0
# Change of a measurement, m/s or rad, from which on it is bad: less are its last digits.
MOVED = 1e-9
IMU_ERRORS = ("scale", "misalignment", "g_sensitivity")

Scenario = dict[str, Any]


@dataclass(frozen=True)
class Effect:
    """What is added to a trial without errors beside white noise.

    `change` alters a scenario, `fault` a trial; `bad` are the sections whose records then hold
    outliers.
    """

    change: Callable[[Scenario], None] = lambda _: None
    fault: Fault | None = None
    bad: str | None = None


def of(section: str, **keys: Any) -> Effect:
    """Return an effect that sets keys of a section."""
    return Effect(lambda scenario: scenario[section].update(keys))


def rough_imu(factor: float) -> Fault:
    """Return a fault that makes the noise of the IMU larger than stated by a factor."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        imu = trial.inertial
        more = np.sqrt((factor**2 - 1.0) / np.median(np.diff(imu.time)))
        gyro, accel = (
            x + more * root * rng.standard_normal(x.shape)
            for x, root in (
                (imu.gyro, imu.settings.gyro_noise_root_psd),
                (imu.accel, imu.settings.accel_noise_root_psd),
            )
        )
        return replace(trial, imu=replace(imu, gyro=gyro, accel=accel))

    return fault


def misstated(factor: float) -> Fault:
    """Return a fault that states the noise of GNSS and DVL larger by a factor than it is."""

    def fault(trial: Trial, rng: np.random.Generator) -> Trial:
        gnss, dvl = trial.gnss, trial.dvl
        assert gnss is not None
        assert dvl is not None
        stated = msgspec.structs.replace(
            dvl.settings,
            velocity_std_m_s=factor * dvl.settings.velocity_std_m_s,
            velocity_std_fraction=factor * dvl.settings.velocity_std_fraction,
        )
        fixes = replace(
            gnss,
            position_std=factor * gnss.position_std,
            velocity_std=factor * gnss.velocity_std,
        )
        return replace(trial, gnss=fixes, dvl=replace(dvl, settings=stated))

    return fault


EFFECTS: dict[str, Effect] = {
    "none": Effect(),
    "DVL bias 2 mm/s": of("dvl", bias_m_s=[0.002, 0, 0]),
    "antenna off by 5 cm": of("gnss", lever_arm_error_m=[0.05, 0, 0]),
    "antenna surveyed to 2 cm": of("gnss", lever_arm_error_m="draw", lever_arm_error_std_m=0.02),
    "GNSS correlated over 60 s, all of it": of(
        "gnss", correlated_share=0.99, correlation_time_s=60
    ),
    "GNSS correlated over 100 s, 70 %": of("gnss", correlated_share=0.7, correlation_time_s=100),
    "GNSS velocity correlated over 2 s, 50 %": of(
        "gnss", velocity_correlated_share=0.5, velocity_correlation_time_s=2
    ),
    "GNSS 20 ms late": of("gnss", time_offset_s=0.02),
    "DVL correlated over 5 s, 50 %": of("dvl", correlated_share=0.5, correlation_time_s=5),
    "IMU 10 ms late": of("imu", time_offset_s=0.01),
    "DVL scale drifts by 0.05 %": of("dvl", scale_drift=0.0005),
    "IMU axes 0.05°": of(
        "imu",
        gyro_misalignment_deg="draw",
        gyro_misalignment_std_deg=0.05,
        accel_misalignment_deg="draw",
        accel_misalignment_std_deg=0.05,
    ),
    "IMU scale 3000 ppm, stated 0": of("imu", gyro_scale_ppm=[3000, -3000, 3000]),
    "IMU noise three times the stated": Effect(fault=rough_imu(3.0)),
    "noise stated five times too large": Effect(fault=misstated(5.0)),
    "noise stated five times too small": Effect(fault=misstated(0.2)),
    "DVL outliers, 1 %": Effect(fault=dvl_outliers(0.01), bad="dvl"),
    "DVL zero pings, 0.1 %": Effect(fault=filled("dvl", 0.001), bad="dvl"),
    "DVL outliers, 10 %": Effect(fault=dvl_outliers(), bad="dvl"),
    "GNSS outliers, 10 %": Effect(fault=gnss_outliers(), bad="gnss"),
    "DVL false lock, 60 s of 0.3 m/s": Effect(fault=dvl_false_lock(), bad="dvl"),
    "GNSS jumps, 3 of 10 m for 30 s": Effect(fault=gnss_jumps(), bad="gnss"),
}
MIX = "all that data sheets have"
# Of which the same trial is solved a second time, with its noise stated as it is.
BOUNDED = ("none", MIX)


@dataclass(frozen=True)
class Run:
    """Of one seed: errors and σ of the seven, position inside 2σ, outliers, CPU seconds.

    `bound` are σ of the same trial whose noise is stated as it is.
    """

    error: list[float]
    std: list[float]
    bound: list[float] | None
    nees: float
    inside: list[float]
    named: float
    lost: float
    grade: str
    reasons: list[str]
    converged: bool
    cpu_s: float


def without_errors(scenario: Scenario) -> Scenario:
    """Return a scenario of the mix with white noise alone, on a trial of ten minutes."""
    out = json.loads(json.dumps(scenario))
    for key in list(out["imu"]):
        if any(word in key for word in (*IMU_ERRORS, "time_offset")):
            del out["imu"][key]
    for section in ("gnss", "dvl"):
        for key in list(out[section]):
            if any(
                word in key
                for word in ("correlat", "_error_m", "_error_std", "time_offset", "drift", "bias")
            ):
                del out[section][key]
    for manoeuvre in out["manoeuvres"]:
        if "straight_s" in manoeuvre:
            manoeuvre["straight_s"] = STRAIGHT_S
    return out


def with_known_noise(scenario: Scenario) -> Scenario:
    """Return a scenario whose trial states white and correlated noise as they are, as final.

    No estimate of noise adds to σ then: with the same parameters it is the Cramér-Rao bound.
    """
    gnss, claims = scenario["gnss"], scenario["trial"]
    position, velocity = np.array(gnss["position_std_m"]), np.array(gnss["velocity_std_m_s"])
    share = gnss.get("correlated_share", 0.0)
    velocity_share = gnss.get("velocity_correlated_share", 0.0)
    stated: Scenario = {
        "noise": "stated",
        "position_std_m": (np.sqrt(1.0 - share) * position).tolist(),
        "velocity_std_m_s": (np.sqrt(1.0 - velocity_share) * velocity).tolist(),
    }
    if share:
        stated["correlation_time_s"] = gnss["correlation_time_s"]
        stated["correlated_std_m"] = (np.sqrt(share) * position).tolist()
    if velocity_share:
        stated["velocity_correlation_time_s"] = gnss["velocity_correlation_time_s"]
        stated["correlated_velocity_std_m_s"] = (np.sqrt(velocity_share) * velocity).tolist()
    return scenario | {
        "trial": claims | {"gnss": stated, "dvl": claims["dvl"] | {"noise": "stated"}}
    }


def scenario_of(name: str, grade: str) -> Scenario:
    """Return the scenario of an effect."""
    scenario = config(f"data-sheet-mix-{grade}")
    if name != MIX:
        scenario = without_errors(scenario)
        EFFECTS[name].change(scenario)
    return scenario


def trial_of(name: str, grade: str, seed: int) -> tuple[Trial, Trial]:
    """Return a trial with an effect, and without what a fault adds."""
    clean = simulate(parse_scenario(scenario_of(name, grade)), seed)
    fault = EFFECTS[name].fault if name in EFFECTS else None
    return (clean if fault is None else with_faults(clean, [fault], seed)), clean


def bound_of(name: str, grade: str, seed: int) -> list[float]:
    """Return σ of the seven of the same trial whose noise is stated as it is."""
    known = with_known_noise(scenario_of(name, grade))
    solution = solve(simulate(parse_scenario(known), seed))
    own = [solution.order.index(n) for n in SEVEN]
    return np.sqrt(np.diag(solution.covariance)[own]).tolist()


def one(name: str, grade: str, seed: int) -> Run:
    """Solve a trial with an effect."""
    trial, clean = trial_of(name, grade, seed)
    start = time.process_time()
    solution = solve(trial)
    cpu = time.process_time() - start
    found = calibration_errors(solution, trial.calibration_truth)
    own = [found.names.index(n) for n in SEVEN]
    error, P = found.error[own], found.covariance[np.ix_(own, own)]
    assert trial.reference is not None
    position = trajectory_errors(solution, trial.reference).position.normalised
    known = np.isfinite(position).all(axis=1)
    inside = (np.abs(position[known]) < 2.0).mean(axis=0) if known.any() else np.full(3, np.nan)
    named, lost = outliers(trial, clean, EFFECTS.get(name, Effect()).bad, solution.rejected)
    return Run(
        error=error.tolist(),
        std=found.std[own].tolist(),
        bound=bound_of(name, grade, seed) if name in BOUNDED else None,
        nees=float(error @ np.linalg.solve(P, error)) / error.size,
        inside=inside.tolist(),
        named=named,
        lost=lost,
        grade=str(solution.verdict.grade),
        reasons=[str(r.code) for r in solution.verdict.reasons],
        converged=solution.converged,
        cpu_s=cpu,
    )


def outliers(
    trial: Trial, clean: Trial, section: str | None, rejected: Any
) -> tuple[float, float]:
    """Return the shares of bad measurements that were rejected, and of good ones."""
    labels = {"dvl": ("DVL velocity", "velocity"), "gnss": ("GNSS position", "geodetic")}
    bad_count = found = good_count = lost = 0
    for each, (label, field) in labels.items():
        record, before = getattr(trial, each), getattr(clean, each)
        # Heights are recomputed where nothing moves.
        change = (getattr(record, field) - getattr(before, field))[:, : 2 if each == "gnss" else 3]
        bad = np.abs(change).max(axis=1) > (MOVED if section else np.inf)
        out = np.isin(record.time, times_of(rejected, label))
        bad_count += int(bad.sum())
        found += int((bad & out).sum())
        good_count += int((~bad).sum())
        lost += int((~bad & out).sum())
    return (found / bad_count if bad_count else float("nan")), lost / good_count


def times_of(rejected: Any, label: str) -> np.ndarray:
    """Return the times of measurements of a kind that were rejected, s."""
    none = [np.empty(0)]
    return np.concatenate(none + [r.time for r in rejected if r.label == label])


def table(runs: dict[tuple[str, str], list[Run]], grade: str) -> list[str]:
    """Return the rows of a grade."""
    clean = runs.get((grade, "none"))
    lines = [
        f"## IMU of {grade} grade",
        "",
        "| error | runs | NEES/7 | RMS/σ, least and most | σ / bound | σ / σ without "
        "| RMS / RMS without "
        "| position inside 2σ, % | bad named, % | good lost, % | good, doubtful, do not use "
        "| CPU, s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in (*EFFECTS, MIX):
        if (grade, name) not in runs:
            continue
        own = runs[grade, name]
        error, std = (np.array([getattr(r, k) for r in own]) for k in ("error", "std"))
        ratio = np.sqrt(np.mean((error / std) ** 2, axis=0))
        wider = moved = "-"
        if clean and name != MIX:
            base_std = np.array([r.std for r in clean])
            base = np.sqrt(np.mean(np.array([r.error for r in clean]) ** 2, axis=0))
            wider = f"{np.median(std.mean(axis=0) / base_std.mean(axis=0)):.2f}"
            moved = f"{np.exp(np.mean(np.log(np.sqrt(np.mean(error**2, axis=0)) / base))):.2f}"
        grades = [sum(r.grade == g for r in own) for g in ("good", "doubtful", "do not use")]
        named = np.array([r.named for r in own])
        lines.append(
            f"| {name} | {len(own)} | {np.mean([r.nees for r in own]):.2f} "
            f"| {ratio.min():.2f}, {ratio.max():.2f} | {above_bound(own)} | {wider} | {moved} "
            f"| {percentages([r.inside for r in own])} "
            f"| {'-' if np.isnan(named).all() else f'{100 * np.nanmean(named):.1f}'} "
            f"| {100 * np.mean([r.lost for r in own]):.2f} | {', '.join(map(str, grades))} "
            f"| {np.mean([r.cpu_s for r in own]):.1f} |"
        )
    return lines


def above_bound(runs: list[Run]) -> str:
    """Return the largest ratio of σ to its bound, of the means of the seven over the runs."""
    ratios = [np.divide(run.std, run.bound) for run in runs if run.bound is not None]
    return f"{np.mean(ratios, axis=0).max():.2f}" if ratios else "-"


def percentages(inside: list[list[float]]) -> str:
    """Return means in per cent; none where a clock of the IMU is late, and with it the result."""
    mean = np.mean(inside, axis=0)
    return ", ".join(f"{100 * x:.0f}" for x in mean) if np.isfinite(mean).all() else "-"


def page(runs: dict[tuple[str, str], list[Run]], origin: str, seeds: int) -> list[str]:
    """Return the page."""
    low, high = nees_band(7, seeds, 0.997)
    lines = [
        "# Errors as data sheets have them",
        "",
        origin,
        "",
        "Each row adds one error to a trial of ten minutes with white noise (the motion of "
        "`configs/seed-a-phase-90.yaml` with longer straight legs). The last row is "
        "`configs/data-sheet-mix-*.yaml`: all errors at once, on 450 s. `solve` gets its defaults "
        "and does not know which error a trial has. The seven parameters are misalignment, scale "
        f"and lever arm. NEES/7 of {low / 7:.2f} to {high / 7:.2f} is chance for {seeds} runs "
        "(99.7 %) where σ states the errors exactly; below, σ is on the safe side. σ / bound is "
        "the ratio to σ of the same trial with `noise: stated`, and white and correlated noise "
        "stated as simulated: the mean over the runs, of the parameter with the largest.",
        "",
    ]
    for grade in GRADES:
        if any(g == grade for g, _ in runs):
            lines += [*table(runs, grade), ""]
    return lines


def main(argv: Sequence[str] | None = None) -> None:
    """Run what is not done yet, and write the page."""
    parser = common.parser(__doc__, seeds=20)
    parser.add_argument("--grade", action="append", choices=GRADES, help="of the IMU (all)")
    parser.add_argument("--only", action="append", choices=(*EFFECTS, MIX), help="error (all)")
    args = common.parse(parser, argv)
    kept = Path(args.out) / "effects.jsonl"
    code = common.commit()
    runs: dict[tuple[str, str, int], Run] = {}
    if kept.exists():
        for line in kept.read_text(encoding="utf-8").splitlines():
            item = json.loads(line)
            if item.pop("commit") == code:
                key = (item.pop("of"), item.pop("name"), item.pop("seed"))
                runs[key] = Run(**item)
    jobs = [
        (grade, name, seed)
        for seed in range(args.seeds)
        for grade in args.grade or GRADES
        for name in args.only or (*EFFECTS, MIX)
    ]
    with common.pool(args.jobs) as processes, kept.open("a", encoding="utf-8") as log:
        waiting = {
            processes.submit(one, name, grade, seed): (grade, name, seed)
            for grade, name, seed in jobs
            if (grade, name, seed) not in runs
        }
        for count, future in enumerate(as_completed(waiting), 1):
            grade, name, seed = waiting[future]
            run = runs[waiting[future]] = future.result()
            item = {"commit": code, "of": grade, "name": name, "seed": seed} | vars(run)
            log.write(json.dumps(item) + "\n")
            log.flush()
            print(f"{count}/{len(waiting)} {grade}, {name}, {seed}: NEES/7 {run.nees:.2f}")
    pooled: dict[tuple[str, str], list[Run]] = {}
    for (grade, name, seed), run in sorted(runs.items()):
        if seed < args.seeds:
            pooled.setdefault((grade, name), []).append(run)
    print(common.write_page(args.out / PAGE, page(pooled, args.origin, args.seeds)))


if __name__ == "__main__":
    main()
