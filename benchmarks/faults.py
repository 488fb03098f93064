"""What becomes of a trial with a fault: errors, verdict, and the reason that comes first.

    python benchmarks/faults.py [--seeds 1] [--only REGEX] [--cache DIR] [--jobs 2] [--out DIR]

writes `faults.md` into out/benchmarks, or with `--out docs` that of the documentation. Each run
has a process of its own, and a file in the cache (out/benchmarks/faults): a run that is there is
not made again.
"""

from __future__ import annotations

import json
import multiprocessing
import re
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import numpy as np
from common import config

from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.errors import FactorgraphDvlError
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.io.trial_folder import load_trial, save_trial
from factorgraph_dvl.simulation import faults as f
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.levenberg_marquardt import minimise
from factorgraph_dvl.solvers.preparation import mounted_start, prepare
from factorgraph_dvl.solvers.state_times import STATE_INTERVAL
from factorgraph_dvl.trial import Trial

PAGE = "faults.md"
# A run that takes longer, s, has hung.
LONGEST_S = 900.0
# Errors, in standard deviations, and noncentrality, from which on a fault must be seen.
LARGE, SEEN = 5.0, 30.0
# Times that the problem is bound to the clocks anew for a noncentrality.
BINDINGS = 3
KNOTS = 0.514444
I3 = np.eye(3)
SWAP_XY = I3[[1, 0, 2]]


def mirror(axis: int) -> np.ndarray:
    """Return the matrix that inverts an axis."""
    return np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))


@dataclass(frozen=True)
class Row:
    """A fault at several levels, and what names it.

    `named` are patterns, one of which must be found in `code sensor parameter: text` of the first
    reason, case ignored.
    """

    name: str
    unit: str
    levels: tuple[Any, ...]
    make: Callable[[Any], list[f.Fault]]
    named: tuple[str, ...]


def imu_errors(**matrices: np.ndarray) -> list[f.Fault]:
    """Return errors of the IMU; those that are not given are zero."""
    zero = np.zeros((3, 3))
    of = {name: matrices.get(name, zero).tolist() for name in ("gyro", "g_sensitivity", "accel")}
    return [f.imu_errors(of["gyro"], of["g_sensitivity"], of["accel"])]


def turned(section: str, matrix: np.ndarray, *fields: str) -> list[f.Fault]:
    """Return axes that are multiplied by a matrix."""
    return [f.axes_changed(section, np.asarray(matrix).tolist(), *fields)]


# Words for what is found in a record, or in its residuals, of a sensor.
GROSS = "outliers|many_rejected|invalid_values|frozen_values|does_not_fit|large_residuals|noise_"


def gross(sensor: str) -> str:
    """Return the pattern of gross errors of a sensor."""
    return rf"^({GROSS})\w* {sensor}"


def clock(section: str, kind: str) -> tuple[str, ...]:
    """Return the patterns that name a clock."""
    sensor = {"imu": r"\w+"}.get(section, section)
    parameter = r"(\w+_)?" if section == "imu" else ("" if section == "dvl" else f"{section}_")
    freed = rf"^(estimated_instead|unexplained_misfit|far_from_prior)[^:]*{parameter}time_offset"
    if kind == "rate":
        freed = rf"^(estimated_instead|unexplained_misfit)[^:]*{section}_clock_rate"
        return (rf"^clock_drift {sensor}", freed)
    if kind == "step":
        return (rf"^clock_step {sensor}", r"^changed_along_trial[^:]*time_offset")
    return (rf"^(clock_offset|leap_seconds|local_time|no_overlap) {sensor}", freed)


ROWS = (
    Row(
        "DVL: outliers", "share", (0.02, 0.1, 0.3), lambda x: [f.dvl_outliers(x)], (gross("DVL"),)
    ),
    Row(
        "GNSS: outliers",
        "share",
        (0.02, 0.1, 0.3),
        lambda x: [f.gnss_outliers(x)],
        (gross("GNSS"),),
    ),
    Row(
        "GNSS: jumps of 30 s",
        "m",
        (2.0, 10.0, 50.0),
        lambda x: [f.gnss_jumps(x)],
        (gross("GNSS"),),
    ),
    Row(
        "DVL: false lock for 60 s",
        "m/s",
        (0.05, 0.3, 1.0),
        lambda x: [f.dvl_false_lock(x)],
        (gross("DVL"), r"^changed_along_trial[^:]*(dvl|scale|misalignment)"),
    ),
    Row(
        "DVL: layer of water for 60 s",
        "m/s",
        (0.1, 0.5),
        lambda x: [f.dvl_water_track((0.8 * x, 0.6 * x, 0.0))],
        (gross("DVL"), r"^changed_along_trial[^:]*(dvl|scale|misalignment)"),
    ),
    Row("DVL: frozen", "s", (5.0, 30.0, 120.0), lambda x: [f.frozen("dvl", x)], (gross("DVL"),)),
    Row(
        "GNSS: fixes frozen",
        "s",
        (5.0, 30.0),
        lambda x: [f.frozen("gnss", x, "geodetic")],
        (gross("GNSS"),),
    ),
    Row(
        "IMU: gyros frozen",
        "s",
        (0.1, 1.0, 10.0),
        lambda x: [f.frozen("imu", x, "gyro")],
        (r"^(frozen_values|imu_channel) IMU",),
    ),
    Row("DVL: zero fills", "share", (0.02, 0.5), lambda x: [f.filled("dvl", x)], (gross("DVL"),)),
    Row(
        "DVL: -32.768 fills",
        "share",
        (0.1,),
        lambda x: [f.filled("dvl", x, -32.768)],
        (gross("DVL"),),
    ),
    Row(
        "DVL: axis stuck",
        "axis",
        (0, 2),
        lambda x: [f.stuck("dvl", x)],
        (r"^(dvl_frozen|frozen_values|dvl_channel) DVL",),
    ),
    Row(
        "IMU: gyro stuck",
        "axis",
        (0, 2),
        lambda x: [f.stuck("imu", x, "gyro")],
        (r"^(imu_channel|gyro_frozen|frozen_values) IMU",),
    ),
    Row(
        "IMU: gyros saturated",
        "deg/s",
        (20.0, 35.0, 45.0),
        lambda x: [f.saturated(gyro_rad_s=np.radians(x))],
        (r"^(saturated|frozen_values) IMU",),
    ),
    Row(
        "IMU: accelerometers saturated",
        "m/s²",
        (9.75, 9.85),
        lambda x: [f.saturated(accel_m_s2=x)],
        (r"^(saturated|frozen_values|imu_channel) IMU",),
    ),
    Row(
        "GNSS: late",
        "s",
        (0.02, 0.3, 3.0, 18.0),
        lambda x: [f.late("gnss", x)],
        clock("gnss", "offset"),
    ),
    Row("DVL: late", "s", (0.02, 0.3, 3.0), lambda x: [f.late("dvl", x)], clock("dvl", "offset")),
    Row("IMU: late", "s", (0.3, 2.0), lambda x: [f.late("imu", x)], clock("imu", "offset")),
    Row(
        "GNSS: clock fast",
        "ppm",
        (100.0, 1000.0),
        lambda x: [f.clock_rate("gnss", x)],
        clock("gnss", "rate"),
    ),
    Row(
        "DVL: clock fast",
        "ppm",
        (30.0, 1000.0),
        lambda x: [f.clock_rate("dvl", x)],
        clock("dvl", "rate"),
    ),
    Row(
        "GNSS: clock jumps",
        "s",
        (0.1, 1.0),
        lambda x: [f.clock_step("gnss", x)],
        clock("gnss", "step"),
    ),
    Row(
        "DVL: clock jumps",
        "s",
        (0.02, 0.1, 1.0),
        lambda x: [f.clock_step("dvl", x)],
        clock("dvl", "step"),
    ),
    Row("DVL: jitter", "s", (0.01, 0.1), lambda x: [f.jitter("dvl", x)], (gross("DVL"),)),
    Row("GNSS: jitter", "s", (0.05, 0.2), lambda x: [f.jitter("gnss", x)], (gross("GNSS"),)),
    Row("IMU: jitter", "s", (0.001, 0.005), lambda x: [f.jitter("imu", x)], (r"IMU",)),
    Row(
        "DVL: unit",
        "m/s",
        (0.01, KNOTS),
        lambda x: turned("dvl", I3 / x),
        (r"^dvl_unit DVL", r"in cm/s"),
    ),
    Row(
        "IMU: gyros in deg/s",
        "",
        (1,),
        lambda x: turned("imu", np.degrees(I3), "gyro"),
        (r"^gyro_unit IMU.*deg/s|outside the physical",),
    ),
    Row(
        "IMU: force in g",
        "",
        (1,),
        lambda x: turned("imu", I3 / 9.80665, "accel"),
        (r"^force_unit IMU",),
    ),
    Row(
        "GNSS: velocity in knots",
        "",
        (1,),
        lambda x: turned("gnss", I3 / KNOTS),
        (r"^gnss_velocity GNSS.*knots",),
    ),
    Row(
        "DVL: signs of PD0", "", (1,), lambda x: turned("dvl", -I3), (r"^dvl_axes DVL.*all three",)
    ),
    Row(
        "DVL: axis mirrored",
        "axis",
        (0, 1, 2),
        lambda x: turned("dvl", mirror(x)),
        (r"^dvl_axes DVL",),
    ),
    Row(
        "IMU: axis mirrored",
        "axis",
        (0, 1, 2),
        lambda x: turned("imu", mirror(x)),
        (r"^(imu_axes|body_axes) IMU",),
    ),
    Row(
        "IMU: gyro mirrored",
        "axis",
        (0, 2),
        lambda x: turned("imu", mirror(x), "gyro"),
        (r"^gyro_axes IMU.*axis {axis} is mirrored",),
    ),
    Row(
        "IMU: accelerometer mirrored",
        "axis",
        (0, 1),
        lambda x: turned("imu", mirror(x), "accel"),
        (r"^accel_axes IMU.*axis {axis} is mirrored", r"^gyro_unit IMU.*axis {axis} of the accel"),
    ),
    Row(
        "GNSS: vertical velocity downwards",
        "",
        (1,),
        lambda x: turned("gnss", mirror(2)),
        (r"^(gnss_axes|gnss_velocity) GNSS",),
    ),
    Row("DVL: x and y swapped", "", (1,), lambda x: turned("dvl", SWAP_XY), (r"^dvl_axes DVL",)),
    Row(
        "IMU: x and y swapped",
        "",
        (1,),
        lambda x: turned("imu", SWAP_XY),
        (r"^imu_axes IMU.*swapped",),
    ),
    Row(
        "IMU: x and y of the gyros swapped",
        "",
        (1,),
        lambda x: turned("imu", SWAP_XY, "gyro"),
        (r"^gyro_axes IMU.*swapped",),
    ),
    Row(
        "GNSS: east and north velocity swapped",
        "",
        (1,),
        lambda x: turned("gnss", SWAP_XY),
        (r"^(gnss_velocity|gnss_axes) GNSS.*swapped",),
    ),
    Row(
        "GNSS: latitude and longitude swapped",
        "",
        (1,),
        lambda x: [f.fixes_swapped()],
        (r"swapped|lat_deg|latitude",),
    ),
    Row(
        "body_axes misstated",
        "",
        ("FLU", "FRD"),
        lambda x: [f.body_axes_misstated(x)],
        (r"^(course|body_axes)",),
    ),
    Row(
        "GNSS: datum",
        "m",
        ((0.0, 0.0, 20.0), (100.0, 50.0, 0.0)),
        lambda x: [f.datum(x)],
        (r"datum|GNSS|Depth",),
    ),
    Row(
        "DVL: scale walks",
        "1/√h",
        (0.003, 0.03),
        lambda x: [f.dvl_scale_walk(x)],
        (gross("DVL"), r"^(changed_along_trial|halves_differ)[^:]*scale"),
    ),
    Row(
        "DVL: scale drifts",
        "",
        (0.002, 0.01),
        lambda x: [f.dvl_scale_drift(x)],
        (gross("DVL"), r"^changed_along_trial[^:]*scale"),
    ),
    Row(
        "IMU: gyro bias walks",
        "deg/h/√h",
        (0.5, 10.0),
        lambda x: [f.imu_bias_walk(x)],
        (r"gyro|IMU",),
    ),
    Row(
        "IMU: accelerometer bias walks",
        "µg/√h",
        (100.0, 2000.0),
        lambda x: [f.imu_bias_walk(0.0, x)],
        (r"accel|IMU",),
    ),
    Row(
        "GNSS: position wanders",
        "m",
        (0.5, 3.0),
        lambda x: [f.correlated_gnss((x, x, 1.5 * x))],
        (gross("GNSS"), r"GNSS position"),
    ),
    Row(
        "GNSS: velocity wanders",
        "m/s",
        (0.1, 0.5),
        lambda x: [f.correlated_gnss(velocity_std_m_s=(x, x, x))],
        (gross("GNSS"), r"GNSS velocity"),
    ),
    Row(
        "DVL: velocity wanders",
        "m/s",
        (0.005, 0.05),
        lambda x: [f.correlated_dvl(x)],
        (gross("DVL"),),
    ),
    Row(
        "GNSS: antenna misstated",
        "m",
        (0.1, 0.5, 2.0),
        lambda x: [f.wrong_antenna((x, 0.0, 0.0))],
        (r"^antenna GNSS", r"gnss_lever_arm"),
    ),
    Row(
        "DVL: bias",
        "m/s",
        (0.004, 0.02, 0.1),
        lambda x: [f.dvl_bias((0.7 * x, -0.6 * x, 0.4 * x))],
        (r"dvl_bias",),
    ),
    Row(
        "DVL: slips in its mount",
        "deg",
        (0.05, 0.3, 2.0),
        lambda x: [f.dvl_slipped((0.0, 0.0, x))],
        (r"^changed_along_trial[^:]*(misalignment)",),
    ),
    Row(
        "IMU: sampling misstated",
        "",
        (1,),
        lambda x: [f.sampling_misstated()],
        (r"sampling|late|early|time_offset|clock_offset",),
    ),
    Row(
        "IMU: spikes",
        "share",
        (0.0001, 0.01),
        lambda x: [f.imu_spikes(x)],
        (r"^imu_(noise|spikes) IMU",),
    ),
    Row(
        "IMU: gyro scale",
        "ppm",
        (300.0, 10000.0),
        lambda x: imu_errors(gyro=1e-6 * x * I3),
        (r"gyro_scale|gyro|IMU",),
    ),
    Row(
        "IMU: accelerometer axes",
        "deg",
        (0.02, 0.2),
        lambda x: imu_errors(accel=np.tril(np.full((3, 3), np.radians(x)), -1)),
        (r"accel|IMU",),
    ),
)


def seed_a() -> dict[str, Any]:
    """Return the scenario of seed A, with clocks, antenna and bias as a user leaves them."""
    out: dict[str, Any] = config("seed-a-phase-90")
    out["trial"] = {"imu": out["trial"]["imu"], "dvl": {"velocity_std_m_s": 0.001}}
    return out


def cruise() -> dict[str, Any]:
    """Return a quarter of an hour of the cruise."""
    out: dict[str, Any] = config("cruise")
    drift, accelerate, legs, *_ = out["manoeuvres"]
    out["manoeuvres"] = [drift, accelerate, *legs["manoeuvres"]]
    out["trial"] = {"imu": out["trial"]["imu"]}
    return out


def dive() -> dict[str, Any]:
    """Return a dive of ten minutes below."""
    out: dict[str, Any] = config("dive")
    legs = next(m for m in out["manoeuvres"] if "repeat" in m)
    legs["repeat"] = 1
    out["gnss"]["outages_s"] = [[305, 1080]]
    del out["dvl"]["no_lock_s"]
    out["trial"] = {}
    return out


SCENARIOS = {"seed A": seed_a, "cruise": cruise, "dive": dive}
# What they are, on the page.
MOTIONS = {
    "seed A": "`configs/seed-a-phase-90.yaml`, 450 s",
    "cruise": "the first quarter of an hour of `configs/cruise.yaml`",
    "dive": "`configs/dive.yaml` with ten minutes below",
}


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
        return {"grade": "refused", "exit": error.exit_code, "reason": str(error)}
    with tempfile.TemporaryDirectory() as folder:
        save_trial(made, Path(folder) / "trial", parquet=True)
        start = time.process_time()
        try:
            trial = load_trial(Path(folder) / "trial")
            solution = solve(trial, rate_hz=1.0)
        except FactorgraphDvlError as error:
            return {"grade": "refused", "exit": error.exit_code, "reason": str(error)}
    return {
        "cpu_s": round(time.process_time() - start, 1),
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
    cost = np.nan
    for _ in range(BINDINGS):
        problem = Problem(chain, prepared.observations, prepared.parameters, start=values)
        at = problem.values(states, problem.prior_values() | values)
        found = minimise(problem, at, stage="noise as stated").evaluation
        states, values, cost = found.states, found.parameters, found.cost
        if not problem.needs_rebinding(values):
            break
    return float(cost)


def _silent(stage: str, iteration: int, cost: float | None) -> None:
    """Report nothing."""


def _write(run: Run, path: Path) -> None:
    try:
        result = outcome(run)
    except Exception:
        result = {"grade": "crashed", "reason": traceback.format_exc().strip()[-800:]}
    path.write_text(json.dumps(result), encoding="utf-8")


def result(run: Run, cache: Path) -> dict[str, Any]:
    """Return what became of a run: from the cache, or from a process of its own."""
    path = cache / f"{run.key}.json"
    if not path.exists():
        process = multiprocessing.get_context("fork").Process(target=_write, args=(run, path))
        process.start()
        process.join(LONGEST_S)
        if process.is_alive():
            process.terminate()
            process.join()
        if not path.exists():
            why = {"grade": "crashed", "reason": f"ended with {process.exitcode}"}
            path.write_text(json.dumps(why), encoding="utf-8")
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


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
*Error* is the largest one over calibration, position and attitude, in standard deviations.
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
    ]


def table(faulty: Iterable[tuple[Run, dict[str, Any], float]]) -> list[str]:
    """Return the table of all runs."""
    out = [
        "| scenario | fault | level | error, σ | λ | verdict | first reason | named |",
        "|---|---|---|---:|---:|---|---|---|",
    ]
    for run, found, added in faulty:
        assert run.row is not None
        reason = found["reason"].split(":")[0].strip() if found["grade"] != "refused" else "–"
        named = "" if found["grade"] == "good" else ("yes" if is_named(run, found) else "no")
        level = ", ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in _levels(run))
        lam = "–" if np.isnan(added) else f"{round(added)}"
        size = "–" if np.isnan(worst(found)) else f"{worst(found):.2g}"
        out.append(
            f"| {run.scenario} | {run.row.name} | {level} {run.row.unit} | {size} "
            f"| {lam} | {found['grade']} | {reason} | {named} |"
        )
    return out


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
    args = common.parse(parser)
    args.cache.mkdir(parents=True, exist_ok=True)
    runs = [r for r in all_runs(args.seeds) if r.row is None or re.search(args.only, r.key)]
    wanted = {(r.scenario, r.seed) for r in runs if r.row is not None}
    runs = [r for r in runs if (r.scenario, r.seed) in wanted]
    with ThreadPoolExecutor(args.jobs) as pool:
        found = list(pool.map(lambda run: result(run, args.cache), runs))
    print(
        common.write_page(args.out / PAGE, page(args.origin, list(zip(runs, found, strict=True))))
    )


if __name__ == "__main__":
    main()
