"""Measure a ship's ADCP through water, and a DVL beside an INS: errors, deviations, time.

    python benchmarks/ships.py [--hours H ...] [--seeds N] [--jobs N] [--out DIR]

writes `ships.md` into out/benchmarks. The trials are the first hours of `configs/ship-water.yaml`:
no IMU, and a current of 0.3 m/s with a correlation time of an hour. Of trials below two hours
there are three times as many, and those with an INS are twice as many, of 24 minutes.
"""

from __future__ import annotations

import resource
from dataclasses import dataclass
from time import process_time
from typing import Any

import common
import numpy as np

from factorgraph_dvl import kalman, solve
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
SHORT_HOURS, MORE_SHORT, MORE_INS = 2.0, 3, 2
# An INS whose velocity errs by 0.05 m/s with the period of Schuler.
INS = {
    "rate_hz": 1,
    "schuler_velocity_rms_m_s": 0.05,
    "attitude_std_deg": [0.02, 0.02, 0.05],
    "white_velocity_std_m_s": 0.005,
    "white_position_std_m": 0.02,
}


@dataclass(frozen=True)
class Run:
    """One trial, solved.

    Parameters
    ----------
    seconds, memory : float
        Processor time, s, and most memory, MB.
    deviations : ndarray, shape (7,)
        Errors of the calibration in standard deviations.
    current : ndarray, shape (2,) or (0,)
        The same of the mean current.
    errors : ndarray, shape (2, 2)
        Errors of phase, deg, and scale, then those of Joyce.
    excess : ndarray, shape (2,)
        Standard deviations of phase and scale over those of least squares.
    usable : bool
        Whether the solver does not say that its result is not to be used.
    """

    seconds: float
    memory: float
    deviations: np.ndarray
    current: np.ndarray
    errors: np.ndarray
    excess: np.ndarray
    usable: bool


def main() -> None:
    parser = common.parser(__doc__, seeds=20)
    parser.add_argument("--hours", type=float, action="append", help="of a trial (1 and 4)")
    args = common.parse(parser)
    lines = [
        "# Ships without an IMU: measured\n",
        f"{args.origin} [Ships without a raw IMU](no-imu.md) says what is assumed.\n",
        f"- machine at the start: {common.machine()}",
        "- Root mean squares over all trials but those that the solver says are not to be used. "
        "σ is the reported standard deviation.",
        "- The reference is generalised least squares of means of a minute, with the covariances "
        "that the simulation draws from.",
        "- Joyce is `kalman --method joyce` on the same trials.\n",
        "| hours | trials | not to be used | errors over σ | of the mean current "
        "| errors of phase, scale | over those of Joyce | σ over that of the reference "
        "| processor time, s | memory, MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    everything: list[Run] = []
    with common.pool(args.jobs) as pool:
        for hours in args.hours or (1.0, 4.0):
            count = args.seeds * (MORE_SHORT if hours < SHORT_HOURS else 1)
            runs = list(pool.map(through_water, [hours] * count, range(count)))
            kept = [r for r in runs if r.usable]
            everything += kept
            lines.append(row(hours, len(runs), kept))
            print(lines[-1], flush=True)
        beside = list(pool.map(beside_ins, range(MORE_INS * args.seeds)))
    beside = [r for r in beside if r.usable]
    pooled = common.rms([r.deviations for r in everything])
    lines.append(f"\nErrors over σ, all {len(everything)} trials through water: {pooled:.2f}.\n")
    lines.append("Errors over σ by component:\n")
    lines.append(by_component("through water", everything))
    ins = common.rms([r.deviations for r in beside])
    lines.append(by_component("INS with a Schuler error", beside))
    lines.append(
        f"\nErrors over σ, {len(beside)} trials of 24 minutes over ground with an INS "
        f"whose velocity errs by 0.05 m/s with the period of Schuler: {ins:.2f}."
    )
    common.write_page(args.out / PAGE, lines)


def ship_through_water(hours: float) -> Scenario:
    """Return the first hours of the scenario."""
    data = common.config("ship-water")
    data["manoeuvres"][0]["repeat"] = round(hours * 3600.0 / PERIOD)
    return parse_scenario(data)


def through_water(hours: float, seed: int) -> Run:
    """Solve one trial through water by both methods."""
    scenario = ship_through_water(hours)
    trial = simulate(scenario, seed)
    found, seconds = solved(trial)
    truth = trial.calibration_truth
    both = np.array([errors(s, truth) for s in (found, kalman(trial, method="joyce"))])
    std = [found.estimate(n).std[i] for n, i in COMPARED]
    dense = dense_standard_deviations(trial, scenario, SPAN) / np.array([DEG, 1.0])
    return Run(
        seconds=seconds,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        deviations=deviations(found, truth, CALIBRATED),
        current=deviations(found, truth, ("current_m_s",)),
        errors=both,
        excess=np.array(std) / dense,
        usable=is_usable(found),
    )


def beside_ins(seed: int) -> Run:
    """Solve one trial over ground with an INS in place of compass and GNSS."""
    data: dict[str, Any] = common.config("ship", ins=INS)
    data["manoeuvres"][0]["repeat"] = 2
    data["trial"] = {"dvl": data["trial"]["dvl"]}
    del data["attitude"], data["gnss"]
    trial = simulate(parse_scenario(data), seed)
    found, seconds = solved(trial)
    own = deviations(found, trial.calibration_truth, CALIBRATED)
    return Run(seconds, 0.0, own, np.zeros(0), np.zeros((2, 2)), np.zeros(2), is_usable(found))


def solved(trial: Trial) -> tuple[Solution, float]:
    """Return the solution, and the processor time that it took, s."""
    start = process_time()
    found = solve(trial, rate_hz=1.0)
    return found, process_time() - start


def is_usable(found: Solution) -> bool:
    """Whether the solver does not say that its result is not to be used."""
    return found.verdict.grade != "do not use"


def deviations(
    found: Solution, truth: dict[str, np.ndarray], names: tuple[str, ...]
) -> np.ndarray:
    """Return errors in standard deviations."""
    estimates = [found.estimate(n) for n in names]
    return np.concatenate([(e.value - truth[e.name]) / e.std for e in estimates])


def errors(solution: Solution, truth: dict[str, np.ndarray]) -> list[float]:
    """Return the errors of what both methods find."""
    return [float(solution.estimate(n).value[i] - truth[n][i]) for n, i in COMPARED]


def row(hours: float, count: int, runs: list[Run]) -> str:
    """Return the row of trials that are equally long, by those that are usable."""
    ours, theirs = np.sqrt(np.mean(np.square([r.errors for r in runs]), axis=0))
    share, excess = ours / theirs, np.mean([r.excess for r in runs], axis=0)
    seconds = [r.seconds for r in runs]
    cells = [
        f"{hours:g}",
        f"{count}",
        f"{count - len(runs)}",
        f"{common.rms([r.deviations for r in runs]):.2f}",
        f"{common.rms([r.current for r in runs]):.2f}",
        f"{ours[0]:.3f}°, {ours[1]:.4f}",
        f"{share[0]:.2f}, {share[1]:.2f}",
        f"{excess[0]:.2f}, {excess[1]:.2f}",
        f"{min(seconds):.0f} to {max(seconds):.0f}",
        f"{max(r.memory for r in runs):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def by_component(name: str, runs: list[Run]) -> str:
    """Return root mean squares of errors over their standard deviations, one by one."""
    values = np.sqrt(np.mean(np.square([r.deviations for r in runs]), axis=0))
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


if __name__ == "__main__":
    main()
