"""Calibrate, then dead-reckon and dive: what a calibration is worth, over many seeds.

    python benchmarks/sea_trial.py [--seeds 20] [--jobs 2] [--out DIR]

writes `sea-trial.md` and its images into out/benchmarks, or with `--out docs` those of the
documentation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import common
import numpy as np
from common import config, rms

from factorgraph_dvl.analysis.dead_reckoning.before_after import BeforeAfter, before_after
from factorgraph_dvl.analysis.error_statistics import trajectory_errors
from factorgraph_dvl.baselines import sins
from factorgraph_dvl.files.earlier_calibration import calibrated_by
from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.attitude_history import AttitudeHistory
from factorgraph_dvl.report.figures.dead_reckoning import errors_figure, lever_arm_figure
from factorgraph_dvl.report.figures.drawing import save_figures
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Calibration, Solution
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

PAGE = "sea-trial.md"
# Luo et al. (2024), table 7: end point and largest error, % of distance.
PAPER_BEFORE, PAPER_AFTER = (7.95, 12.79), (0.087, 0.122)
ALIGN_S = 300.0
ATTITUDES = ("SINS/GNSS", f"SINS, {ALIGN_S:g} s of GNSS", "truth")
DIVES = {"GNSS ends": 1e5, "GNSS returns": None}
DEAD_RECKONINGS = ("SINS attitude", "smoothed attitude")
STRIDE = 10
SHORT_DIVES = 60


@dataclass(frozen=True)
class Transit:
    """Of one attitude source: errors in % of distance, and growth over straight stretches."""

    before: tuple[float, float]
    after: tuple[float, float]
    stretches: tuple[tuple[float, float], ...]
    counts: tuple[int, ...]
    lever_arm: tuple[float, float]


@dataclass(frozen=True)
class Dive:
    """Errors of the smoothed position and of dead reckoning over time, every second."""

    time: Array
    error: Array
    std: Array
    nees: float
    dead_reckoned: tuple[Array, ...]


@dataclass(frozen=True)
class Seed:
    """All of one seed."""

    transit: dict[str, Transit]
    dive: dict[str, Dive]


def calibrate(seed: int) -> Calibration:
    """Return the calibration from a cruise."""
    solution = solve(simulate(parse_scenario(config("cruise")), seed=seed))
    names = (n for n in Calibration.__dataclass_fields__)
    return Calibration(**{n: getattr(solution, n) for n in names})


def by_sins(trial: Trial, align_s: float | None = None) -> AttitudeHistory:
    """Return the attitude of a SINS that GNSS aids while it is there, or for some time."""
    motion, bias, _ = sins(trial, align_s=align_s)
    return AttitudeHistory(trial.imu, motion, trial.body_axes, bias)


def by_solution(trial: Trial, solution: Solution) -> AttitudeHistory:
    """Return the attitude of a solution."""
    bias = solution.estimate("gyro_bias_deg_h").value * DEG_PER_HOUR
    return AttitudeHistory(trial.imu, solution.trajectory, trial.body_axes, bias)


def transits(trial: Trial, calibration: Calibration) -> dict[str, BeforeAfter]:
    """Dead-reckon the transit by each source of attitude."""
    sources = (
        by_sins(trial),
        by_sins(trial, ALIGN_S),
        AttitudeHistory(trial.imu, trial.reference, trial.body_axes, np.zeros(3)),
    )
    return {
        name: before_after(trial, calibration.values, source.at)
        for name, source in zip(ATTITUDES, sources, strict=True)
    }


def summary(result: BeforeAfter) -> Transit:
    """Return the figures of merit of a dead reckoning."""

    def percents(run: object) -> tuple[float, float]:
        s = run.score  # type: ignore[attr-defined]
        return s.percent(float(s.horizontal[-1])), s.percent(float(s.horizontal.max()))

    straight = result.calibrated.score.stretches
    return Transit(
        before=percents(result.uncalibrated),
        after=percents(result.calibrated),
        stretches=tuple((s.median, s.largest) for s in straight),
        counts=tuple(s.count for s in straight),
        lever_arm=(result.lever_arm.largest, result.lever_arm.disagreement),
    )


def dive(seed: int, calibration: Calibration, outage_end: float | None) -> Dive:
    """Smooth a dive with the calibration as prior, and dead-reckon it."""
    data = config("dive")
    if outage_end is not None:
        data["gnss"]["outages_s"][-1][1] = outage_end  # type: ignore[index]
    trial = simulate(parse_scenario(data), seed=seed)
    assert trial.dvl is not None
    dvl = calibrated_by(trial.dvl, calibration, trial.body_axes, "the cruise")
    trial = replace(trial, dvl=dvl)
    solution = solve(trial)
    assert solution.converged
    errors = trajectory_errors(solution, trial.reference)
    tracks = []
    for source in (by_sins(trial), by_solution(trial, solution)):
        score = before_after(trial, calibration.values, source.at).calibrated.score
        at = np.interp(errors.time[::STRIDE], score.time, score.horizontal)
        tracks.append(at)
    return Dive(
        errors.time[::STRIDE],
        errors.position.error[::STRIDE],
        errors.position.std[::STRIDE],
        float(errors.position.nees.mean()),
        tuple(tracks),
    )


def short_dives(calibration: Calibration) -> float:
    """Return RMS(error / σ) of the height at the end of dives that are minutes long.

    The error of the height is one number a dive, that of the sea surface, so 20 dives
    leave much of its share within 2σ to chance.
    """
    data = config("dive")
    data["manoeuvres"] = [*data["manoeuvres"][:7], {"straight_s": 60}]  # type: ignore[index]
    data["gnss"]["outages_s"][-1][1] = 1e5  # type: ignore[index]
    data["dvl"].pop("no_lock_s")  # type: ignore[attr-defined]
    short = parse_scenario(data)
    normalised = []
    for seed in range(SHORT_DIVES):
        trial = simulate(short, seed=seed + 5000)
        dvl = calibrated_by(trial.dvl, calibration, trial.body_axes, "the cruise")
        position = trajectory_errors(solve(replace(trial, dvl=dvl)), trial.reference).position
        normalised.append(position.normalised[-1, 2])
    return rms(normalised)


def one_seed(seed: int) -> Seed:
    """Calibrate on a cruise, then dead-reckon a transit and smooth two dives."""
    calibration = calibrate(seed)
    # Other noise than that of the cruise.
    trial = simulate(parse_scenario(config("transit")), seed=seed + 1000)
    return Seed(
        {name: summary(r) for name, r in transits(trial, calibration).items()},
        {name: dive(seed + 2000, calibration, end) for name, end in DIVES.items()},
    )


def transit_table(seeds: Sequence[Seed]) -> list[str]:
    """Return the Markdown of the transit."""
    first = seeds[0].transit[ATTITUDES[0]]
    out = [
        "| attitude | end point before, % | largest before, % | end point after, % "
        "| largest after, % | worst seed: end point, largest, % |",
        "|---|---|---|---|---|---|",
        f"| paper, at sea | {PAPER_BEFORE[0]} | {PAPER_BEFORE[1]} | {PAPER_AFTER[0]} "
        f"| {PAPER_AFTER[1]} | |",
    ]
    for name in ATTITUDES:
        runs = [s.transit[name] for s in seeds]
        before = np.median([r.before for r in runs], axis=0)
        after = np.array([r.after for r in runs])
        median, worst = np.median(after, axis=0), after.max(axis=0)
        out.append(
            f"| {name} | {before[0]:.2f} | {before[1]:.2f} | **{median[0]:.4f}** "
            f"| **{median[1]:.4f}** | {worst[0]:.4f}, {worst[1]:.4f} |"
        )
    out += [
        "",
        "Growth of the error over straight stretches, after calibration, in % of their length: "
        "median over seeds of the median and of the largest stretch of a run.",
        "",
        "| attitude | "
        + " | ".join(
            f"{length} ({count} a run)"
            for length, count in zip(("1 km", "5 km", "10 km"), first.counts, strict=True)
        )
        + " |",
        "|---|---|---|---|",
    ]
    for name in ATTITUDES:
        grown = np.median([s.transit[name].stretches for s in seeds], axis=0)
        out.append(f"| {name} | " + " | ".join(f"{a:.4f}, {b:.4f}" for a, b in grown) + " |")
    jump, apart = np.max([s.transit[ATTITUDES[0]].lever_arm for s in seeds], axis=0)
    out += [
        "",
        f"The neglected lever arm moves the position by up to {jump:.2f} m. The difference of the "
        "tracks with and without it and the closed form (C(t) − C(0)) l agree to "
        f"{1e3 * apart:.1f} mm over all seeds; what is left is the trapezoidal rule's.",
    ]
    return out


def dive_table(seeds: Sequence[Seed]) -> list[str]:
    """Return the Markdown of the dives."""
    out = [
        "| | position error inside 2σ: east, north, up | mean NEES (3 expected) "
        "| RMS error / RMS σ, horizontal | RMS, m | dead reckoning with SINS attitude, RMS, m "
        "| with smoothed attitude | ratio | seeds in which at least 2 |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in DIVES:
        runs = [s.dive[name] for s in seeds]
        inside = np.mean([(np.abs(r.error) <= 2.0 * r.std).mean(axis=0) for r in runs], axis=0)
        horizontal = [np.hypot(r.error[:, 0], r.error[:, 1]) for r in runs]
        claimed = rms([np.hypot(r.std[:, 0], r.std[:, 1]) for r in runs])
        smoothed = rms(horizontal)
        reckoned = [rms([r.dead_reckoned[i] for r in runs]) for i in range(2)]
        each = [rms(r.dead_reckoned[0]) / rms(h) for r, h in zip(runs, horizontal, strict=True)]
        out.append(
            f"| {name} | {', '.join(f'{100 * x:.1f} %' for x in inside)}; "
            f"all {100 * inside.mean():.1f} % | {np.mean([r.nees for r in runs]):.2f} "
            f"| {smoothed / claimed:.2f} | {smoothed:.3f} | {reckoned[0]:.2f} | {reckoned[1]:.2f} "
            f"| {reckoned[0] / smoothed:.1f} | {sum(x >= 2.0 for x in each)} of {len(each)} |"
        )
    return out


def draw(seeds: Sequence[Seed], path: Path) -> None:
    """Draw RMS errors over seeds against the standard deviation that was claimed."""
    figure = common.new_figure(11, 4.2)
    for ax, name in zip(figure.subplots(1, len(DIVES), sharey=True), DIVES, strict=True):
        runs = [s.dive[name] for s in seeds]
        minutes = runs[0].time / 60.0
        error = np.sqrt(np.mean([(r.error[:, :2] ** 2).sum(axis=1) for r in runs], axis=0))
        std = np.sqrt(np.mean([(r.std[:, :2] ** 2).sum(axis=1) for r in runs], axis=0))
        for i, (label, color) in enumerate(zip(DEAD_RECKONINGS, ("#c2571a", "0.55"), strict=True)):
            reckoned = np.sqrt(np.mean([r.dead_reckoned[i] ** 2 for r in runs], axis=0))
            ax.plot(minutes, reckoned, color=color, lw=1.2, label=f"dead reckoning, {label}")
        ax.plot(minutes, error, color="#0b6cc0", lw=1.4, label="smoothed")
        ax.plot(minutes, std, color="k", lw=1.0, ls="--", label="σ of smoothed, as claimed")
        ax.set_yscale("log")
        ax.set_title(name, loc="left")
        ax.set_xlabel("time, min")
        ax.grid(color="0.92")
        ax.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel(f"horizontal error, RMS of {len(seeds)} seeds, m")
    figure.axes[0].legend(fontsize=8)
    common.save_figure(figure, path)


INTRODUCTION = """\
# What a calibration is worth: dead reckoning and dives

{origin}

Each seed calibrates a DVL on an 80-minute cruise, and then uses the calibration with other noise.
The scenario is `configs/cruise.yaml`: α = [1.68 2.10 16.45]°, l = [−0.93 1.12 −0.34] m and δK =
0.0177, the values that Luo et al. (2024) found at sea. The IMU is of navigation grade, and the DVL
noise is 0.2 % of speed. Everything is simulated, so effects that the model leaves out, such as the
speed of sound, are not included.

## Dead reckoning: {minutes:.0f} s and {km:.1f} km

`configs/transit.yaml`: legs of 10 and 5 km with a turn by 180° between, and two shorter ones.
`factorgraph-dvl deadreckon` integrates the DVL's velocity. The start is fitted to the GNSS fixes
of the first minute, which keeps the error of a single fix out of the comparison. Errors are
horizontal, in % of the whole distance: at the end, and the largest on the way; medians over
{seeds} seeds. *Before* is the mounting that trial.yaml states: aligned with the body, no scale
error, no lever arm.

The attitude is as important as the calibration. The table has three sources: a SINS/GNSS filter
and smoother with GNSS throughout, the same filter with GNSS during the first {align:.0f} s only
(as before a dive), and the truth.
"""


def main() -> None:
    """Run the study and write its page."""
    args = common.parse(common.parser(__doc__, seeds=20))
    seeds = []
    with common.pool(args.jobs) as pool:
        for seed in pool.map(one_seed, range(args.seeds)):
            seeds.append(seed)
            print(len(seeds), seed.transit[ATTITUDES[0]].after, flush=True)
    print(write_study(seeds, args.out, args.origin))


def write_study(seeds: Sequence[Seed], out: Path, origin: str) -> str:
    """Write the page and its images; return its text."""
    images = out / "images"
    images.mkdir(parents=True, exist_ok=True)
    trial = simulate(parse_scenario(config("transit")), seed=1000)
    calibration = calibrate(0)
    shown = before_after(trial, calibration.values, by_sins(trial).at)
    track = shown.calibrated.score
    figures = {
        "sea-trial-errors": errors_figure(track, shown.uncalibrated.score),
        "sea-trial-lever-arm": lever_arm_figure(shown),
    }
    save_figures(figures, images)
    draw(seeds, images / "sea-trial-dive.png")
    page = INTRODUCTION.format(
        origin=origin,
        seeds=len(seeds),
        minutes=np.ptp(track.time),
        km=track.path.total / 1e3,
        align=ALIGN_S,
    ).splitlines()
    page += [
        "",
        *transit_table(seeds),
        "",
        "Seed 0, attitude from SINS/GNSS:",
        "",
        "![Errors over distance, before and after calibration](images/sea-trial-errors.png)",
        "",
        "![What the lever arm does in turns](images/sea-trial-lever-arm.png)",
        "",
        "## Dives",
        "",
        "`configs/dive.yaml`: 305 s at the surface with GNSS (0.5 m, 0.05 m/s), an hour of survey "
        "at 50 m depth without, 120 s of it without bottom lock, then up. `factorgraph-dvl solve` "
        "with `dvl.calibration`, in two versions: GNSS returns at the surface, or does not. Dead "
        "reckoning starts where the fixes of the first minute put it, with the attitude of the "
        "SINS that GNSS aided while it was there, or with that of the smoothed solution. Errors "
        "are horizontal, over all epochs of all seeds; the ratio is that to dead reckoning with "
        "the attitude of the SINS.",
        "",
        *dive_table(seeds),
        "",
        "The error of the height is nearly one number a dive, that of the sea surface, so its "
        f"share is that of {len(seeds)} draws. Over {SHORT_DIVES} dives of minutes "
        f"RMS(error / σ) of the height at the end is {short_dives(calibration):.2f}.",
        "",
        "![Error and claimed standard deviation over the dive](images/sea-trial-dive.png)",
    ]
    page += common.sample_section(seed_table(seeds[0]))
    return common.write_page(out / PAGE, page)


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    return seed_table(one_seed(common.SAMPLED_SEED))


def seed_table(seed: Seed) -> list[str]:
    """Return the Markdown of one seed: dead reckoning by attitude, and the dives."""
    return [
        "| what | measured |",
        "|---|---|",
        *(
            f"| dead reckoning, {name}: end point, largest, % | {run.after[0]:.4f}, "
            f"{run.after[1]:.4f} |"
            for name, run in seed.transit.items()
        ),
        *(
            f"| dive, {name}: RMS of east and north errors, m; NEES | "
            f"{rms(run.error[:, :2]):.3f}; {run.nees:.2f} |"
            for name, run in seed.dive.items()
        ),
    ]


if __name__ == "__main__":
    main()
