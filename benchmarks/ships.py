"""Measure a ship's ADCP through water, and a DVL beside an INS: errors, deviations, time.

    python benchmarks/ships.py [--hours H ...] [--seeds N] [--jobs N] [--out DIR]

writes `ships.md` into out/benchmarks. Ships through water are the first hours of
`configs/ship-water.yaml`: no IMU, and a current of 0.3 m/s with a correlation time of an hour.
Those over ground are `configs/ship.yaml` with an INS. Runs that are done are kept in `ships.jsonl`
beside it, for the same commit.
"""

from __future__ import annotations

import resource
from time import process_time
from typing import Any

import common
import numpy as np

from factorgraph_dvl import kalman, solve
from factorgraph_dvl.analysis.error_statistics import nees_band
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.attitude import SCHULER_PERIOD
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.simulation.scenario import Scenario
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

PAGE = "ships.md"
CALIBRATED = ("misalignment_deg", "scale_error", "lever_arm_m")
# What the method of Joyce finds too: the angle about the vertical, deg, and the scale error.
COMPARED = (("misalignment_deg", 2), ("scale_error", 0))
# Lines of the scenario sail there and back in 720 s.
PERIOD = 720.0
# Means of so many seconds of the dense reference.
SPAN = 60.0
LENGTHS = (0.4, 1.0, 4.0, 12.0)
# Most seeds of a length.
FEWER = {12.0: 6}
# An INS whose velocity errs by 0.05 m/s with the period of Schuler.
INS = {
    "rate_hz": 1,
    "schuler_velocity_rms_m_s": 0.05,
    "attitude_std_deg": [0.02, 0.02, 0.05],
    "white_velocity_std_m_s": 0.005,
    "white_position_std_m": 0.02,
}


def main() -> None:
    parser = common.parser(__doc__, seeds=20)
    parser.add_argument(
        "--hours", type=float, action="append", help="of a trial (0.4, 1, 4 and 12)"
    )
    args = common.parse(parser)
    lines = [
        "# Ships without an IMU: measured\n",
        f"{args.origin} [Ships without a raw IMU](no-imu.md) says what is assumed.\n",
        f"- machine at the start: {common.machine()}",
        "- Through water: compass, GNSS, and an ADCP that sees moving water. Over ground: a DVL, "
        "and an INS whose velocity errs by 0.05 m/s with the period of Schuler.",
        "- Errors over σ are root mean squares, σ the reported standard deviation. NEES/7 is that "
        "of misalignment, scale and lever arm, with the band of 99 % of right ones. Trials that "
        "the solver says are not to be used are left out.",
        "- The reference is generalised least squares of means of a minute, with the covariances "
        "that the simulation draws from.",
        "- Joyce is `kalman --method joyce` on the same trials.\n",
        "| ship | hours | trials | not to be used | errors over σ | NEES/7 (band) "
        "| mean current over σ | errors of phase, scale | over those of Joyce "
        "| σ over that of the reference | processor time, s | memory, MB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lengths = args.hours or LENGTHS
    # Short ones first: a row is whole as early as it can be.
    wanted = [
        (kind, hours, seed)
        for hours in lengths
        for kind in KINDS
        for seed in range(min(args.seeds, FEWER.get(hours, args.seeds)))
    ]
    found = common.kept_runs(args, "ships.jsonl", wanted, outcome)
    each = dict(zip(wanted, found, strict=True))
    for kind in KINDS:
        for hours in lengths:
            own = [each[of] for of in wanted if of[:2] == (kind, hours)]
            lines.append(row(kind, hours, own))
    lines.append("\nErrors over σ by component:\n")
    for kind in KINDS:
        own = [each[of] for of in wanted if of[0] == kind and each[of]["usable"]]
        lines.append(by_component(kind, own))
    print(common.write_page(args.out / PAGE, lines))


def outcome(kind: str, hours: float, seed: int) -> dict[str, Any]:
    """Solve one trial; return what became of it."""
    scenario = KINDS[kind](hours)
    trial = simulate(scenario, seed)
    start = process_time()
    found = solve(trial, rate_hz=1.0)
    seconds = process_time() - start
    truth = trial.calibration_truth
    out = {
        "seconds": seconds,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "usable": found.verdict.grade != "do not use",
        "deviations": deviations(found, truth, CALIBRATED).tolist(),
        "nees": common.nees(found, truth),
    }
    if kind == WATER:
        joyce = kalman(trial, method="joyce")
        std = [found.estimate(n).std[i] for n, i in COMPARED]
        dense = dense_standard_deviations(trial, scenario, SPAN) / np.array([DEG, 1.0])
        out |= {
            "current": deviations(found, truth, ("current_m_s",)).tolist(),
            "errors": [errors(solution, truth) for solution in (found, joyce)],
            "excess": (np.array(std) / dense).tolist(),
        }
    return out


def ship_through_water(hours: float) -> Scenario:
    """Return the first hours of the scenario."""
    data = common.config("ship-water")
    data["manoeuvres"][0]["repeat"] = round(hours * 3600.0 / PERIOD)
    return parse_scenario(data)


def ship_beside_ins(hours: float) -> Scenario:
    """Return the first hours of the scenario over ground, an INS in place of compass and GNSS."""
    data: dict[str, Any] = common.config("ship", ins=INS)
    data["manoeuvres"][0]["repeat"] = round(hours * 3600.0 / PERIOD)
    data["trial"] = {"dvl": data["trial"]["dvl"]}
    del data["attitude"], data["gnss"]
    return parse_scenario(data)


def deviations(
    found: Solution, truth: dict[str, np.ndarray], names: tuple[str, ...]
) -> np.ndarray:
    """Return errors in standard deviations."""
    estimates = [found.estimate(n) for n in names]
    return np.concatenate([(e.value - truth[e.name]) / e.std for e in estimates])


def errors(solution: Solution, truth: dict[str, np.ndarray]) -> list[float]:
    """Return the errors of what both methods find."""
    return [float(solution.estimate(n).value[i] - truth[n][i]) for n, i in COMPARED]


def row(kind: str, hours: float, runs: list[dict[str, Any]]) -> str:
    """Return the row of trials that are equally long, by those that are usable."""
    used = [r for r in runs if r["usable"]]
    seconds = [r["seconds"] for r in used]
    low, high = (bound / 7 for bound in nees_band(7, len(used), 0.99))
    compared = ["–"] * 4
    if kind == WATER:
        ours, theirs = np.sqrt(np.mean(np.square([r["errors"] for r in used]), axis=0))
        share, excess = ours / theirs, np.mean([r["excess"] for r in used], axis=0)
        compared = [
            f"{common.rms([r['current'] for r in used]):.2f}",
            f"{ours[0]:.3f}°, {ours[1]:.4f}",
            f"{share[0]:.2f}, {share[1]:.2f}",
            f"{excess[0]:.2f}, {excess[1]:.2f}",
        ]
    cells = [
        kind,
        f"{hours:g}",
        f"{len(runs)}",
        f"{len(runs) - len(used)}",
        f"{common.rms([r['deviations'] for r in used]):.2f}",
        f"{np.mean([r['nees'] for r in used]):.2f} ({low:.2f}–{high:.2f})",
        *compared,
        f"{min(seconds):.0f} to {max(seconds):.0f}",
        f"{max(r['memory'] for r in used):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def by_component(name: str, runs: list[dict[str, Any]]) -> str:
    """Return root mean squares of errors over their standard deviations, one by one."""
    values = np.sqrt(np.mean(np.square([r["deviations"] for r in runs]), axis=0))
    labels = ("roll", "pitch", "yaw", "scale", "lever arm x", "y", "z")
    named = ", ".join(f"{label} {v:.2f}" for label, v in zip(labels, values, strict=True))
    return f"- {name}: {named}"


def dense_standard_deviations(trial: Trial, scenario: Scenario, span: float) -> np.ndarray:
    """Return those of phase, rad, and scale by generalised least squares of means over a span, s.

    z_s = (1 - k) exp(-i (alpha + e)) z_d + w: e the oscillation of the heading, w the current and
    the noise of differences of fixes, whose covariances are those that the scenario draws from.
    """
    moving, gnss = scenario.dvl.moving_water, trial.gnss.settings
    time = trial.reference.time
    east, north, _ = trial.frame().position(*trial.reference.geodetic.T).T
    edges = np.flatnonzero(np.isin(time, np.arange(time[0], time[-1], span)))
    at, ends, place = time[edges], np.diff(time[edges]), (east + 1j * north)[edges]
    z = np.diff(place) / ends
    middle, there = 0.5 * (at[1:] + at[:-1]), 0.5 * (place[1:] + place[:-1])
    later = np.abs(middle[:, None] - middle) / moving.correlation_time_s
    apart = np.abs(there[:, None] - there) / moving.correlation_distance_m
    covariance = moving.std_m_s**2 * np.exp(-later - apart)
    covariance += trial.dvl.settings.current_std_m_s[0] ** 2
    fixes = gnss.correlated_std_m[0] ** 2 * np.exp(
        -np.abs(at[:, None] - at) / gnss.correlation_time_s
    )
    fixes += gnss.position_std_m[0] ** 2 * np.eye(at.size)
    covariance += np.diff(np.diff(fixes, axis=0), axis=1) / np.outer(ends, ends)
    covariance += trial.dvl.settings.velocity_std_m_s**2 / span * np.eye(z.size)
    swing = 2.0 * np.pi / SCHULER_PERIOD * middle
    columns = np.stack([1j * z, z, 1j * z * np.cos(swing), 1j * z * np.sin(swing)], axis=1)
    weights = np.linalg.inv(covariance)
    information = np.real(columns.conj().T @ weights @ columns)
    stated = trial.attitude.settings.schuler_std_deg * DEG
    information[[2, 3], [2, 3]] += stated**-2.0
    return np.sqrt(np.diag(np.linalg.inv(information))[:2])


WATER = "through water"
KINDS = {WATER: ship_through_water, "over ground": ship_beside_ins}


if __name__ == "__main__":
    main()
