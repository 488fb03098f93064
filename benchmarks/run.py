"""Measure speed, memory and integration error.

    python benchmarks/run.py [--long] [--kf-gins PATH] [--against COMMIT] [--out DIR]

writes `results.md` into out/benchmarks, or with `--out benchmarks` that of the repository.

Figures that are compared with each other are measured in the same run, alternating, so
that a busy machine does not favour either. `--long` adds a trial eight times as long, and
one of a day in Parquet, which take a quarter of an hour and two gigabytes of disk.
`--kf-gins` is the program of that name, and `--against` a commit of this repository: both run in
turn with the cruise.
"""

from __future__ import annotations

import json
import os
import platform
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import common
import gtsam
import kf_gins
import numpy as np
import yaml
from common import ROOT

from factorgraph_dvl import load_trial
from factorgraph_dvl.geometry.earth import RATE, enu_from_ecef
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG_PER_HOUR
from factorgraph_dvl.graph.inertial_chain import InertialChain, inertial_chain
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.preintegration import segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.initialization.in_motion_alignment import initial_states
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.simulation import parse_scenario, plan_motion, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.information_along_trial import solve_with_history
from factorgraph_dvl.solvers.levenberg_marquardt import minimise, quick_step
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL
from factorgraph_dvl.trial import Trial

PAGE = "results.md"
SHIPPED = ROOT / "data" / "seed-a-phase-90"
CRUISE = ROOT / "configs" / "cruise.yaml"
CONING = ROOT / "configs" / "seed-a-phase-90.yaml"
TIMES_AS_LONG = 8
# A day at 100 Hz.
TIMES_A_DAY = 18
ITERATIONS = 9
NATIVE_ITERATIONS = 5
HISTORY_RUNS = 3

MIB = 2**20


@dataclass(frozen=True)
class Run:
    """A finished process: wall and CPU time in s, peak memory in bytes, stages in s."""

    wall: float
    cpu: float
    peak: int
    stages: dict[str, float]


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--long", action="store_true", help="add trials 8 and 18 times as long")
    parser.add_argument("--kf-gins", type=Path, help="program that runs in turn with the cruise")
    parser.add_argument("--against", help="commit that runs in turn with the cruise")
    args = common.parse(parser)
    load = os.getloadavg()[0]
    lines: list[str] = []
    for title, rows in (
        ("Command line", command_line()),
        # While this process is small.
        ("In turn with others", others(args.kf_gins, args.against)),
        (f"Calibration cruise of {cruise_duration():.0f} s", cruise(long=args.long)),
        ("Coning and sculling", coning()),
    ):
        print(f"\n{title}", flush=True)
        lines += [f"\n## {title}\n", "| what | measured | limit |", "|---|---|---|"]
        for row in rows:
            print("  " + " | ".join(row), flush=True)
            lines.append("| " + " | ".join(row) + " |")
    common.write_page(args.out / PAGE, [*header(args.origin, load), *lines])
    print(f"\nwrote {args.out / PAGE}")


def header(origin: str, load: float) -> list[str]:
    packages = ("factorgraph-dvl", "gtsam", "numpy", "scipy", "pyarrow", "matplotlib")
    return [
        "# Benchmark results\n",
        f"{origin}\n",
        f"- date: {date.today().isoformat()}",
        f"- machine: {common.cpu_name()}, {len(os.sched_getaffinity(0))} cores used of "
        f"{os.cpu_count()}, {total_memory() / 2**30:.0f} GiB",
        f"- load of the machine at the start, 1 min: {load:.1f}",
        f"- system: {platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "- packages: " + ", ".join(f"{name} {version(name)}" for name in packages),
    ]


def total_memory() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def command_line() -> Iterator[tuple[str, str, str]]:
    helps, imports = [], []
    for _ in range(7):
        helps.append(run_python("-m", "factorgraph_dvl.cli", "--help")[0].cpu)
        imports.append(run_python("-c", "import typer, rich")[0].cpu)
    yield "`--help`, CPU time, median of 7", f"{median(helps):.2f} s", "1 s"
    yield (
        "**over that of importing Typer and Rich**",
        f"{median(helps) / median(imports):.2f}",
        "2.5",
    )
    with temporary_folder() as folder:
        runs = [run_cli("solve", SHIPPED, "--out", folder / f"{i}") for i in range(3)]
    yield (
        "shipped trial, files to files with figures, median of 3",
        f"{median(r.wall for r in runs):.1f} s",
        "10 s",
    )
    yield "peak memory of that", f"{max(r.peak for r in runs) / MIB:.0f} MiB", ""


def native_workload(samples: int = 480_000, rate: int = 100) -> float:
    """Return the time of a fixed task for GTSAM alone, s: no code of this package.

    IMU samples of a straight run into segments of a second, a position for each, five iterations.
    """
    X, V, B = (partial(gtsam.symbol, letter) for letter in "xvb")
    nodes = samples // rate
    rng = np.random.default_rng(0)
    force = list(0.01 * rng.standard_normal((samples, 3)) + [0.0, 0.0, 9.81])
    turn = list(1e-5 * rng.standard_normal((samples, 3)))
    place = np.outer(np.arange(nodes + 1), [4.0, 0.0, 0.0]) + rng.standard_normal((nodes + 1, 3))
    start = perf_counter()
    parameters = gtsam.PreintegrationParams.MakeSharedU(9.81)
    parameters.setGyroscopeCovariance(1e-8 * np.eye(3))
    parameters.setAccelerometerCovariance(1e-4 * np.eye(3))
    parameters.setIntegrationCovariance(1e-8 * np.eye(3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fix = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    bias = gtsam.imuBias.ConstantBias()
    for k in range(nodes):
        segment = gtsam.PreintegratedImuMeasurements(parameters, bias)
        for i in range(k * rate, (k + 1) * rate):
            segment.integrateMeasurement(force[i], turn[i], 1.0 / rate)
        graph.add(gtsam.ImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(0), segment))
    level = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-2, 10.0], 3))
    for k in range(nodes + 1):
        graph.add(gtsam.GPSFactor(X(k), place[k], fix))
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(), place[k]))
        values.insert(V(k), np.array([4.0, 0.0, 0.0]))
    values.insert(B(0), bias)
    graph.add(gtsam.PriorFactorPose3(X(0), values.atPose3(X(0)), level))
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
    for _ in range(NATIVE_ITERATIONS):
        step = graph.linearize(values).optimize(ordering)
        values = values.retract(step)
    return perf_counter() - start


def cruise(*, long: bool) -> Iterator[tuple[str, str, str]]:
    with temporary_folder() as folder:
        trial_folder = folder / "cruise"
        simulated = run_cli("simulate", CRUISE, "--out", trial_folder, "--seed", 1)
        yield "simulate, CSV", f"{simulated.wall:.1f} s", ""
        trial = load_trial(trial_folder)
        yield (
            "samples: IMU, GNSS, DVL",
            ", ".join(str(s.time.size) for s in (trial.imu, trial.gnss, trial.dvl) if s),
            "",
        )
        runs = [run_cli("solve", trial_folder, "--out", folder / f"{i}") for i in range(2)]
        once = min(runs, key=lambda r: r.wall)
        yield "**solve, files to files with figures**, better of 2", f"{once.wall:.1f} s", "20 s"
        for stage, seconds in once.stages.items():
            yield f"– {stage}", f"{seconds:.2f} s", ""
        yield "CPU time of that", f"{once.cpu:.1f} s", ""
        yield "peak memory", f"{max(r.peak for r in runs) / 1e9:.2f} GB", "0.7 GB"
        settings = trial_folder / "trial.yaml"
        text = settings.read_text(encoding="utf-8")
        stated = re.sub("^noise: .*$", "noise: stated", text, count=1, flags=re.MULTILINE)
        settings.write_text(stated, encoding="utf-8")
        least = run_cli("solve", trial_folder, "--out", folder / "stated", "--no-figures")
        settings.write_text(text, encoding="utf-8")
        yield "solve with `noise: stated` and `--no-figures`", f"{least.wall:.1f} s", ""
        yield "peak memory of that", f"{least.peak / 1e9:.2f} GB", ""
        native = min(native_workload() for _ in runs)
        yield "fixed task for GTSAM alone, better of 2", f"{native:.2f} s", ""
        yield "**ratio of solve to it**", f"{once.wall / native:.2f}", ""
        yield "ratio with `noise: stated` and `--no-figures`", f"{least.wall / native:.2f}", ""
        yield from iteration_times(trial)
        yield from history_times(trial)
        del trial
        if long:
            yield from times_as_long(folder, once, TIMES_AS_LONG, ("9", ""))
            yield from times_as_long(folder, once, TIMES_A_DAY, ("19", "5 GB"), "--parquet")


def others(program: Path | None, commit: str | None) -> Iterator[tuple[str, str, str]]:
    """Run trials in turn with KF-GINS and with another commit: CPU and wall time, better of 2."""
    if program is None:
        yield "KF-GINS", "not measured (`--kf-gins`)", ""
    if commit is None:
        yield "an earlier commit", "not measured (`--against`)", ""
    with temporary_folder() as folder, checked_out(commit, folder / "against") as source:
        config = yaml.safe_load(CRUISE.read_text(encoding="utf-8"))
        config["trial"] = {"imu": config["trial"]["imu"]}
        everything = folder / "everything.yaml"
        everything.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
        plans = {"cruise": CRUISE, "everything": everything}
        # Each program has trials that it wrote itself: keys differ.
        own = trials_of(plans, folder / "own", None)
        theirs = {} if source is None else trials_of(plans, folder / "theirs", source)
        for number, (what, name, more) in enumerate(
            (
                ("cruise, files to files with figures", "cruise", ()),
                ("cruise, `--no-figures`", "cruise", ("--no-figures",)),
                ("cruise with clocks, antenna and DVL bias estimated", "everything", ()),
                ("shipped trial, files to files with figures", SHIPPED.name, ()),
            )
        ):
            runs: dict[str, Callable[[Path], Run]] = {"": partial(solved, own[name], more, None)}
            if source is not None:
                runs[f"commit {commit}"] = partial(solved, theirs[name], more, source)
            if program is not None and name == "cruise":
                runs["KF-GINS"] = partial(filtered, program, own[name])
            yield from ratios(what, in_turn(runs, folder / f"{number}"))


def trials_of(plans: Mapping[str, Path], folder: Path, source: Path | None) -> dict[str, Path]:
    """Simulate plans with this package, or that of another folder; return all trials by name."""
    folder.mkdir()
    out = {name: folder / name for name in plans}
    for name, plan in plans.items():
        arguments = ("simulate", f"{plan}", "--out", f"{out[name]}", "--seed", "1")
        run_python("-m", "factorgraph_dvl.cli", *arguments, source=source)
    return out | {SHIPPED.name: (source or ROOT) / SHIPPED.relative_to(ROOT)}


def ratios(what: str, best: Mapping[str, Run]) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of programs that ran in turn; the first one has no name."""
    own = best[""]
    for name, run in best.items():
        label = what if run is own else f"– {name}"
        taken = f"CPU {run.cpu:.1f} s, wall {run.wall:.1f} s"
        # A child begins with the memory of this process.
        least = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        yield label, f"{taken}, {run.peak / 1e9:.2f} GB" if run.peak > least else taken, ""
        if run is not own:
            compared = f"CPU {own.cpu / run.cpu:.2f}, wall {own.wall / run.wall:.2f}"
            yield f"**– ratio to {name}**", compared, ""


def in_turn(runs: Mapping[str, Callable[[Path], Run]], folder: Path) -> dict[str, Run]:
    """Return the better of two runs of each program, by CPU time."""
    taken: dict[str, list[Run]] = {name: [] for name in runs}
    for turn in range(2):
        for number, (name, run) in enumerate(runs.items()):
            taken[name].append(run(folder / f"{number}-{turn}"))
    return {name: min(times, key=lambda run: run.cpu) for name, times in taken.items()}


def solved(trial: Path, more: tuple[str, ...], source: Path | None, out: Path) -> Run:
    """Solve a trial with this package, or with that of another folder."""
    out.parent.mkdir(exist_ok=True)
    arguments = ("solve", f"{trial}", "--out", f"{out}", *more)
    return run_python("-m", "factorgraph_dvl.cli", *arguments, source=source)[0]


def filtered(program: Path, trial: Path, out: Path) -> Run:
    """Run KF-GINS over a trial."""
    kf_gins.write_inputs(load_trial(trial), out)
    return run_program([f"{program.resolve()}", kf_gins.CONFIGURATION], cwd=out)[0]


@contextmanager
def checked_out(commit: str | None, folder: Path) -> Iterator[Path | None]:
    """Yield a folder with another commit of this repository, None without one."""
    if commit is None:
        yield None
        return
    git = ["git", "-C", f"{ROOT}", "worktree"]
    subprocess.run([*git, "add", "--quiet", "--detach", f"{folder}", commit], check=True)
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", f"{folder}"], check=True)


def iteration_times(trial: Trial) -> Iterator[tuple[str, str, str]]:
    """Time Gauss-Newton iterations of the same chain with and without the DVL."""
    frame = trial.frame()
    inc, _ = increments(trial.imu)
    seg = segments(inc, STATE_INTERVAL)
    start = initial_states(trial, frame, seg).states
    chain = inertial_chain(trial, frame, seg, start)
    assert trial.gnss is not None
    assert trial.dvl is not None
    without = problem_of(trial, chain, (trial.gnss,))
    minimum = minimise(without, values_of(without, start, {}), stage="GNSS")
    states = minimum.evaluation.states
    both = problem_of(trial, chain, (trial.gnss, trial.dvl))
    values = {
        "without": values_of(without, states, {}),
        "with": values_of(both, states, true_parameters(both, trial)),
    }
    problems = {"without": without, "with": both}
    for name, problem in problems.items():
        problem.weigh(problem.evaluate(values[name]))
    orderings = {name: problem.ordering() for name, problem in problems.items()}
    taken: dict[str, list[dict[str, float]]] = {"without": [], "with": []}
    for _ in range(ITERATIONS + 1):
        for name, problem in problems.items():
            t0 = perf_counter()
            evaluation = problem.evaluate(values[name])
            t1 = perf_counter()
            gaussian = problem.linearize(evaluation)
            t2 = perf_counter()
            delta = quick_step(gaussian, orderings[name])
            values[name] = evaluation.values.retract(delta)
            t3 = perf_counter()
            taken[name].append(
                {
                    "all": t3 - t0,
                    "evaluate": t1 - t0,
                    "linearise": t2 - t1,
                    "eliminate and solve": t3 - t2,
                }
            )
    # The first is the only one that allocates.
    medians = {
        name: {part: median(t[part] for t in times[1:]) for part in times[0]}
        for name, times in taken.items()
    }
    for name in ("without", "with"):
        _, *parts = [f"{part} {s * 1e3:.0f}" for part, s in medians[name].items()]
        yield (
            f"solver iteration {name} the DVL, median of {ITERATIONS}",
            f"{medians[name]['all'] * 1e3:.0f} ms ({', '.join(parts)})",
            "",
        )
    ratio = medians["with"]["all"] / medians["without"]["all"]
    yield "**ratio of the two**", f"{ratio:.2f}", "1.3"


def history_times(trial: Trial) -> Iterator[tuple[str, str, str]]:
    """Time a solve with and without σ of the calibration along the trial, in turn."""
    taken: dict[str, list[float]] = {"without": [], "with": []}
    for _ in range(HISTORY_RUNS):
        for name, run in (("without", solve), ("with", solve_with_history)):
            start = perf_counter()
            run(trial)
            taken[name].append(perf_counter() - start)
    best = {name: min(times) for name, times in taken.items()}
    yield f"solve in this process, best of {HISTORY_RUNS}", f"{best['without']:.2f} s", ""
    yield "the same with σ at every state along the trial", f"{best['with']:.2f} s", ""
    yield "**ratio of these two**", f"{best['with'] / best['without']:.2f}", "2"


def problem_of(trial: Trial, chain: InertialChain, aids: tuple[Aid, ...]) -> Problem:
    observations = [o for aid in aids for o in aid.observations(chain.frame, trial.body_axes)]
    parameters = [p for aid in aids for p in aid.parameters()]
    return Problem(chain, observations, parameters)


def values_of(problem: Problem, states: States, parameters: dict[str, np.ndarray]) -> Any:
    return problem.values(states, {**problem.prior_values(), **parameters})


def true_parameters(problem: Problem, trial: Trial) -> dict[str, np.ndarray]:
    out = {}
    for p in problem.parameters:
        value = trial.calibration_truth[p.name] * p.si
        out[p.name] = exp_so3(value) if p.rotation else np.broadcast_to(value, p.mean.shape).copy()
    return out


def times_as_long(
    folder: Path, once: Run, times: int, limits: tuple[str, str], *more: str
) -> Iterator[tuple[str, str, str]]:
    """Solve a cruise some times as long; limits of the ratio of times and of memory."""
    data = yaml.safe_load(CRUISE.read_text(encoding="utf-8"))
    name = f"cruise-{times}"
    data["name"] = name
    data["manoeuvres"] = [{"repeat": times, "manoeuvres": data["manoeuvres"]}]
    config = folder / f"{name}.yaml"
    config.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    simulated = run_cli("simulate", config, "--out", folder / name, "--seed", 1, *more)
    yield f"simulate a cruise {times} times as long", f"{simulated.wall:.0f} s", ""
    run = run_cli("solve", folder / name, "--out", folder / f"{name}-solved")
    yield "solve it, files to files with figures", f"{run.wall:.1f} s", ""
    for stage, seconds in run.stages.items():
        yield f"– {stage}", f"{seconds:.2f} s", ""
    yield f"**times the cruise of 1/{times}**", f"{run.wall / once.wall:.2f}", limits[0]
    yield "peak memory", f"{run.peak / 1e9:.2f} GB", limits[1]


def coning() -> Iterator[tuple[str, str, str]]:
    """Compare integrated with true attitude, without noise and biases."""
    data = yaml.safe_load(CONING.read_text(encoding="utf-8"))
    data["noise"] = False
    data["imu"].update(gyro_bias_deg_h=[0, 0, 0], accel_bias_ug=[0, 0, 0])
    for label, sampling, manoeuvres in (
        ("whole scenario, `mean` samples", "mean", data["manoeuvres"]),
        ("at rest for 300 s, `mean` samples", "mean", [{"straight_s": 300}]),
        (
            "at rest for 300 s, `instantaneous` samples",
            "instantaneous",
            [{"straight_s": 300}],
        ),
    ):
        own = {**data, "manoeuvres": manoeuvres, "imu": {**data["imu"], "sampling": sampling}}
        scenario = parse_scenario(own)
        trial = simulate(scenario)
        inc, _ = increments(trial.imu)
        phi, _dv = inc.over(np.arange(inc.dt.size))
        ends = np.array([inc.start[0], inc.end[-1]])
        state = plan_motion(scenario).at(ends)
        nRb = rotation_from_rph(state.rph, scenario.body_axes)
        spin = exp_so3(np.outer(ends, [0.0, 0.0, RATE]))
        lat, lon = state.geodetic[:, 0], state.geodetic[:, 1]
        iRb = spin @ enu_from_ecef(lat, lon).transpose(0, 2, 1) @ nRb
        gyro = trial.imu.gyro[-inc.dt.size :]
        drifts = []
        for steps in (gyro * inc.dt[:, None], phi):
            turned = iRb[0] @ chained(exp_so3(steps))
            error = log_so3(turned @ iRb[1].T)
            drifts.append(float(np.linalg.norm(error)) / (ends[1] - ends[0]) / DEG_PER_HOUR)
        limit = "" if sampling == "instantaneous" else "0.02 deg/h"
        yield f"{label}: one rate per sample", f"{drifts[0]:.2f} deg/h", ""
        yield f"{label}: this package", f"{drifts[1]:.1e} deg/h", limit


def chained(turns: np.ndarray) -> np.ndarray:
    """Return the product of rotations (N, 3, 3), by pairs."""
    while turns.shape[0] > 1:
        if turns.shape[0] % 2:
            turns = np.concatenate([turns, np.eye(3)[None]])
        turns = turns[::2] @ turns[1::2]
    return np.asarray(turns[0])


def cruise_duration() -> float:
    return float(plan_motion(parse_scenario(yaml.safe_load(CRUISE.read_text()))).duration)


def run_cli(*args: object) -> Run:
    """Run the command line in a process of its own."""
    run, log = run_python("-m", "factorgraph_dvl.cli", "--json", *map(str, args))
    return replace(run, stages=stages_of(log, run.wall))


def run_python(*args: str, source: Path | None = None) -> tuple[Run, str]:
    """Run Python, with the package of another folder if one is given, as `run_program`."""
    environment = None if source is None else os.environ | {"PYTHONPATH": f"{source}"}
    return run_program([sys.executable, *args], env=environment, cwd=source)


def run_program(command: list[str], **how: Any) -> tuple[Run, str]:
    """Run a program in a process of its own; return what it took and what it printed."""
    with tempfile.TemporaryFile("w+") as log:
        start = perf_counter()
        process = subprocess.Popen(command, stdout=log, stderr=log, **how)
        # Of this child alone: getrusage knows only the largest of all children.
        _, status, usage = os.wait4(process.pid, 0)
        wall = perf_counter() - start
        log.seek(0)
        text = log.read()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{text}")
    return Run(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024, {}), text


def stages_of(log: str, wall: float) -> dict[str, float]:
    """Return how long each stage took, from the events of progress that `solve` prints."""
    began: list[tuple[str, float]] = []
    for line in log.splitlines():
        event = json.loads(line) if line.startswith('{"event":"progress"') else None
        if event and (not began or began[-1][0] != event["stage"]):
            began.append((event["stage"], event["elapsed_s"]))
    out: dict[str, float] = {}
    for (stage, at), (_, until) in pairwise([*began, ("", wall)]):
        name = stage if until != wall else f"{stage}, figures, start and end of the process"
        out[name] = out.get(name, 0.0) + until - at
    return out


@contextmanager
def temporary_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="factorgraph-dvl-benchmark-") as name:
        yield Path(name)


if __name__ == "__main__":
    main()
