"""Measure a ship's ADCP through water: time, errors, and those of the method of Joyce.

    python benchmarks/ships.py [--hours H ...] [--seeds N] [--jobs N] [--out DIR]

writes `ships.md` into out/benchmarks. The trials are the first hours of `configs/ship-water.yaml`:
no IMU, and a current of 0.3 m/s with a correlation time of an hour.
"""

from __future__ import annotations

import resource
from time import process_time

import common
import numpy as np

from factorgraph_dvl import kalman, solve
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Solution

PAGE = "ships.md"
# What the method of Joyce finds too: the angle about the vertical, deg, and the scale error.
COMPARED = (("misalignment_deg", 2), ("scale_error", 0))
# Lines of the scenario sail there and back in 720 s.
PERIOD = 720.0

# Seconds, MB, deviations of all components in standard deviations, errors of two methods (2, 2).
Run = tuple[float, float, np.ndarray, np.ndarray]


def main() -> None:
    parser = common.parser(__doc__, seeds=2)
    parser.add_argument("--hours", type=float, action="append", help="of a trial (4 and 12)")
    args = common.parse(parser)
    lines = [
        "# A ship's ADCP through water\n",
        f"{args.origin}\n",
        f"- machine at the start: {common.machine()}\n",
        "| hours | trials | processor time, s | most memory, MB | error over σ, all components "
        "| error of phase, scale | the same by Joyce |",
        "|---|---|---|---|---|---|---|",
    ]
    with common.pool(args.jobs) as pool:
        for hours in args.hours or (4.0, 12.0):
            runs = list(pool.map(run, [hours] * args.seeds, range(args.seeds)))
            lines.append(row(hours, runs))
            print(lines[-1], flush=True)
    common.write_page(args.out / PAGE, lines)


def run(hours: float, seed: int) -> Run:
    """Solve one trial by both methods."""
    data = common.config("ship-water")
    data["manoeuvres"][0]["repeat"] = round(hours * 3600.0 / PERIOD)
    trial = simulate(parse_scenario(data), seed)
    start = process_time()
    found = solve(trial, rate_hz=1.0)
    seconds = process_time() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    truth = trial.calibration_truth
    names = ("misalignment_deg", "scale_error", "lever_arm_m")
    deviations = [(found.estimate(n).value - truth[n]) / found.estimate(n).std for n in names]
    both = np.array([errors(s, truth) for s in (found, kalman(trial, method="joyce"))])
    return seconds, memory, np.concatenate(deviations), both


def errors(solution: Solution, truth: dict[str, np.ndarray]) -> list[float]:
    """Return the errors of what both methods find."""
    return [float(solution.estimate(n).value[i] - truth[n][i]) for n, i in COMPARED]


def row(hours: float, runs: list[Run]) -> str:
    """Return the row of trials that are equally long."""
    seconds, memory, deviations, both = zip(*runs, strict=True)
    ours, theirs = np.sqrt(np.mean(np.square(both), axis=0))
    cells = [
        f"{hours:g}",
        f"{len(runs)}",
        f"{min(seconds):.0f} to {max(seconds):.0f}",
        f"{max(memory):.0f}",
        f"{common.rms(deviations):.2f}",
        *(f"{phase:.3f}°, {scale:.4f}" for phase, scale in (ours, theirs)),
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
