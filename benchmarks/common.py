"""What the benchmarks have in common: threads, arguments, folder, origin of a page.

Import it before NumPy, which reads the number of threads when it is loaded.
"""

from __future__ import annotations

import os

# One process for each core: more threads only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from factorgraph_dvl.analysis.error_statistics import calibration_errors
from factorgraph_dvl.campaign.cluster import connected
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.marginal_likelihood import restricted_objective
from factorgraph_dvl.trial import Trial

ROOT = Path(__file__).resolve().parents[1]
# Not tracked: a page of the documentation is only written where `--out` says so.
OUT = ROOT / "out" / "benchmarks"
SEVEN = (
    *(f"misalignment_{axis}_deg" for axis in "xyz"),
    "scale_error",
    *(f"lever_arm_{axis}_m" for axis in "xyz"),
)
# A sample of each page, which a test holds against the code: all of this seed.
SAMPLED_SEED = 0


def parser(doc: str | None, *, seeds: int | None = None) -> argparse.ArgumentParser:
    """Return a parser with what every benchmark takes; `seeds` is the default number."""
    out = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    out.add_argument("--out", type=Path, default=OUT, help="folder to write (out/benchmarks)")
    if seeds is not None:
        out.add_argument("--seeds", type=int, default=seeds, help=f"number ({seeds})")
        out.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    return out


def parse(parser: argparse.ArgumentParser, argv: Sequence[str] | None = None) -> Any:
    """Parse arguments, make the folder, and note in `origin` which code makes the page.

    Both at the start: a folder that cannot be written must not show after minutes, and the
    working tree may change meanwhile.
    """
    args = parser.parse_args(argv)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=args.out):
            pass
    except OSError as error:
        parser.error(f"--out: {args.out} cannot be written: {error.strerror}")
    options = {name: v for name, v in vars(args).items() if name not in ("out", "jobs", "cache")}
    command = " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *_given(options)])
    args.origin = f"Written by `{command}` from {commit()}; do not edit."
    return args


def _given(options: dict[str, Any]) -> Iterable[str]:
    for name, value in options.items():
        flag = "--" + name.replace("_", "-")
        if value is True:
            yield flag
        elif isinstance(value, list):
            yield from (f"{flag} {each}" for each in value)
        elif isinstance(value, Path):
            # Where a program lies on this machine is no part of a page.
            yield f"{flag} {value.name}"
        elif value not in (None, False, ""):
            yield f"{flag} {value}"


def commit() -> str:
    """Return the commit of the code that runs, and whether tracked files were changed."""

    def git(*command: str) -> str:
        run = ["git", "-C", str(ROOT), *command]
        return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return f"commit {git('rev-parse', '--short=10', 'HEAD')} " + (
            "with changes" if changed else "(clean tree)"
        )
    except (OSError, subprocess.CalledProcessError):
        return "an unknown commit"


def write_page(path: Path, lines: Iterable[str]) -> str:
    """Write a page of Markdown; return its text."""
    text = "\n".join(lines) + "\n"
    path.write_text(text, encoding="utf-8")
    return text


def sample_section(lines: Sequence[str]) -> list[str]:
    """Return the section with the numbers of one seed, which a test computes anew."""
    return ["", f"## Seed {SAMPLED_SEED} alone", "", *lines]


def config(name: str, /, **top: Any) -> dict[str, Any]:
    """Return a scenario of configs/ as plain data, with changes at the top level."""
    text = (ROOT / "configs" / f"{name}.yaml").read_text(encoding="utf-8")
    return {**yaml.safe_load(text), **top}


@contextmanager
def pool(jobs: int) -> Iterator[Executor]:
    """Yield as many workers of a campaign."""
    with connected(jobs, None) as client:
        yield client.get_executor(pure=False)


def kept_runs(
    args: Any, name: str, wanted: Iterable[tuple[Any, ...]], run: Callable[..., dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return what a function says of each run, with those that were kept for the same commit.

    Parameters
    ----------
    args : Namespace
        Folder and number of processes.
    name : str
        Name of the file in the folder, JSON by line, which a run joins when it is done.
    wanted : iterable of tuple
        Arguments of each run.
    run : callable
        What becomes of them.
    """
    path = args.out / name
    own, kept = commit(), {}
    for line in path.read_text("utf-8").splitlines() if path.exists() else ():
        saved = json.loads(line)
        if saved["commit"] == own:
            kept[tuple(saved["of"])] = saved["is"]
    wanted = list(wanted)
    with pool(args.jobs) as executor, path.open("a", encoding="utf-8") as file:
        running = {executor.submit(run, *each): each for each in wanted if each not in kept}
        for number, future in enumerate(as_completed(running), start=1):
            each = running[future]
            kept[each] = future.result()
            file.write(json.dumps({"commit": own, "of": each, "is": kept[each]}) + "\n")
            file.flush()
            print(f"{number} of {len(running)}:", *each, flush=True)
    return [kept[each] for each in wanted]


def rises(solution: Solution) -> int:
    """Return how often the objective rises from one step to the next."""
    return int(np.sum(np.diff([step.objective for step in solution.steps]) > 0.0))


def objective_again(problem: Problem, evaluation: Evaluation) -> float:
    """Return the objective at a minimum, by a problem made anew and another elimination."""
    again = Problem(
        problem.chain,
        problem.observations,
        problem.all_parameters,
        # Which measurements the chain covers goes by where clocks were then.
        start=problem.bound_at,
        clock_zero=problem.clock_zero,
        processes=problem.processes,
        tilt=problem.tilt,
    )
    again.reject(problem.rejected)
    again.noise_factors, again.noise_growth = problem.noise_factors, problem.noise_growth
    again.long_run, again.gain = problem.long_run, problem.gain
    again.robust_weights = problem.robust_weights
    for bound, weight in zip(again.bound, problem.weights, strict=True):
        bound.weight = weight
    again.usual_costs = problem.usual_costs
    there = again.evaluate(evaluation.values)
    graph = again.linearize(there)
    last = [*problem.chain.constants, *(problem.key(p.name) for p in problem.parameters)]
    order = gtsam.Ordering.ColamdGaussianFactorGraph(graph)
    first = [key for key in map(order.at, range(order.size())) if key not in set(last)]
    information = eliminated(graph, keys.ordering([*first, *last]), there.values.dims())
    return float(restricted_objective(again, there, information))


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches."""
    figure = Figure(figsize=(width, height), dpi=110)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure into a folder that may not be there yet."""
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def rms(values: Any) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def nees(solution: Solution, truth: Mapping[str, Any]) -> float:
    """Return NEES/7 of misalignment, scale and lever arm; NaN where one is not estimated."""
    error = calibration_errors(solution, truth)
    own = [error.names.index(name) for name in SEVEN if name in error.names]
    if len(own) < len(SEVEN):
        return np.nan
    at = [solution.order.index(name) for name in SEVEN]
    e = error.error[own]
    return float(e @ np.linalg.solve(solution.covariance[np.ix_(at, at)], e)) / len(SEVEN)


def until(trial: Trial, end: float) -> Trial:
    """Return a trial's records up to a time, without what the result is compared with."""
    return replace(trial.until(end + 1e-6), reference=None)


def cpu_name() -> str:
    """Return the model of the processor."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown CPU"


def machine() -> str:
    """Return what a timing was measured on, and how busy that was."""
    cores = len(os.sched_getaffinity(0))
    return f"{cpu_name()}, {cores} of {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
