"""Single-beacon navigation: the filters of Chen et al. (2021) and the factor graph.

    python benchmarks/beacon_2021.py [--seeds 50] [--out DIR]

writes `chen-2021.md` into out/benchmarks, or with `--out docs` that of the documentation. 50 seeds
take about half an hour on 2 cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import common
import numpy as np

from factorgraph_dvl.baselines.single_beacon import run_filter
from factorgraph_dvl.geometry.vectors import interpolate
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.solvers.hypotheses import follow
from factorgraph_dvl.solvers.planar_setup import planar_setup
from factorgraph_dvl.trial import Trial

PAGE = "chen-2021.md"
UPDATES = 600
THRESHOLD = 20.0
BEACON = {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80}
# Metres east and north of the beacon, heading, and what the vehicle does.
GEOMETRIES: dict[str, tuple[tuple[float, float, float], list[dict]]] = {
    "turn by 45°, passing": (
        (300, -600, 340),
        [{"straight_s": 200}, {"turn_deg_s": 3, "duration_s": 15}, {"straight_s": 400}],
    ),
    "turn by 90°, outside": (
        (500, 300, 0),
        [{"straight_s": 200}, {"turn_deg_s": -3, "duration_s": 30}, {"straight_s": 400}],
    ),
    "zigzag by 60°": (
        (-600, -300, 60),
        [
            {"straight_s": 100},
            {"repeat": 3, "manoeuvres": [
                {"turn_deg_s": 3, "duration_s": 20}, {"straight_s": 80},
                {"turn_deg_s": -3, "duration_s": 20}, {"straight_s": 80}]},
        ],
    ),
    "circle beside the beacon": ((400, 0, 0), [{"turn_deg_s": 0.9, "duration_s": 610}]),
}  # fmt: skip
# How wrong the start is and how coarse the ranges are, m, and in which geometries.
CASES = (
    (50.0, 1.0, tuple(GEOMETRIES)),
    (50.0, 10.0, ("zigzag by 60°", "circle beside the beacon")),
    (300.0, 1.0, ("zigzag by 60°",)),
)
ONE_TURN = ((300, -500, 20), [{"straight_s": 250}, {"turn_deg_s": 2, "duration_s": 15},
                              {"straight_s": 250}])  # fmt: skip
STRAIGHT = ((300, -500, 20), [{"straight_s": 500}])
# Prior of the current, m/s.
CURRENT_STD = 0.3
METHODS = ("4SV-2OB", "4SV-3OB", "factor graph")
# The estimates are looked at after every so many updates.
EVERY = 5


def scenario(
    geometry: tuple,
    *,
    prior: float | None = None,
    current: Sequence[float] = (0.2, -0.15),
    **beacon: object,
):
    """Return the scenario of a geometry, about 2 m/s in a current."""
    (east, north, heading), manoeuvres = geometry
    trial: dict = {"log": {"current_std_m_s": [CURRENT_STD] * 2}}
    if prior is not None:
        trial["initial"] = {"position_std_m": [prior, prior, 1.0]}
    return parse_scenario(
        {
            "name": "study",
            "start": {
                "lat_deg": 25.0 + north / 110772.0,
                "lon_deg": 135.0 + east / 100950.0,
                "height_m": -40,
                "heading_deg": heading,
                "speed_m_s": 2,
            },
            "manoeuvres": manoeuvres,
            "current_m_s": [*map(float, current), 0.0],
            "heading": {"rate_hz": 1, "std_deg": 0.5},
            "log": {"rate_hz": 1, "speed_std_m_s": 0.05},
            "depth": {"rate_hz": 1, "std_m": 0.1},
            "beacons": {
                "rate_hz": 1,
                "positions": {"B1": BEACON},
                "range_std_m": 1.0,
                "range_rate_std_m_s": 0.05,
                **beacon,
            },
            "trial": trial,
        }
    )


def truth(trial: Trial, time: np.ndarray) -> np.ndarray:
    """Return the true positions in the trial's frame, (M, 2), m."""
    r = trial.reference
    return trial.frame().position(*interpolate(time, r.time, r.geodetic).T)[:, :2]


def settled(error: np.ndarray, threshold: float = THRESHOLD) -> float:
    """Return after how many updates the error stays below a threshold; inf if never."""
    above = np.flatnonzero(error >= threshold)
    if not above.size:
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < error.size else np.inf


def replay(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    """Return times and positions of the heaviest hypothesis, with the data so far."""
    setup = planar_setup(trial, trial.frame())
    node_time = setup.chain.node_time
    nodes = list(range(EVERY + 1, node_time.size + 1, EVERY))
    times, positions = [], []

    def keep(count: int, living: list) -> None:
        if living:
            times.append(node_time[count - 1])
            positions.append(living[0].fit.x[-1, :2].copy())

    follow(setup, nodes, nodes[2 :: len(nodes) // 8], keep)
    return np.array(times), np.array(positions)


def convergence(task: tuple[str, float, float, int]) -> dict[str, float]:
    """Return the updates that each method takes on one seed, from the same wrong start."""
    name, std, range_std, seed = task
    geometry = GEOMETRIES[name]
    trial = simulate(scenario(geometry, prior=std, range_std_m=range_std), seed)
    off = np.random.default_rng([seed, 9]).normal(0.0, std, 2)
    start = trial.initial_position.geodetic
    moved = trial.frame().position(*start) + np.array([*off, 0.0])
    start[:] = np.array(trial.frame().geodetic(moved))
    out = {}
    for method in ("4SV-2OB", "4SV-3OB"):
        f = run_filter(trial, method.lower(), moved[:2], np.full(2, std))
        error = np.hypot(*(f.state[:, :2] - truth(trial, f.time)).T)[:UPDATES]
        out[method] = EVERY * settled(error[EVERY - 1 :: EVERY])
    time, p = replay(trial)
    error = np.hypot(*(p - truth(trial, time)).T)[time <= UPDATES]
    out[METHODS[2]] = EVERY * settled(error)
    return out


@dataclass(frozen=True)
class Solved:
    """Of one seed without a position: what is left, how far off, how well covered."""

    alive: int
    dead: tuple[float, ...]
    weight: float
    rms: float
    largest: float
    covered: float
    rejected: int
    wrong: int


def solved(task: tuple[str, int]) -> Solved:
    """Solve one seed without any position."""
    kind, seed = task
    changes: dict = {"multipath": 0.2} if kind == "multipath" else {}
    geometry = STRAIGHT if kind == "straight" else ONE_TURN
    current = np.random.default_rng([seed, 10]).normal(0.0, CURRENT_STD, 2)
    trial = simulate(scenario(geometry, current=current, **changes), seed)
    clean = simulate(scenario(geometry, current=current), seed)
    solution = solve(trial, rate_hz=1.0)
    t = solution.trajectory
    error = trial.frame().position(*t.geodetic.T)[:, :2] - truth(trial, t.time)
    std = t.position_std[:, :2]
    hypotheses = solution.hypotheses
    alive = [h for h in hypotheses if h.died is None]
    echo = trial.beacons.range - clean.beacons.range > 1.0
    lost = [r for r in solution.rejected if r.unit == "m"]
    times = np.concatenate([r.time for r in lost]) if lost else np.empty(0)
    return Solved(
        alive=max(len(alive), 1),
        dead=tuple(h.died for h in hypotheses if h.died is not None),
        weight=alive[0].weight if alive else 1.0,
        rms=float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        largest=float(np.hypot(*error.T).max()),
        covered=float(np.mean(np.abs(error) <= 2.0 * std)),
        rejected=int(np.isin(trial.beacons.time[echo], times).sum()),
        wrong=int(echo.sum()),
    )


def quantiles(values: list[float]) -> str:
    """Return median and 90 % quantile, and how many never settled."""
    a = np.sort(np.array(values))
    shown = [f"{a[int(q * (a.size - 1))]:.0f}".replace("inf", "never") for q in (0.5, 0.9)]
    never = int(np.isinf(a).sum())
    return f"{shown[0]} ({shown[1]})" + (f", {never} never" if never else "")


def convergence_tables(results: dict[str, list[dict[str, float]]]) -> list[str]:
    """Return the Markdown of the convergence study."""
    out = [
        "| geometry | " + " | ".join(METHODS) + " | 3OB against 2OB | graph ≤ 3OB |",
        "|---" * (len(METHODS) + 3) + "|",
    ]
    pooled: dict[str, list[float]] = {m: [] for m in METHODS}
    for name, runs in results.items():
        by = {m: [r[m] for r in runs] for m in METHODS}
        for m in METHODS:
            pooled[m] += by[m]
        out.append(row(name, by))
    out.append(row("all", pooled))
    return out


def row(name: str, by: dict[str, list[float]]) -> str:
    """Return one line of the convergence table."""
    two, three, graph = (np.median(by[m]) for m in METHODS)
    if np.isfinite(two) and np.isfinite(three):
        change = f"{100.0 * (three / two - 1.0):+.0f} %"
    else:
        change = "–"
    earlier = np.array(by[METHODS[2]]) <= np.array(by[METHODS[1]])
    verdict = f"{'yes' if graph <= three else 'no'}, {earlier.sum()} of {earlier.size} seeds"
    return (
        f"| {name} | "
        + " | ".join(quantiles(by[m]) for m in METHODS)
        + f" | {change} | {verdict} |"
    )


INTRODUCTION = """\
# Single-beacon navigation: the filters of Chen et al. (2021) and the factor graph

{origin}

Chen X., Shang F. and Lan Q., Journal of Unmanned Undersea Systems 29(4), 2021, add the range
rate to slant range and depth. Their extended Kalman filter 4SV-3OB converges after 150 updates
instead of the 600 of 4SV-2OB, 75 % less. The available text lacks the table of their parameters,
so this page uses other scenarios. The vehicle moves at 2 m/s through the water, and the beacon is
40 m below it. No method knows the current of 0.25 m/s (prior 0.3 m/s). Updates come at 1 Hz, with
ranges to 1 or 10 m, range rates to 0.05 m/s, heading to 0.5°, and speed to 0.05 m/s.

## Convergence

Updates until the position error stays below {threshold:.0f} m, of {updates}: median (90 %
quantile) over {seeds} seeds. All start from the same wrong position, drawn anew for each seed, and
know the standard deviation of that error in east and in north. The *factor graph* is `solve` on a
planar trial, with the data so far. If several hypotheses remain, the one with the largest weight
counts. All are evaluated after every fifth update.

The gain depends on the accuracy of the ranges relative to the range rates: coarser ranges give a
larger gain. A filter that starts far off may settle in the mirror image, with either set of
observations, and stay there.

"""


def main() -> None:
    """Run the study and write its page."""
    args = common.parse(common.parser(__doc__, seeds=50))
    n = args.seeds
    page = INTRODUCTION.format(
        origin=args.origin, seeds=n, threshold=THRESHOLD, updates=UPDATES
    ).splitlines()
    first = {}
    with common.pool(args.jobs) as pool:
        for std, range_std, names in CASES:
            results = {}
            for name in names:
                tasks = [(name, std, range_std, s) for s in range(n)]
                results[name] = list(pool.map(convergence, tasks))
                first[name, std, range_std] = results[name][0]
                print("\n".join(convergence_tables(results)), flush=True)
            title = f"Start wrong by {std:.0f} m, ranges to {range_std:.0f} m:"
            page += [title, "", *convergence_tables(results), ""]
        turn = list(pool.map(solved, [("turn", s) for s in range(2 * n)]))
        straight = list(pool.map(solved, [("straight", s) for s in range(n)]))
        echoes = list(pool.map(solved, [("multipath", s) for s in range(n)]))
        tail = hypothesis_page(turn, straight, echoes)
        print("\n".join(tail), flush=True)
    page += tail
    page += common.sample_section(seed_table(first))
    common.write_page(args.out / PAGE, page)


def sample() -> list[str]:
    """Return those lines of the page that one seed makes."""
    cases = [(name, std, r) for std, r, names in CASES for name in names]
    return seed_table({case: convergence((*case, common.SAMPLED_SEED)) for case in cases})


def seed_table(runs: dict[tuple[str, float, float], dict[str, float]]) -> list[str]:
    """Return the Markdown of one seed: updates until each method has settled."""
    return [
        f"| geometry, start wrong by, ranges to | {' | '.join(METHODS)} |",
        "|---" * (len(METHODS) + 1) + "|",
        *(
            f"| {name}, {std:.0f} m, {r:.0f} m | {' | '.join(f'{run[m]:.0f}' for m in METHODS)} |"
            for (name, std, r), run in runs.items()
        ),
    ]


def hypothesis_page(turn: list[Solved], straight: list[Solved], echoes: list[Solved]) -> list[str]:
    """Return the Markdown of the runs without a position."""
    right = sum(s.alive == 1 and s.largest < 50.0 for s in turn)
    died = np.array([max(s.dead) for s in turn if s.dead])
    clean = turn[: len(echoes)]
    factor = np.sqrt(np.mean([s.rms**2 for s in echoes]) / np.mean([s.rms**2 for s in clean]))
    found, wrong = sum(s.rejected for s in echoes), sum(s.wrong for s in echoes)
    rms = np.sqrt(np.mean([s.rms**2 for s in turn]))
    both = sum(s.alive == 2 for s in straight)
    return [
        "## Without a position",
        "",
        "The start is found from the ranges and range rates alone. The current is drawn from its",
        "prior, 0.3 m/s east and north, anew for each seed.",
        "",
        "| run | measured |",
        "|---|---|",
        f"| one turn by 30° after 250 s: the right hypothesis alone is left | {right} of "
        f"{len(turn)} seeds |",
        f"| the wrong one dies, median (last) | {np.median(died):.0f} s ({died.max():.0f} s) |",
        f"| position error, root mean square | {rms:.2f} m |",
        f"| position error within 2σ, east and north, all epochs | "
        f"{100 * np.mean([s.covered for s in turn]):.1f} % |",
        f"| straight run of 500 s: both hypotheses are left | {both} of {len(straight)} seeds |",
        f"| the weight of the heavier one, median (largest) | "
        f"{np.median([s.weight for s in straight]):.2f} "
        f"({max(s.weight for s in straight):.3f}) |",
        f"| position error within 2σ, with the spread of the hypotheses | "
        f"{100 * np.mean([s.covered for s in straight]):.1f} % |",
        f"| one turn, 20 % of the ranges 10 to 50 m too long: error / error without them | "
        f"{factor:.2f} |",
        f"| of these the right hypothesis alone is left | "
        f"{sum(s.alive == 1 and s.largest < 50.0 for s in echoes)} of {len(echoes)} seeds |",
        f"| too long ranges that were named | {found} of {wrong} |",
        f"| position error within 2σ | {100 * np.mean([s.covered for s in echoes]):.1f} % |",
    ]


if __name__ == "__main__":
    main()
