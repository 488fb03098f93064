"""Reproduce the simulation of Luo et al. (2024) with its own method and with ours.

    python benchmarks/luo_2024.py [--seeds 20] [--filter-seeds 100] [--out DIR]

writes `luo-2024.md` and `images/luo-2024-convergence.png` into out/benchmarks, or with
`--out docs` those of the documentation. `--filter-seeds` are those of the point-set filter alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import common
import msgspec
import numpy as np

from factorgraph_dvl.analysis.error_statistics import calibration_errors, nees_band, paper_accuracy
from factorgraph_dvl.baselines import History, calibrate
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

PAGE = "luo-2024.md"
PHASES = (0, 90)
SEVEN = ("misalignment_deg", "scale_error", "lever_arm_m")
LABELS = ("α_x, deg", "α_y, deg", "α_z, deg", "δK", "l_x, m", "l_y, m", "l_z, m")
TRUTH = np.array([2.0, 2.0, 30.0, 0.005, 1.0, 1.2, 1.4])
# Table 4 of the paper.
PAPER = np.array([1.937, 1.897, 29.941, 0.005067, 1.047, 1.153, 1.392])
DIGITS = (3, 3, 3, 6, 4, 4, 4)
# Seconds after which the convergence of a filter is judged: the first pings show two angles only.
SMOOTH_AFTER_S = 30.0
GRAPH_TIMES = (30, 60, 100, 110, 130, 150, 200, 250, 260, 280, 300, 350, 400, 453)


@dataclass(frozen=True)
class Run:
    """Errors, standard deviations and NEES of the seven parameters by one method."""

    error: np.ndarray
    std: np.ndarray
    nees: float
    accuracy: float


@dataclass(frozen=True)
class Settling:
    """How the point-set filter ended on one seed.

    Parameters
    ----------
    converged : bool
        Whether its steps at the end settled.
    steps : ndarray, shape (7,)
        Largest changes from row to row of the history after 30 s.
    apart : ndarray, shape (7,)
        Last row of the history less the solution.
    error : ndarray, shape (7,)
        Of the solution.
    accuracy : float, %
    """

    converged: bool
    steps: np.ndarray
    apart: np.ndarray
    error: np.ndarray
    accuracy: float


def config(phase: int, **top: object) -> dict[str, object]:
    """Return the scenario of one phase, with changes at the top level."""
    return common.config(f"seed-a-phase-{phase}", **top)


def summary(solution: Solution, trial: Trial) -> Run:
    """Hold the seven parameters of a solution against the truth."""
    errors = calibration_errors(solution, trial.calibration_truth)
    names = [n for e in solution.estimates if e.name in SEVEN for n in e.component_names]
    rows = [errors.names.index(n) for n in names]
    error, P = errors.error[rows], errors.covariance[np.ix_(rows, rows)]
    return Run(
        error,
        np.sqrt(np.diag(P)),
        float(error @ np.linalg.solve(P, error)),
        paper_accuracy(solution.estimates, trial.calibration_truth),
    )


def filtered(task: tuple[int, int]) -> Settling:
    """Calibrate one simulated trial by the point-set filter, and say how it settled."""
    phase, seed = task
    trial = simulate(parse_scenario(config(phase)), seed=seed)
    return settling(*calibrate(trial, "point-set"), trial)


def settling(solution: Solution, history: History | None, trial: Trial) -> Settling:
    """Say how the history of a filter ran into its solution."""
    assert history is not None
    late = history.values[history.time > SMOOTH_AFTER_S, :7]
    run = summary(solution, trial)
    return Settling(
        solution.converged,
        np.abs(np.diff(late, axis=0)).max(axis=0),
        late[-1] - values_and_std(solution)[0],
        run.error,
        run.accuracy,
    )


def one_seed(task: tuple[int, int]) -> dict[str, Run]:
    """Solve one simulated trial by every method that estimates all seven parameters."""
    phase, seed = task
    trial = simulate(parse_scenario(config(phase)), seed=seed)
    return {
        "Kalman point-set": summary(calibrate(trial, "point-set")[0], trial),
        "least squares": summary(calibrate(trial, "least-squares")[0], trial),
        "factor graph": summary(solve(trial), trial),
    }


def cramer_rao(phase: int) -> np.ndarray:
    """Return the bound of all data together: the covariance at the noise-free solution."""
    trial = simulate(parse_scenario(config(phase, noise=False)))
    return summary(solve(trial), trial).std


def values_and_std(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Return the seven values and their standard deviations."""
    picked = [solution.estimate(name) for name in SEVEN]
    return np.concatenate([e.value for e in picked]), np.concatenate([e.std for e in picked])


def convergence(phase: int) -> tuple[History, History, np.ndarray, np.ndarray, np.ndarray]:
    """Return how the filters converged on seed 0, and the factor graph on the data so far."""
    trial = simulate(parse_scenario(config(phase)), seed=0)
    seven = calibrate(trial, "point-set")[1]
    assert trial.dvl is not None
    # The nine-state model has no lever arm: without that of the truth it is lost in sway.
    known = msgspec.structs.replace(trial.dvl.settings, lever_arm_m=tuple(TRUTH[4:]))
    nine = calibrate(replace(trial, dvl=replace(trial.dvl, settings=known)), "nine-state")[1]
    assert seven is not None
    assert nine is not None
    solved = [values_and_std(solve(common.until(trial, t))) for t in GRAPH_TIMES]
    times = np.array(GRAPH_TIMES, dtype=float)
    return seven, nine, times, *(np.array(x) for x in zip(*solved, strict=True))


def draw(curves: dict[int, tuple], path: Path) -> None:
    """Draw the convergence of all methods, as in figure 4 of the paper."""
    figure = common.new_figure(11, 13)
    axes = figure.subplots(7, len(curves), sharex=True, squeeze=False)
    for column, (phase, (seven, nine, times, value, std)) in enumerate(curves.items()):
        for row, label in enumerate(LABELS):
            ax = axes[row, column]
            ax.plot(seven.time, seven.values[:, row], color="0.45", lw=0.6, label="seven states")
            if row < 4:
                # It has one scale for each axis: the mean stands for them.
                own = nine.values[:, row] if row < 3 else nine.values[:, 3:6].mean(axis=1)
                ax.plot(nine.time, own, color="tab:orange", lw=1, label="nine states")
            ax.errorbar(
                times, value[:, row], 3 * std[:, row], fmt="o", ms=3, lw=1, color="#0b6cc0",
                label="factor graph, ±3σ",
            )  # fmt: skip
            ax.axhline(TRUTH[row], color="k", lw=0.8, ls="--", label="truth")
            reach = 12.0 * max(std[-1, row], abs(PAPER[row] - TRUTH[row]) / 6.0)
            ax.set_ylim(TRUTH[row] - reach, TRUTH[row] + reach)
            ax.set_ylabel(label)
            ax.grid(color="0.92")
            ax.spines[["top", "right"]].set_visible(False)
        axes[0, column].set_title(f"sway phase {phase}°")
        axes[-1, column].set_xlabel("time, s")
    axes[0, 0].legend(fontsize=8, ncols=2, loc="lower right")
    common.save_figure(figure, path)


def rms(runs: Sequence[Run]) -> np.ndarray:
    """Return the root mean square error over runs."""
    return np.sqrt(np.mean([r.error**2 for r in runs], axis=0))


def ratio(runs: Sequence[Run]) -> np.ndarray:
    """Return the RMS of error / σ over runs."""
    return np.sqrt(np.mean([(r.error / r.std) ** 2 for r in runs], axis=0))


def value_table(run: dict[str, Run]) -> list[str]:
    """Return the Markdown of the values that one seed gives, beside those of the paper."""
    kalman, graph = (TRUTH + run[name].error for name in ("Kalman point-set", "factor graph"))
    return [
        "| | truth | paper | Kalman point-set | factor graph |",
        "|---|---|---|---|---|",
        *(
            f"| {label} | {TRUTH[i]:g} | {PAPER[i]:g} | {kalman[i]:.{d}f} | {graph[i]:.{d}f} |"
            for i, (label, d) in enumerate(zip(LABELS, DIGITS, strict=True))
        ),
    ]


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    return [line for phase in PHASES for line in value_table(one_seed((phase, 0)))]


def table(phase: int, runs: list[dict[str, Run]], bound: np.ndarray) -> list[str]:
    """Return the Markdown of one phase."""
    by = {name: [r[name] for r in runs] for name in runs[0]}
    kalman, graph = by["Kalman point-set"], by["factor graph"]
    low, high = nees_band(7, len(runs))
    out = [
        f"## Sway phase {phase}°",
        "",
        "Values: the paper's, and ours of seed 0.",
        "",
        *value_table(runs[0]),
    ]
    paper = 100.0 * np.mean(1.0 - np.abs(PAPER - TRUTH) / TRUTH)
    out += [
        f"| mean accuracy, {len(runs)} seeds | | {paper:.2f} % (one run) "
        f"| {np.mean([r.accuracy for r in kalman]):.2f} % "
        f"| {np.mean([r.accuracy for r in graph]):.2f} % |",
        "",
        f"RMS errors over {len(runs)} seeds, the Cramér-Rao bound of all data together, and "
        "RMS(error / σ):",
        "",
        "| | bound | factor graph | Kalman point-set | Kalman / graph "
        "| error/σ graph | error/σ Kalman | error/σ least squares |",
        "|---|---|---|---|---|---|---|---|",
    ]
    e_kalman, e_graph = rms(kalman), rms(graph)
    q = {name: ratio(each) for name, each in by.items()}
    out += [
        f"| {label} | {bound[i]:.2g} | {e_graph[i]:.2g} | {e_kalman[i]:.2g} "
        f"| {e_kalman[i] / e_graph[i]:.1f} | {q['factor graph'][i]:.2f} "
        f"| {q['Kalman point-set'][i]:.2f} | {q['least squares'][i]:.2f} |"
        for i, label in enumerate(LABELS)
    ]
    out += [
        "",
        f"Mean NEES of the seven parameters, 7 expected ({low:.1f} to {high:.1f} is chance): "
        + ", ".join(f"{name} {np.mean([r.nees for r in each]):.1f}" for name, each in by.items())
        + ".",
        "",
    ]
    return out


def settling_section(runs: dict[int, list[Settling]]) -> list[str]:
    """Return the Markdown of how the point-set filter settled, over many seeds."""
    out = [
        "## Whether the point-set filter settles",
        "",
        f"`kalman` on {len(runs[PHASES[0]])} seeds at each sway phase. *Step*: the largest change "
        f"from ping to ping after {SMOOTH_AFTER_S:g} s, over all seeds. *Left*: the largest "
        "difference between what one pass ends with and the solution, at which further steps no "
        "longer move. *Error*: the largest of the solution.",
        "",
        "| | "
        + " | ".join(f"{what}, {p}°" for p in runs for what in ("step", "left", "error"))
        + " |",
        "|---" * (1 + 3 * len(runs)) + "|",
    ]
    for i, label in enumerate(LABELS):
        cells = [
            f"{max(abs(getattr(run, name)[i]) for run in each):.2g}"
            for each in runs.values()
            for name in ("steps", "apart", "error")
        ]
        out.append(f"| {label} | {' | '.join(cells)} |")
    for phase, each in runs.items():
        accuracy = [run.accuracy for run in each]
        out += [
            "",
            f"Phase {phase}°: settled on {sum(run.converged for run in each)} of {len(each)} "
            f"seeds; accuracy {np.mean(accuracy):.2f} % on average, {min(accuracy):.2f} % at "
            "least.",
        ]
    return [*out, ""]


INTRODUCTION = """\
# The simulation of Luo et al. (2024), by its method and by ours

{origin}

The scenario is that of the paper's table 4 (`configs/seed-a-phase-0.yaml` and `-90.yaml`; the
paper does not state the phase between roll and pitch). *Kalman point-set* is `kalman`: a filter
of the paper's seven states over SINS/GNSS velocities that settles. The printed filter is
`kalman --method luo-2024` ([`kalman.md`](kalman.md)). *Factor graph* is
`factorgraph-dvl solve`. *Least squares* fits the same point sets by Gauss-Newton. None of them
knows the initial attitude. The *bound* is the covariance of the joint estimate at the
noise-free solution: no unbiased estimator from all the data does better.

RMS(error / σ) shows whose σ is right: the expected value is 1, and {low:.2f} to {high:.2f} is
chance with {seeds} seeds (99.7 %). The point-set methods treat the error of the SINS/GNSS velocity
as white noise. It is correlated over tens of seconds, so the mean of many pings has a larger error
than their σ.
"""


def main() -> None:
    """Run the study and write its page."""
    parser = common.parser(__doc__, seeds=20)
    parser.add_argument(
        "--filter-seeds", type=int, default=100, help="number for the point-set filter (100)"
    )
    args = common.parse(parser)
    chance = np.sqrt(np.array(nees_band(1, args.seeds, level=0.997)))
    page = INTRODUCTION.format(
        origin=args.origin, seeds=args.seeds, low=chance[0], high=chance[1]
    ).splitlines()
    page.append("")
    with common.pool(args.jobs) as pool:
        curves = dict(zip(PHASES, pool.map(convergence, PHASES), strict=True))
        bounds = dict(zip(PHASES, pool.map(cramer_rao, PHASES), strict=True))
        for phase in PHASES:
            runs = list(pool.map(one_seed, [(phase, seed) for seed in range(args.seeds)]))
            page += table(phase, runs, bounds[phase])
            print("\n".join(page[-25:]), flush=True)
        tasks = {phase: [(phase, seed) for seed in range(args.filter_seeds)] for phase in PHASES}
        page += settling_section({p: list(pool.map(filtered, each)) for p, each in tasks.items()})
    draw(curves, args.out / "images" / "luo-2024-convergence.png")
    page += [
        "## Convergence",
        "",
        "Seed 0. The filters as they run; the factor graph solved anew on the data so far. "
        "The nine-state filter is given the true lever arm, which its model does not have.",
        "",
        "![Estimates over time, by filter and factor graph](images/luo-2024-convergence.png)",
    ]
    common.write_page(args.out / PAGE, page)


if __name__ == "__main__":
    main()
