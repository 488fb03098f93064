"""What becomes of a trial with a fault: errors, verdict, and the reason that comes first.

    python benchmarks/faults.py [--seeds 1] [--only REGEX] [--cache DIR] [--jobs 2] [--out DIR]

writes `faults.md` into out/benchmarks, or with `--out docs` that of the documentation. Each run
has a process of its own, and a file in the cache (out/benchmarks/faults): a run that is there is
not made again. Faults that took longer than 15 s of CPU are made with the first seed alone.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from fault_rows import MOTIONS, ROWS, SCENARIOS, Row

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.cli.exit_codes import exit_code_of
from factorgraph_dvl.errors import FactorgraphDvlError
from factorgraph_dvl.files.trial_folder import load_trial, save_trial
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.simulation import faults as f
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.batch import solve_with_problem
from factorgraph_dvl.solvers.levenberg_marquardt import minimise
from factorgraph_dvl.solvers.preparation import mounted_start, prepare
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL
from factorgraph_dvl.trial import Trial

PAGE = "faults.md"
# A run that takes longer, s, has hung.
LONGEST_S = 900.0
# CPU, s, up to which a fault is made with every seed.
ONCE_S = 15.0
# Errors, in standard deviations, and noncentrality, from which on a fault must be seen.
LARGE, SEEN = 5.0, 30.0
# Difference of objectives that is none.
SAME = 0.1
# Time between two looks at the processes, s: a run takes longer.
LOOK_S = 0.2


@dataclass(frozen=True)
class Run:
    """One trial to solve: scenario, fault and its level (None for an honest one), seed."""

    scenario: str
    row: Row | None
    level: Any
    seed: int

    @property
    def key(self) -> str:
        """Name that is unique among all runs, and that a file may have."""
        what = "honest" if self.row is None else f"{self.row.name} {self.level}"
        return re.sub(r"[^\w.+-]+", "-", f"{self.scenario} {what} {self.seed}")

    def trial(self) -> Trial:
        """Return the trial."""
        trial = simulate(parse_scenario(SCENARIOS[self.scenario]()), self.seed)
        return trial if self.row is None else f.with_faults(trial, self.row.make(self.level))


def outcome(run: Run) -> dict[str, Any]:
    """Solve a trial as its user would, from files."""
    try:
        made = run.trial()
    except FactorgraphDvlError as error:
        # No record may hold such values.
        return {"grade": "refused", "exit": exit_code_of(error), "reason": str(error)}
    with tempfile.TemporaryDirectory() as folder:
        save_trial(made, Path(folder) / "trial", parquet=True)
        start = time.process_time()
        try:
            trial = load_trial(Path(folder) / "trial")
            solution, solved = solve_with_problem(trial, rate_hz=1.0)
        except FactorgraphDvlError as error:
            return {"grade": "refused", "exit": exit_code_of(error), "reason": str(error)}
    seconds = time.process_time() - start
    again = common.objective_again(solved.problem, solved.minimum.evaluation)
    return {
        "cpu_s": round(seconds, 1),
        "rises": common.rises(solution),
        # What a problem made anew says of what the record of steps ends with.
        "again": again - solution.steps[-1].objective,
        **errors(solution, made),
        # Of interest where nothing is said: there it tells whether something could have been.
        "cost": _cost(trial) if solution.verdict.grade == "good" else np.nan,
        "grade": solution.verdict.grade,
        "reason": _named(solution),
        "all": [f"{r.code} {r.sensor} {r.parameter}: {r.text}" for r in solution.verdict.reasons],
        "notes": [
            f"{n.code} {n.sensor}: {n.text}" for n in solution.findings if n.severity == "note"
        ],
    }


def _named(solution: Solution) -> str:
    reasons = solution.verdict.reasons
    first = reasons[0] if reasons else None
    return "" if first is None else f"{first.code} {first.sensor} {first.parameter}: {first.text}"


def errors(solution: Solution, made: Trial) -> dict[str, Any]:
    """Return the largest errors in standard deviations, and which they are."""
    calibration = calibration_errors(solution, made.calibration_truth)
    ratio = np.abs(calibration.error) / calibration.std
    out = {
        "calibration": float(np.max(ratio)),
        "component": calibration.names[int(np.argmax(ratio))],
    }
    assert made.reference is not None
    motion = trajectory_errors(solution, made.reference)
    for name, vectors in (("position", motion.position), ("attitude", motion.attitude)):
        out[name] = float(np.max(np.abs(vectors.normalised)))
    return out


def _cost(trial: Trial) -> float:
    """Return the cost at the minimum with noise as stated, and nothing left out or freed."""
    prepared = prepare(trial, STATE_INTERVAL, _silent)
    states = prepared.start_positions.states[0]
    chain = prepared.chain(states)
    at_start = mounted_start(prepared, chain, states, _silent)
    states, values = at_start.states, at_start.values
    problem = Problem(chain, prepared.observations, prepared.parameters, start=values)
    at = problem.values(states, problem.prior_values() | values)
    return minimise(problem, at, stage="noise as stated").evaluation.cost


def _silent(stage: str, iteration: int, cost: float | None) -> None:
    """Report nothing."""


def _write(run: Run, path: Path) -> None:
    try:
        result = outcome(run)
    except Exception:
        result = {"grade": "crashed", "reason": traceback.format_exc().strip()[-800:]}
    result["commit"] = common.commit()
    path.write_text(json.dumps(result), encoding="utf-8")


def make(runs: Sequence[Run], args: Any) -> None:
    """Make the runs that are not in the cache, each in a process of its own."""
    left = [run for run in runs if not file_of(run, args.cache).exists()]
    going: list[tuple[Run, subprocess.Popen[bytes], float]] = []
    while left or going:
        while left and len(going) < args.jobs:
            command = [sys.executable, __file__, "--seeds", f"{args.seeds}", "--run", left[0].key]
            process = subprocess.Popen([*command, "--cache", str(args.cache)])
            going.append((left.pop(0), process, time.monotonic() + LONGEST_S))
        time.sleep(LOOK_S)
        for each in list(going):
            run, process, end = each
            if process.poll() is None and time.monotonic() > end:
                process.kill()
                process.wait()
            if process.returncode is None:
                continue
            going.remove(each)
            path = file_of(run, args.cache)
            if not path.exists():
                why = {"grade": "crashed", "reason": f"ended with {process.returncode}"}
                path.write_text(json.dumps(why), encoding="utf-8")


def file_of(run: Run, cache: Path) -> Path:
    """Return the file in the cache that has the result of a run."""
    return cache / f"{run.key}.json"


def _is_short(run: Run, cache: Path) -> bool:
    """Whether the same with the first seed took little time."""
    first = json.loads(file_of(replace(run, seed=0), cache).read_text("utf-8"))
    return run.row is None or not first.get("cpu_s", 0.0) > ONCE_S


def worst(found: dict[str, Any]) -> float:
    """Return the largest error of a result, in standard deviations."""
    return float(max(found.get(name, np.nan) for name in ("calibration", "position", "attitude")))


def is_named(run: Run, found: dict[str, Any]) -> bool:
    """Whether the first reason names the fault."""
    assert run.row is not None
    axis = "xyz"[run.level] if run.row.unit == "axis" else ""
    patterns = (p.replace("{axis}", axis) for p in run.row.named)
    return any(re.search(p, found["reason"], re.IGNORECASE) for p in patterns)


INTRODUCTION = """\
# Faults, and what is said of them

{origin}

Each row is a fault that a simulated trial has on top of its honest errors, solved from its files
as its user would. Where no key says otherwise, clocks, antenna and DVL bias are estimated.
*Error* is the largest one over calibration, position and attitude, in standard deviations, and
over seeds. A fault that took longer than 15 s of CPU is made with one seed.
Position and attitude count every second, so 4 is chance. λ is the noncentrality of the fault:
twice the cost that it adds at the minimum with noise as stated. *Named* says whether the first
reason is the true cause. λ is worked out for results that are graded good, and is negative where
measurements are missing. Scenarios:

"""


def page(origin: str, runs: Sequence[tuple[Run, dict[str, Any]]]) -> list[str]:
    """Return the lines of the page."""
    honest = {(r.scenario, r.seed): found for r, found in runs if r.row is None}
    faulty = [(r, found, _added(r, found, honest)) for r, found in runs if r.row is not None]
    return [
        *INTRODUCTION.format(origin=origin).splitlines(),
        *(f"- {name}: {MOTIONS[name]}" for name in dict.fromkeys(r.scenario for r, _ in runs)),
        "",
        *summary(faulty),
        "",
        *table(faulty),
    ]


def _added(run: Run, found: dict[str, Any], honest: dict[Any, Any]) -> float:
    before = honest.get((run.scenario, run.seed), {})
    return 2.0 * (found.get("cost", np.nan) - before.get("cost", np.nan))


def summary(faulty: Sequence[tuple[Run, dict[str, Any], float]]) -> list[str]:
    """Return the counts."""
    silent = [x for x in faulty if x[1]["grade"] == "good" and worst(x[1]) > LARGE]
    seen = [x for x in silent if not x[2] < SEEN]
    crashed = [x for x in faulty if x[1]["grade"] == "crashed"]
    graded = [x for x in faulty if x[1]["grade"] in ("doubtful", "do not use", "refused")]
    named = [x for x in graded if is_named(x[0], x[1])]
    return [
        f"Of {len(faulty)} runs {len(graded)} are graded other than good; the first reason is the "
        f"true cause in {len(named)} of these ({100.0 * len(named) / max(len(graded), 1):.0f} %). "
        f"{len(silent)} with an error above {LARGE:g} σ are graded good, {len(seen)} of them with "
        f"λ of {SEEN:g} or more. {len(crashed)} crashed.",
        "",
        *_commits([x[1] for x in faulty]),
        *_objectives([x[1] for x in faulty if "again" in x[1]]),
    ]


def _commits(found: Sequence[dict[str, Any]]) -> list[str]:
    """Return which code made the runs, where it was not the same for all."""
    counts = Counter(each.get("commit", "an earlier commit") for each in found)
    if len(counts) < 2:
        return []
    each = ", ".join(f"{count} are of {commit}" for commit, count in counts.most_common())
    return [f"The runs were made by several commits: {each}.", ""]


def _objectives(found: Sequence[dict[str, Any]]) -> list[str]:
    """Return what is said of the records of steps."""
    rises = sum(each["rises"] for each in found)
    same = sum(abs(each["again"]) < SAME for each in found)
    return [
        f"The objective rises from one step to the next {rises} times in the {len(found)} runs "
        "that are solved. A problem made anew, eliminated in another order, has the same "
        f"objective at the end within {SAME:g} in {same}.",
    ]


def table(faulty: Iterable[tuple[Run, dict[str, Any], float]]) -> list[str]:
    """Return the table of all faults, each with its seeds."""
    out = [
        "| scenario | fault | level | seeds | error, σ | λ | verdict | first reason | named |",
        "|---|---|---|---:|---:|---:|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[tuple[Run, dict[str, Any], float]]] = {}
    for each in faulty:
        groups.setdefault((each[0].scenario, _fault(each[0])), []).append(each)
    for (scenario, fault), every in groups.items():
        errors = [worst(found) for _, found, _ in every]
        graded = [(run, found) for run, found, _ in every if found["grade"] != "good"]
        named = sum(is_named(run, found) for run, found in graded)
        verdicts = Counter(found["grade"] for _, found, _ in every).most_common()
        reasons = Counter(
            "–" if found["grade"] == "refused" else found["reason"].split(":")[0].strip()
            for _, found in graded
        ).most_common()
        out.append(
            f"| {scenario} | {fault} | {len(every)} | {_largest(errors, '.2g')} "
            f"| {_largest([added for _, _, added in every], '.0f')} | {_counted(verdicts)} "
            f"| {_counted(reasons)} | {f'{named} of {len(graded)}' if graded else ''} |"
        )
    return out


def _fault(run: Run) -> str:
    """Return the fault and the level of a run, as two cells."""
    assert run.row is not None
    level = ", ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in _levels(run))
    return f"{run.row.name} | {level} {run.row.unit}"


def _largest(values: Sequence[float], digits: str) -> str:
    """Return the largest of values that are known."""
    known = [value for value in values if not np.isnan(value)]
    return f"{max(known):{digits}}" if known else "–"


def _counted(counts: Sequence[tuple[str, int]]) -> str:
    """Return words with how often each is there, where they are several."""
    if len(counts) == 1:
        return counts[0][0]
    return ", ".join(f"{word} ({count})" for word, count in counts)


def _levels(run: Run) -> tuple[Any, ...]:
    return run.level if isinstance(run.level, tuple) else (run.level,)


def all_runs(seeds: int) -> list[Run]:
    """Return all runs, the honest ones first."""
    out = []
    for scenario in SCENARIOS:
        for seed in range(seeds):
            out.append(Run(scenario, None, None, seed))
            out += [Run(scenario, row, level, seed) for row in ROWS for level in row.levels]
    return out


def main() -> None:
    """Run the study and write its page."""
    parser = common.parser(__doc__, seeds=1)
    parser.add_argument("--only", default="", help="regular expression of runs to make")
    parser.add_argument("--cache", type=Path, default=common.OUT / "faults", help="of the runs")
    parser.add_argument("--run", help="make this run alone, in this process")
    args = common.parse(parser)
    args.cache.mkdir(parents=True, exist_ok=True)
    if args.run is not None:
        (run,) = (each for each in all_runs(args.seeds) if each.key == args.run)
        _write(run, file_of(run, args.cache))
        return
    runs = [r for r in all_runs(args.seeds) if r.row is None or re.search(args.only, r.key)]
    wanted = {(r.scenario, r.seed) for r in runs if r.row is not None}
    runs = [r for r in runs if (r.scenario, r.seed) in wanted]
    make([run for run in runs if run.seed == 0], args)
    runs = [run for run in runs if run.seed == 0 or _is_short(run, args.cache)]
    make(runs, args)
    found = [(run, json.loads(file_of(run, args.cache).read_text("utf-8"))) for run in runs]
    print(common.write_page(args.out / PAGE, page(args.origin, found)))


if __name__ == "__main__":
    main()
