"""What a star tracker is worth: to the gyros afloat, and to the dive that follows.

    python benchmarks/stars.py [--seeds 10] [--jobs 2] [--out DIR]

writes `stars.md` into out/benchmarks, or with `--out docs` that of the documentation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import common
import numpy as np
from common import config, rms, until

from factorgraph_dvl.analysis.error_statistics import (
    calibration_errors,
    nees_band,
    trajectory_errors,
)
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.files.earlier_calibration import calibrated_by, with_biases_of
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Calibration, Solution
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import InitialAttitude, InitialPosition, InitialVelocity, Trial

PAGE = "stars.md"
GYRO = "gyro_bias_deg_h"
AFLOAT = ("GNSS alone", "GNSS and stars")
DIVES = (
    "one trial, no stars",
    "one trial, stars at the surface",
    "a trial of its own, biases as before any trial",
    "a trial of its own, `imu.calibration` from the surface",
)
# Attitude that the vessel is aligned to before: adrift, without stars, it cannot find its heading.
ALIGNED_DEG = [0.1, 0.1, 1.0]
# When GNSS and stars end, and how often the vehicle goes there and back below.
SUBMERGES_S, LEGS = 305.0, 2
# What an 80-minute cruise leaves unknown of the DVL, about: deg, 1, m.
DVL_STD = {
    "misalignment_deg": [0.0014, 0.0066, 0.0015],
    "scale_error": [1.4e-5],
    "lever_arm_m": [0.001, 0.0012, 0.0011],
}


@dataclass(frozen=True)
class Run:
    """Of one solution: gyro biases in deg/h, and heading in deg and position in m at the end."""

    gyro_error: np.ndarray
    gyro_std: np.ndarray
    heading_std: float = np.nan
    level_error: float = np.nan
    level_std: float = np.nan
    nees: float = np.nan


def gyros(solution: Solution, trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and standard deviations of the gyro biases, deg/h."""
    errors = calibration_errors(solution, trial.calibration_truth)
    names = solution.estimate(GYRO).component_names
    rows = [errors.names.index(name) for name in names]
    return errors.error[rows], errors.std[rows]


def afloat(seed: int) -> dict[str, Run]:
    """Solve a vessel that drifts for five minutes, without and with stars."""
    data: dict[str, Any] = config("star")
    error = np.random.default_rng([seed, 12]).normal(0.0, ALIGNED_DEG)
    initial = {"attitude_std_deg": ALIGNED_DEG, "attitude_error_deg": error.tolist()}
    data["trial"] = {**data["trial"], "initial": initial}
    trial = simulate(parse_scenario(data), seed)
    bare = replace(trial, others=())
    solutions = {name: solve(t) for name, t in zip(AFLOAT, (bare, trial), strict=True)}
    assert all(s.converged for s in solutions.values())
    return {name: Run(*gyros(s, trial)) for name, s in solutions.items()}


def calibrated(trial: Trial, seed: int) -> Trial:
    """Return a trial whose DVL was calibrated before, with errors as large as it states."""
    rng = np.random.default_rng([seed, 11])
    estimates = []
    for name, each in DVL_STD.items():
        std = np.array(each)
        value = trial.calibration_truth[name] + std * rng.standard_normal(std.size)
        names = tuple(f"{name}{i}" for i in range(std.size))
        estimates.append(Estimate(name, names, value, std, value, std, np.ones(std.size, bool)))
    P = np.diag(np.concatenate(list(DVL_STD.values())) ** 2)
    found = Calibration("cruise", "batch", "RFU", True, 1, 0.0, tuple(estimates), P)
    assert trial.dvl is not None
    return replace(trial, dvl=calibrated_by(trial.dvl, found, "RFU", "the cruise"))


def dive(seed: int) -> Trial:
    """Return a dive that ends below."""
    data: dict[str, Any] = config("dive-stars")
    data["manoeuvres"] = [*data["manoeuvres"][:7], {**data["manoeuvres"][7], "repeat": LEGS}]
    data["gnss"]["outages_s"] = data["star"]["outages_s"] = [[SUBMERGES_S, 1e5]]
    del data["dvl"]["no_lock_s"]
    return calibrated(simulate(parse_scenario(data), seed), seed)


def dives(seed: int) -> dict[str, Run]:
    """Solve a dive as one trial and as two."""
    trial = dive(seed)
    bare = replace(trial, others=tuple(a for a in trial.others if a.section != "star"))
    found = solve(until(trial, SUBMERGES_S))
    below = after(trial, found)
    assert below.imu is not None
    carried = with_biases_of(
        below.imu, as_calibration(found), trial.body_axes, trial.epoch, "the surface"
    )
    trials = (bare, trial, below, replace(below, imu=carried))
    return {
        name: ended(solve(t, rate_hz=1.0), trial) for name, t in zip(DIVES, trials, strict=True)
    }


def after(trial: Trial, surface: Solution) -> Trial:
    """Return a trial from where the surface ended, which is its start."""

    def later(record: Any) -> Any:
        return record and rows_of(record, record.time >= SUBMERGES_S - 1e-6)

    end = surface.trajectory
    return replace(
        trial,
        imu=later(trial.imu),
        gnss=None,
        dvl=later(trial.dvl),
        others=tuple(later(aid) for aid in trial.others if aid.section != "star"),
        initial_attitude=InitialAttitude(end.rph[-1], end.rph_std[-1]),
        initial_position=InitialPosition(end.geodetic[-1], end.position_std[-1]),
        initial_velocity=InitialVelocity(end.velocity[-1], end.velocity_std[-1]),
    )


def as_calibration(solution: Solution) -> Calibration:
    """Return the calibration of a solution."""
    fields = Calibration.__dataclass_fields__
    return Calibration(**{name: getattr(solution, name) for name in fields})


def ended(solution: Solution, trial: Trial) -> Run:
    """Return gyro biases, and heading and position at the end of a dive."""
    assert trial.reference is not None
    errors = trajectory_errors(solution, trial.reference)
    position = errors.position
    return Run(
        *gyros(solution, trial),
        heading_std=float(np.degrees(errors.attitude.std[-1, 2])),
        level_error=float(np.linalg.norm(position.error[-1, :2])),
        level_std=float(np.linalg.norm(position.std[-1, :2])),
        nees=float(position.nees[-1]),
    )


INTRODUCTION = """\
# Stars against no stars

{origin}

A surfaced vehicle that may not manoeuvre finds the drift of its gyros by a star tracker (Liu, Yu
and Xu, 2020). [`liu-2020.md`](liu-2020.md) also shows the effect of stars on the calibration of a
DVL. This page compares `solve` with and without a star tracker on the same trials: the gyros
afloat, and the dive that follows.

## Afloat

`configs/star.yaml`: five minutes adrift in a gentle sea, position to 20 m, prior of the drifts
5 °/h, attitude at the start known to 0.1°, 0.1° and 1°, {seeds} seeds. RMS(error / σ) of {low:.2f}
to {high:.2f} is chance (99.7 %).

"""
BELOW = """\
## Then a dive

`configs/dive-stars.yaml`, cut to {minutes:.0f} minutes: {surface:.0f} s at the surface with turns,
GNSS (0.5 m, 0.05 m/s) and stars, then 50 m below without either. The gyros have a drift with σ =
0.05 °/h and an angle random walk of 0.0005 °/√h. The DVL was calibrated before, with the errors of
a calibration from an 80-minute cruise. Heading and position are those at the end of the dive, over
{seeds} seeds; a mean NEES of {low:.1f} to {high:.1f} is chance (99.7 %). The third and the fourth
row solve the dive as a trial of its own. It starts from position, velocity and attitude as the
surface left them, with their standard deviations, and in the fourth row from its biases as well
([`imu.calibration`](format.md#trialyaml)).

"""


def afloat_table(runs: Sequence[dict[str, Run]]) -> list[str]:
    """Return the Markdown of the gyros afloat."""
    out = [
        "| | σ of the drift, °/h: x | y | z | RMS error, °/h | RMS(error / σ) |",
        "|---|---|---|---|---|---|",
    ]
    for name in AFLOAT:
        std = np.array([r[name].gyro_std for r in runs])
        error = np.array([r[name].gyro_error for r in runs])
        out.append(
            f"| {name} | {' | '.join(f'{x:.4f}' for x in std.mean(axis=0))} | {rms(error):.4f} "
            f"| {rms(error / std):.2f} |"
        )
    return out


def dive_table(runs: Sequence[dict[str, Run]]) -> list[str]:
    """Return the Markdown of the dives."""
    out = [
        "| | σ of the drift, °/h: x | y | z | σ of the heading, deg | level error, RMS, m "
        "| its σ, m | NEES of the position (3 expected) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in DIVES:
        mine = [r[name] for r in runs]
        std = np.mean([r.gyro_std for r in mine], axis=0)
        out.append(
            f"| {name} | {' | '.join(f'{x:.4f}' for x in std)} "
            f"| {np.mean([r.heading_std for r in mine]):.4f} "
            f"| {rms([r.level_error for r in mine]):.2f} | {rms([r.level_std for r in mine]):.2f} "
            f"| {np.mean([r.nees for r in mine]):.1f} |"
        )
    return out


def gains(runs: Sequence[dict[str, Run]], names: tuple[str, str]) -> str:
    """Return by how much the gyros' standard deviations fall from one row to another."""
    before, now = (np.mean([r[name].gyro_std for r in runs], axis=0) for name in names)
    return ", ".join(f"{x:.1f}" if x < 10.0 else f"{x:.0f}" for x in before / now)


def main() -> None:
    """Run the study and write its page."""
    args = common.parse(common.parser(__doc__, seeds=10))
    with common.pool(args.jobs) as pool:
        floating = list(pool.map(afloat, range(args.seeds)))
        diving = list(pool.map(dives, range(args.seeds)))
    trial = dive(common.SAMPLED_SEED)
    low, high = np.sqrt(np.array(nees_band(1, 3 * args.seeds, level=0.997)))
    chance = nees_band(3, args.seeds, level=0.997)
    assert trial.imu is not None
    page = INTRODUCTION.format(
        origin=args.origin, seeds=args.seeds, low=low, high=high
    ).splitlines()
    page += [
        *afloat_table(floating),
        "",
        f"σ is {gains(floating, AFLOAT)} times smaller with stars.",
        "",
    ]
    page += BELOW.format(
        seeds=args.seeds,
        minutes=trial.imu.time[-1] / 60.0,
        surface=SUBMERGES_S,
        low=chance[0],
        high=chance[1],
    ).splitlines()
    page += dive_table(diving)
    page += [
        "",
        f"At the surface the stars make σ of the drifts {gains(diving, DIVES[:2])} times smaller. "
        f"The trial of its own knows them {gains(diving, DIVES[2:])} times better with the biases "
        "of the surface.",
    ]
    page += common.sample_section([*afloat_table(floating[:1]), "", *dive_table(diving[:1])])
    print(common.write_page(args.out / PAGE, page))


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    seed = common.SAMPLED_SEED
    return [*afloat_table([afloat(seed)]), *dive_table([dives(seed)])]


if __name__ == "__main__":
    main()
