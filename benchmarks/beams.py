"""Measure what the calibration of single beams is worth.

    python benchmarks/beams.py [--seeds 20] [--jobs 1] [--out DIR]

writes `beams-results.md` into out/benchmarks, or with `--out docs` that of the documentation.
Takes about a minute for each seed on one core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from time import process_time
from typing import Any

import common
import numpy as np
from common import config

from factorgraph_dvl.analysis.beam_quality import calibration_of
from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    nees_band,
    trajectory_errors,
)
from factorgraph_dvl.baselines import calibrate
from factorgraph_dvl.geometry.earth import RATE, radii
from factorgraph_dvl.geometry.rotations import exp_so3, rotation_from_rph
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.units import DEG, DEG_PER_HOUR
from factorgraph_dvl.geometry.vectors import interpolate
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

PAGE = "beams-results.md"
CALIBRATIONS = {"turntable": "beams-turntable", "no turntable": "cruise-beams"}
OURS = ("beam_direction_b", "beam_scale_error", "lever_arm_m")
WIDE = (10.0, 10.0, 10.0)
# What a calibration leaves open, for the navigation with lost beams.
DIRECTION_STD_DEG, SCALE_STD, ARM_STD_M = 0.006, 0.00025, 0.002
NAVIGATION_S, GNSS_S = 600.0, 60.0
# Seeds that are calibrated without a turntable as well.
HULL_SEEDS = 6
ROUNDS = 3

Array = np.ndarray


@dataclass(frozen=True)
class Errors:
    """Normalised errors of the beams' parameters, their NEES, and the largest σ, deg."""

    z: Array
    nees: float
    largest_std: float
    largest_error: float


@dataclass(frozen=True)
class Seed:
    """What one seed says: calibrations by name, dead reckoning by calibration and DVL."""

    batch: Errors
    kalman: Errors
    reckoning: dict[tuple[str, str], tuple[float, float]]
    misfit: float


def errors_of(solution: Solution, trial: Trial) -> Errors:
    found = calibration_errors(solution, trial.calibration_truth)
    names = [n for e in solution.estimates if e.name in OURS for n in e.component_names]
    rows = [found.names.index(n) for n in names]
    P = found.covariance[np.ix_(rows, rows)]
    std = np.sqrt(np.diag(P))
    z = found.error[rows] / std
    is_angle = [n.startswith("beam_direction") for n in names]
    return Errors(
        z,
        float(z @ np.linalg.solve(P / np.outer(std, std), z)),
        float(std[is_angle].max()),
        float(np.abs(found.error[rows][is_angle]).max()),
    )


def one_seed(seed: int) -> Seed:
    """Calibrate with and without a turntable, and dead reckon another cruise with each."""
    reckoning: dict[tuple[str, str], tuple[float, float]] = {}
    found: dict[str, Any] = {}
    for place, name in CALIBRATIONS.items():
        if place == "no turntable" and seed >= HULL_SEEDS:
            continue
        trial = simulate(parse_scenario(config(name)), seed)
        beams = trial.beams
        assert beams is not None
        missions = {
            "all beams": mission(trial, seed, 0.0),
            "each beam lost in 10 % of pings": mission(trial, seed, 0.1),
        }
        solution = solve(trial)
        own = calibration_of(beams, solution)
        seven, nine = (solve(as_instrument(trial, scales)) for scales in (1, 3))
        exact = (
            trial.calibration_truth["beam_direction_b"],
            trial.calibration_truth["beam_scale_error"],
            trial.calibration_truth["lever_arm_m"],
        )
        if place == "turntable":
            found["batch"] = errors_of(solution, trial)
            found["kalman"] = errors_of(calibrate(trial, "beams")[0], trial)
            r = next(r for r in seven.residuals if r.label == "DVL velocity")
            found["misfit"] = float(np.sqrt(np.mean((r.residual / r.sigma) ** 2)))
        ways: dict[str, Callable[[Trial], tuple[Array, Array]]] = {
            "none": lambda t: by_instrument(t, None),
            "seven parameters": partial(by_instrument, solution=seven),
            "nine parameters (a scale per axis)": partial(by_instrument, solution=nine),
            "beams": partial(
                by_beams, calibration=(own.directions_b, own.scale_error, own.lever_arm)
            ),
            "the true beams": partial(by_beams, calibration=exact),
        }
        for lost, cruise in missions.items():
            for way, velocity in ways.items():
                reckoning[f"{way}; {place}", lost] = reckon(cruise, *velocity(cruise))
    return Seed(reckoning=reckoning, **found)


def mission(calibrated: Trial, seed: int, lost: float) -> Trial:
    """Return another cruise with the same instrument."""
    beams = calibrated.beams
    assert beams is not None
    truth = calibrated.calibration_truth
    error = turns_to(beams.nominal_b, truth["beam_direction_b"]) / DEG
    data = config("cruise-beams", reference_rate_hz=10)
    data["start"] |= {"heading_deg": 37.0 * seed % 360.0}
    data["manoeuvres"] = [
        {"accelerate_m_s2": 0.2, "to_m_s": 3},
        {
            "repeat": 3,
            "manoeuvres": [
                {"straight_s": 420},
                {"turn_deg_s": 3, "duration_s": 30, "ramp_s": 3},
                {"straight_s": 60},
                {"turn_deg_s": 3, "duration_s": 30, "ramp_s": 3},
                {"straight_s": 420},
                {"turn_deg_s": -3, "duration_s": 30, "ramp_s": 3},
                {"straight_s": 60},
                {"turn_deg_s": -3, "duration_s": 30, "ramp_s": 3},
            ],
        },
    ]
    del data["gnss"], data["trial"]["gnss"]
    data["trial"]["initial"] = {"position_std_m": [1, 1, 1], "attitude_std_deg": [0.1, 0.1, 0.1]}
    data["dvl_beams"] |= {
        "misalignment_deg": list(beams.settings.misalignment_deg),
        "direction_error_deg": error.tolist(),
        "scale_error": truth["beam_scale_error"].tolist(),
        "lever_arm_m": truth["lever_arm_m"].tolist(),
        "lost_fraction": lost,
    }
    return simulate(parse_scenario(data), 1000 + seed)


def as_instrument(trial: Trial, scales: int) -> Trial:
    """Return a trial with the velocity that an instrument makes of nominal beams."""
    beams = trial.beams
    assert beams is not None
    dvl = as_dvl(beams)
    std: Any = 0.1 if scales == 1 else (0.1, 0.1, 0.1)
    settings = type(dvl.settings)(
        misalignment_deg=dvl.settings.misalignment_deg,
        misalignment_std_deg=WIDE,
        scale_error_std=std,
        lever_arm_std_m=(3.0, 3.0, 3.0),
        # As of the beams: one clock, and a velocity without bias where they have none.
        time_offset_std_s=0.0,
        bias_std_m_s=(0.0, 0.0, 0.0),
    )
    others = tuple(aid for aid in trial.others if aid is not beams)
    return replace(trial, dvl=replace(dvl, settings=settings), others=others)


def by_instrument(trial: Trial, solution: Solution | None) -> tuple[Array, Array]:
    """Return velocity in body, nan where there is none, and lever arm, of an instrument."""
    assert trial.beams is not None
    dvl = as_dvl(trial.beams)
    if solution is None:
        s = dvl.settings
        return dvl.velocity @ exp_so3(np.array(s.misalignment_deg) * DEG), np.zeros(3)
    value = {e.name: e.value for e in solution.estimates}
    unscaled = dvl.velocity / (1.0 + value["scale_error"])
    return unscaled @ exp_so3(value["misalignment_deg"] * DEG), value["lever_arm_m"]


def by_beams(trial: Trial, calibration: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return velocity in body, nan where there is none, and lever arm, of calibrated beams."""
    assert trial.beams is not None
    dvl: Dvl = as_dvl(trial.beams, calibration)
    dRb = exp_so3(np.array(dvl.settings.misalignment_deg) * DEG)
    return dvl.velocity @ dRb, calibration[2]


def reckon(trial: Trial, velocity_b: Array, lever_arm: Array) -> tuple[float, float]:
    """Return end-point and largest error in % of the distance, with the true attitude.

    The true attitude, and rates but for the gyros' noise, so that nothing but the
    calibration makes a difference.
    """
    truth, beams = trial.reference, trial.beams
    assert truth is not None
    assert beams is not None
    at = np.searchsorted(truth.time, beams.time - 1e-6)
    nRb = rotation_from_rph(truth.rph[at], trial.body_axes)
    lat, height = truth.geodetic[at, 0], truth.geodetic[at, 2]
    gyro = interpolate(beams.time, trial.imu.time - 0.005, trial.imu.gyro)
    earth = RATE * np.stack([0.0 * lat, np.cos(lat), np.sin(lat)], axis=1)
    bias = trial.calibration_truth["gyro_bias_deg_h"] * DEG_PER_HOUR
    omega = gyro - bias - np.einsum("mji,mj->mi", nRb, earth)
    known = ~np.isnan(velocity_b[:, 0])
    velocity_n = np.einsum("mij,mj->mi", nRb, velocity_b - np.cross(omega, lever_arm))
    velocity_n = interpolate(beams.time, beams.time[known], velocity_n[known])
    meridian, east = radii(lat)
    wanted = truth.geodetic[at]
    apart = np.stack(
        [
            (wanted[:, 1] - wanted[0, 1]) * (east + height) * np.cos(lat),
            (wanted[:, 0] - wanted[0, 0]) * (meridian + height),
        ],
        axis=1,
    )
    step = np.diff(beams.time)[:, None]
    moved = np.cumsum(0.5 * (velocity_n[1:] + velocity_n[:-1])[:, :2] * step, axis=0)
    error = np.linalg.norm(moved - apart[1:], axis=1)
    distance = np.sum(np.linalg.norm(np.diff(apart, axis=0), axis=1))
    return 100.0 * float(error[-1]) / distance, 100.0 * float(error.max()) / distance


def navigate(task: tuple[int, int]) -> tuple[Array, Array, float, float, float]:
    """Return NEES of the final position, share within 2σ, error and σ with beams lost."""
    seed, lost = task
    rng = np.random.default_rng([seed, 7])
    data = config("beams-turntable", reference_rate_hz=1)
    del data["turntable"]
    data["manoeuvres"] = [
        {"straight_s": 20},
        {"accelerate_m_s2": 0.2, "to_m_s": 3},
        {"straight_s": 200},
        {"turn_deg_s": 3, "duration_s": 30, "ramp_s": 3},
        {"straight_s": 200},
        {"turn_deg_s": -3, "duration_s": 30, "ramp_s": 3},
        {"straight_s": NAVIGATION_S - 501.0},
    ]
    data["gnss"]["outages_s"] = [[GNSS_S, 2.0 * NAVIGATION_S]]
    # Beams are lost from the outage on, and which of them, changes with the seed.
    gone = rng.permutation(4)[:lost] + 1
    data["dvl_beams"] |= {
        "direction_error_deg": rng.normal(0.0, DIRECTION_STD_DEG, (4, 2)).tolist(),
        "scale_error": rng.normal(0.0, SCALE_STD, 4).tolist(),
        "lever_arm_m": rng.normal(0.0, ARM_STD_M, 3).tolist(),
        "lost": [{"beam": int(b), "from_s": GNSS_S, "to_s": 2 * NAVIGATION_S} for b in gone],
    }
    data["imu"] |= {"gyro_bias_deg_h": "draw", "gyro_bias_std_deg_h": 0.02}
    data["imu"] |= {"accel_bias_ug": "draw", "accel_bias_std_ug": 50}
    data["trial"] = {
        "initial": {"attitude_std_deg": [0.02, 0.02, 0.1]},
        "dvl_beams": {
            "direction_std_deg": DIRECTION_STD_DEG,
            "scale_error_std": SCALE_STD,
            "lever_arm_std_m": [ARM_STD_M] * 3,
        },
    }
    error = rng.normal(0.0, [0.02, 0.02, 0.1])
    data["trial"]["initial"]["attitude_error_deg"] = error.tolist()
    trial = simulate(parse_scenario(data), seed)
    solution = solve(trial, rate_hz=1.0)
    assert trial.reference is not None
    found = trajectory_errors(solution, trial.reference)
    late = found.time > GNSS_S
    nees = np.array([v.nees[-1] for v in (found.position, found.velocity)])
    z = found.position.normalised[late]
    level = float(np.linalg.norm(found.position.error[-1, :2]))
    sigma = float(np.linalg.norm(found.position.std[-1, :2]))
    return nees, np.mean(np.abs(z) < 2.0, axis=0), level, sigma, float(solution.converged)


def speed() -> Iterator[tuple[str, float]]:
    """Time the 4800 s trial with four beams against the one with a 3-D velocity.

    In processor time: the machine may do something else meanwhile.
    """
    trials = {
        "3-D velocity": simulate(parse_scenario(config("cruise")), 1),
        "four beams": simulate(parse_scenario(config("cruise-beams")), 1),
    }
    times: dict[str, list[float]] = {name: [] for name in trials}
    for _ in range(ROUNDS):
        for name, trial in trials.items():
            start = process_time()
            solve(trial)
            times[name].append(process_time() - start)
    for name, taken in times.items():
        yield name, min(taken)


def main() -> None:
    args = common.parse(common.parser(__doc__, seeds=20))
    seeds = range(args.seeds)
    with common.pool(args.jobs) as pool:
        runs = list(pool.map(one_seed, seeds))
        tasks = [(seed, lost) for lost in range(4) for seed in seeds]
        lost_runs = list(pool.map(navigate, tasks))
    times = dict(speed())
    lines = [
        "# Single beams: measured\n",
        f"{args.origin} [Single beams](beams.md#measured) explains the results.",
        *calibration_section(runs),
        *reckoning_section(runs),
        *navigation_section(lost_runs, args.seeds),
        *speed_section(times),
        *common.sample_section(seed_table(runs[0])),
    ]
    print(common.write_page(args.out / PAGE, lines))


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    return seed_table(one_seed(common.SAMPLED_SEED))


def seed_table(run: Seed) -> list[str]:
    """Return the Markdown of one seed: calibration and dead reckoning."""
    rows = [
        ("NEES, batch", f"{run.batch.nees:.2f}"),
        ("NEES, Kalman", f"{run.kalman.nees:.2f}"),
        ("largest error of a direction, batch, deg", f"{run.batch.largest_error:.4f}"),
        *(
            (f"{way}, {lost}: end point, largest, %", f"{end:.4f}, {largest:.4f}")
            for (way, lost), (end, largest) in run.reckoning.items()
        ),
    ]
    return ["| what | measured |", "|---|---|", *(f"| {what} | {x} |" for what, x in rows)]


def calibration_section(runs: list[Seed]) -> Iterator[str]:
    yield "\n## Calibration on a turntable, 3600 s, RTK\n"
    yield (
        "`configs/beams-turntable.yaml`: errors up to 1° and 1 % for each beam, drawn anew. NEES "
        f"of {runs[0].batch.z.size} components: 8 of direction, 4 of scale, 3 of the lever arm.\n"
    )
    low, high = nees_band(runs[0].batch.z.size, len(runs))
    yield (
        "| solver | mean NEES (chance, 95 %) | RMS error / σ, by component | largest σ of a "
        "direction, deg | largest error of one, deg |"
    )
    yield "|---|---|---|---|---|"
    for label, of in (("batch", "batch"), ("Kalman, `--method beams`", "kalman")):
        found: list[Errors] = [getattr(run, of) for run in runs]
        ratio = np.sqrt(np.mean([e.z**2 for e in found], axis=0))
        yield (
            f"| {label} | {np.mean([e.nees for e in found]):.2f} ({low:.1f} to {high:.1f}) | "
            f"{ratio.min():.2f} to {ratio.max():.2f} | {max(e.largest_std for e in found):.4f} | "
            f"{max(e.largest_error for e in found):.4f} |"
        )


def reckoning_section(runs: list[Seed]) -> Iterator[str]:
    yield "\n## Dead reckoning with the same instrument on another cruise\n"
    yield (
        "Error in % of the distance, median over the seeds (largest in brackets; without a "
        f"turntable {HULL_SEEDS} seeds), with the true attitude, so that only the "
        "calibration counts. Instruments see what they make of nominal beams; their best seven "
        "parameters leave residuals of "
        f"{median(run.misfit for run in runs):.1f} times the noise on the turntable.\n"
    )
    ways = list(dict.fromkeys(way for way, _ in runs[0].reckoning))
    columns = list(dict.fromkeys(lost for _, lost in runs[0].reckoning))
    heads = [f"{c}: {what}" for c in columns for what in ("end point", "largest")]
    yield f"| calibration; trial | {' | '.join(heads)} |"
    yield "|---" * (len(heads) + 1) + "|"
    for way in ways:
        cells = []
        for lost in columns:
            for which in range(2):
                some = [run.reckoning for run in runs if (way, lost) in run.reckoning]
                values = [found[way, lost][which] for found in some]
                cells.append(f"{median(values):.4f} ({max(values):.4f})")
        yield f"| {way} | {' | '.join(cells)} |"


def navigation_section(runs: list[Any], seeds: int) -> Iterator[str]:
    yield "\n## Navigation with beams lost\n"
    yield (
        f"GNSS for {GNSS_S:.0f} s, then none until {NAVIGATION_S:.0f} s; beams calibrated to "
        f"{DIRECTION_STD_DEG}° and {SCALE_STD:.1e}. Chance (95 %) for a mean NEES: "
        f"{nees_band(3, seeds)[0]:.1f} to {nees_band(3, seeds)[1]:.1f}.\n"
    )
    yield (
        "| beams lost | converged | NEES of final position, velocity | epochs with error < 2σ, "
        "east, north, up | level error at the end, RMS, m | its σ, m |"
    )
    yield "|---|---|---|---|---|---|"
    for lost in range(4):
        mine = runs[lost * seeds : (lost + 1) * seeds]
        nees = np.mean([r[0] for r in mine], axis=0)
        inside = np.mean([r[1] for r in mine], axis=0)
        level = np.sqrt(np.mean([r[2] ** 2 for r in mine]))
        sigma = np.sqrt(np.mean([r[3] ** 2 for r in mine]))
        yield (
            f"| {lost} | {sum(r[4] for r in mine):.0f} of {seeds} | "
            f"{nees[0]:.2f}, {nees[1]:.2f} | "
            f"{', '.join(f'{100 * x:.0f} %' for x in inside)} | {level:.2f} | {sigma:.2f} |"
        )


def speed_section(times: dict[str, float]) -> Iterator[str]:
    yield "\n## Time for 4800 s\n"
    yield (
        f"Processor time, best of {ROUNDS} runs each, alternating, in one process. Only the ratio "
        f"is of use elsewhere: {common.machine()}.\n"
    )
    yield "| trial | `solve`, s | ratio |"
    yield "|---|---|---|"
    base = times["3-D velocity"]
    for name, taken in times.items():
        yield f"| {name} | {taken:.1f} | {taken / base:.2f} |"


if __name__ == "__main__":
    main()
