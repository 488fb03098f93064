"""Chen, Shang and Lan (2021): navigation by one beacon, with and without the range rate."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from factorgraph_dvl.baselines.mirror_pair import Tracks, both_tracks, mirror_pair
from factorgraph_dvl.baselines.single_beacon import Filtered, Method, run_filter
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.report.figures.drawing import (
    ACCENT,
    DARK,
    GREY,
    new_figure,
    new_grid,
    style,
)
from factorgraph_dvl.reproduce.entry import Entry, Paper, Result, counted, judged, table
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.simulation import parse_scenario, simulate
from factorgraph_dvl.trial import Trial

_METHODS: tuple[Method, Method] = ("4sv-2ob", "4sv-3ob")
# Updates of a run, as the paper's figure 5 has them, and when a track has converged, m (chosen).
_UPDATES, _CONVERGED = 700, 20.0
# Updates after which the paper's filters have converged.
_PAPER = {"4sv-2ob": 600, "4sv-3ob": 150}
# Times of the three ranges, s: on the first straight leg, which is 200 s long.
_TIMES = (1.0, 90.0, 180.0)
# Start in metres east and north of the beacon, heading; then what the vehicle does.
_GEOMETRIES: dict[str, tuple[tuple[float, float, float], list[dict[str, float]]]] = {
    "turn by 45°, passing": (
        (300.0, -600.0, 340.0),
        [{"straight_s": 200}, {"turn_deg_s": 3, "duration_s": 15}, {"straight_s": 500}],
    ),
    "turn by 90°, outside": (
        (500.0, 300.0, 0.0),
        [{"straight_s": 200}, {"turn_deg_s": -3, "duration_s": 30}, {"straight_s": 500}],
    ),
    "two turns": (
        (-600.0, -300.0, 60.0),
        [
            {"straight_s": 200},
            {"turn_deg_s": 3, "duration_s": 20},
            {"straight_s": 200},
            {"turn_deg_s": -3, "duration_s": 20},
            {"straight_s": 280},
        ],
    ),
    "circle beside the beacon": (
        (400.0, 0.0, 0.0),
        [{"straight_s": 200}, {"turn_deg_s": 0.9, "duration_s": 520}],
    ),
    "outward, turn by 90°": (
        (50.0, 50.0, 45.0),
        [{"straight_s": 200}, {"turn_deg_s": -3, "duration_s": 30}, {"straight_s": 500}],
    ),
    "outward, two turns": (
        (0.0, 300.0, 0.0),
        [
            {"straight_s": 200},
            {"turn_deg_s": 3, "duration_s": 20},
            {"straight_s": 200},
            {"turn_deg_s": -3, "duration_s": 20},
            {"straight_s": 280},
        ],
    ),
}
# Outward from the beacon, the direction that a start at (0, 0) assumes is the true one.
_OUTWARD = tuple(name for name in _GEOMETRIES if name.startswith("outward"))
# Of the sweep: noise of ranges, m, and standard deviation of its start that the filter assumes, m.
_RANGE_STD, _START_STD = (1.0, 10.0), (50.0, 500.0)
# Of starts near the truth: their standard deviation, m, and the noise of ranges, m.
_NEAR_STD, _NEAR_RANGE_STD = 50.0, (1.0, 10.0, 30.0)


@cache
def _trial(name: str, seed: int, range_std: float = 1.0, current: bool = True) -> Trial:
    (east, north, heading), manoeuvres = _GEOMETRIES[name]
    data: dict[str, Any] = {
        "name": "chen-2021",
        "start": {
            "lat_deg": 25.0 + north / 110772.0,
            "lon_deg": 135.0 + east / 100950.0,
            "height_m": -40,
            "heading_deg": heading,
            "speed_m_s": 2,
        },
        "manoeuvres": manoeuvres,
        "current_m_s": [0.2, -0.15, 0.0] if current else [0.0, 0.0, 0.0],
        "heading": {"rate_hz": 1, "std_deg": 0.5},
        "log": {"rate_hz": 1, "speed_std_m_s": 0.05},
        "depth": {"rate_hz": 1, "std_m": 0.1},
        "beacons": {
            "rate_hz": 1,
            "positions": {"B1": {"lat_deg": 25.0, "lon_deg": 135.0, "height_m": -80}},
            "range_std_m": range_std,
            "range_rate_std_m_s": 0.05,
        },
        "trial": {"log": {"current_std_m_s": [0.3, 0.3]}},
    }
    return simulate(parse_scenario(data), seed)


def _beacon(trial: Trial) -> Array:
    place = next(iter(trial.required(Beacons).settings.positions.values()))
    return np.asarray(trial.frame().position(*place.geodetic)[:2])


def _truth(trial: Trial, time: Array) -> Array:
    r = trial.reference
    assert r is not None
    return trial.frame().position(*interpolate(time, r.time, r.geodetic).T)[:, :2]


def _error(trial: Trial, found: Filtered) -> Array:
    difference = found.state[:, :2] - _truth(trial, found.time)
    return np.hypot(*difference.T)[:_UPDATES]


def _converged(error: Array) -> float:
    """Return after how many updates an error stays below the limit; inf if never."""
    above = np.flatnonzero(error >= _CONVERGED)
    if not above.size:
        return 1.0
    return float(above[-1] + 2) if above[-1] + 1 < error.size else np.inf


@cache
def _from_origin(
    name: str, seed: int, method: Method, range_std: float, start_std: float
) -> Array:
    """Return the errors of a filter that starts at the beacon, (U,), m."""
    trial = _trial(name, seed, range_std)
    found = run_filter(trial, method, _beacon(trial), np.full(2, start_std))
    return _error(trial, found)


@cache
def _two_tracks(name: str, seed: int, method: Method) -> Tracks:
    return both_tracks(_trial(name, seed), method, _TIMES)


def _sweep(seeds: int, name: str) -> dict[Method, list[float]]:
    """Return the updates to convergence from (0, 0) of all runs of a geometry."""
    return {
        method: [
            _converged(_from_origin(name, seed, method, range_std, start_std))
            for range_std in _RANGE_STD
            for start_std in _START_STD
            for seed in range(seeds)
        ]
        for method in _METHODS
    }


@cache
def _from_near(name: str, seed: int, method: Method, range_std: float) -> float:
    """Return the updates to convergence from a start that is 50 m off."""
    trial = _trial(name, seed, range_std)
    off = np.random.default_rng([seed, 9]).normal(0.0, _NEAR_STD, 2)
    mean = _truth(trial, np.array([1.0]))[0] + off
    found = run_filter(trial, method, mean, np.full(2, _NEAR_STD))
    return min(_converged(_error(trial, found)), float(_UPDATES))


def _near(seeds: int) -> tuple[list[list[str]], dict[tuple[str, float], float]]:
    """Return a table of median updates from a near start, and the share that 3OB saves."""
    rows, savings = [], {}
    for name in _GEOMETRIES:
        cells = []
        for r in _NEAR_RANGE_STD:
            two, three = (
                float(np.median([_from_near(name, s, m, r) for s in range(seeds)]))
                for m in _METHODS
            )
            savings[name, r] = 1.0 - three / two
            cells.append(f"{two:.0f}, {three:.0f}: {100 * savings[name, r]:.0f} %")
        rows.append([name, *cells])
    return rows, savings


def _shown(updates: list[float]) -> str:
    good = [u for u in updates if np.isfinite(u)]
    median = f", median {np.median(good):.0f} updates" if good else ""
    return f"{len(good)} of {len(updates)}{median}"


def _headline(seeds: int) -> Result:
    sweeps = {name: _sweep(seeds, name) for name in _GEOMETRIES}
    rows = [[name, *(_shown(found[m]) for m in _METHODS)] for name, found in sweeps.items()]
    outward = {m: np.concatenate([sweeps[name][m] for name in _OUTWARD]) for m in _METHODS}
    other = [sweeps[n][m] for n in _GEOMETRIES if n not in _OUTWARD for m in _METHODS]
    two, three = (outward[m] for m in _METHODS)
    both = np.isfinite(two) & np.isfinite(three)
    saved = 1.0 - float(np.median(three[both]) / np.median(two[both]))
    near, savings = _near(seeds)
    best = max(savings, key=lambda key: savings[key])
    return Result(
        "from (0, 0), heading outward from the beacon, 2OB converged in "
        f"{np.isfinite(two).sum()} of {two.size} runs, 3OB in {np.isfinite(three).sum()}, with "
        f"{100 * saved:.0f} % fewer updates (median {np.median(three[both]):.0f} for "
        f"{np.median(two[both]):.0f}; paper: 75 %). In other directions "
        f"{np.isfinite(np.concatenate(other)).sum()} of {sum(map(len, other))} runs of both "
        f"converged. From a start 50 m off 3OB saves at most {100 * savings[best]:.0f} % "
        f"({best[0]}, ranges to {best[1]:g} m)",
        judged(saved > 0.6, saved > 0.0 and bool(np.isfinite(three).mean() > 0.9)),
        (
            *table(["from (0, 0)", "4SV-2OB", "4SV-3OB"], rows),
            "",
            f"Converged: the error stays below {_CONVERGED:g} m within {_UPDATES} updates. Ranges "
            f"to 1 and 10 m, starts that the filter takes for known to 50 and 500 m, "
            f"{counted(seeds)} each. A filter that starts at the beacon sees the bearing in the "
            "direction of the first displacement: it needs a vehicle that heads outward from the "
            "beacon. The range rate of the first update, before any displacement, is left out. "
            "Table 1 with the paper's own settings is lost in the copy.",
            "",
            "From a start that is 50 m off, median updates of 2OB and 3OB (a run that never "
            "converged counts as the whole run), and what 3OB saves:",
            "",
            *table(["geometry", *(f"ranges to {r:g} m" for r in _NEAR_RANGE_STD)], near),
        ),
    )


def _initialised(seeds: int) -> Result:
    rows, picked, total = [], 0, 0
    gains = []
    for name in _GEOMETRIES:
        cells = []
        for method in _METHODS:
            updates = []
            for s in range(seeds):
                tracks = _two_tracks(name, s, method)
                trial = _trial(name, s)
                ends = [_error(trial, f)[-1] for f in tracks.filtered]
                picked += bool(ends[0] <= ends[1])
                total += 1
                updates.append(_converged(_error(trial, tracks.filtered[0])))
            cells.append(updates)
        gains += [(a, b) for a, b in zip(*cells, strict=True) if np.isfinite(a) and np.isfinite(b)]
        rows.append([name, *(_shown(c) for c in cells)])
    saved = float(np.median([1.0 - b / a for a, b in gains])) if gains else float("nan")
    fine = sum(1 for _ in gains)
    return Result(
        f"the right track of the pair was kept in {picked} of {total} runs; both methods "
        "converged in "
        f"{fine} of {total // 2}, 3OB with {100 * saved:.0f} % fewer updates (paper: 75 %)",
        judged(picked > 0.9 * total),
        (
            *table(["geometry", "4SV-2OB", "4SV-3OB"], rows),
            "",
            f"Two filters from the mirror pair of the ranges at {_TIMES[0]:g}, {_TIMES[1]:g} and "
            f"{_TIMES[2]:g} s, {counted(seeds)}; the one with the smaller innovations is kept.",
        ),
    )


def _dropped(seeds: int) -> Result:
    growth, misfit = [], []
    for name in _GEOMETRIES:
        for s in range(seeds):
            tracks = _two_tracks(name, s, "4sv-3ob")
            spread = [np.trace(f.covariance[-1, :2, :2]) for f in tracks.filtered]
            growth.append(spread[1] / spread[0])
            misfit.append(tracks.misfit[1] / tracks.misfit[0])
    grown = sum(g > 2.0 for g in growth)
    return Result(
        f"variance of the dropped track / that of the kept one: median {np.median(growth):.2f}, "
        "above 2 in "
        f"{grown} of {len(growth)} runs; mean square of the innovations: "
        f"{np.median(misfit):.0f} times",
        judged(bool(grown > 0.9 * len(growth)), bool(np.median(misfit) > 3.0)),
        (
            "The covariance of an extended Kalman filter does not depend on its innovations: "
            "the wrong "
            "track does not show there, but in the innovations.",
        ),
    )


def _pair(seeds: int) -> Result:
    errors, distances = [], []
    for name in _GEOMETRIES:
        for s in range(seeds):
            trial = _trial(name, s)
            pair, _ = mirror_pair(trial, _TIMES)
            truth = _truth(trial, np.array([_TIMES[0]]))[0]
            errors.append(float(np.min(np.linalg.norm(pair - truth, axis=1))))
            distances.append(float(np.linalg.norm(truth - _beacon(trial))))
    share = float(np.median(np.array(errors) / np.array(distances)))
    return Result(
        f"one of the two is {np.median(errors):.0f} m off in the median, {100 * share:.0f} % of "
        "the distance "
        "(ranges to 1 m; the unknown current turns the course)",
        judged(share < 0.2),
    )


def _mirror(seeds: int) -> Result:
    """Compare ranges from a straight run and from its mirror image, without a current."""
    name = "turn by 90°, outside"
    trial = _trial(name, 0, 1.0, False)
    r = trial.reference
    assert r is not None
    time = np.arange(0.0, 500.0)
    p = _truth(trial, time) - _beacon(trial)
    straight = time < 195.0
    ahead = p[100] - p[0]
    ahead /= np.linalg.norm(ahead)
    image = 2.0 * np.outer(p @ ahead, ahead) - p
    velocity = np.gradient(p, time, axis=0)
    turned = 2.0 * np.outer(velocity @ ahead, ahead) - velocity
    apart = np.abs(np.linalg.norm(image, axis=1) - np.linalg.norm(p, axis=1))
    # After the turn the vehicle's heading is known, so the image goes on with the same velocity.
    going = image.copy()
    for k in np.flatnonzero(~straight):
        going[k] = going[k - 1] + velocity[k] * (time[k] - time[k - 1])
    later = np.abs(np.linalg.norm(going, axis=1) - np.linalg.norm(p, axis=1))[~straight].max()
    same = bool(np.allclose(turned[straight], velocity[straight], atol=1e-6))
    figure = new_figure(6.0, 6.0)
    ax = figure.add_subplot(new_grid(figure, 1, 1)[0, 0])
    ax.plot(*p.T, color=ACCENT, lw=1.2, label="true")
    ax.plot(*going.T, color=GREY, lw=1.2, label="mirror image")
    ax.plot(0.0, 0.0, "k^", label="beacon")
    ax.legend(fontsize=7)
    ax.set_aspect("equal", "datalim")
    style(ax, "east, m", "north, m")
    return Result(
        f"on the straight run the image has the same ranges to {apart[straight].max():.0e} m "
        "and the same "
        f"velocity ({'yes' if same else 'no'}); after the turn they differ by up to {later:.0f} m",
        judged(bool(apart[straight].max() < 1e-6 and same and later > 10.0)),
        (),
        figure,
    )


def _geometry(seeds: int) -> Result:
    trial = _trial("turn by 90°, outside", 0, 1.0, False)
    r = trial.reference
    assert r is not None
    time = np.arange(0.0, 500.0)
    p = _truth(trial, time) - _beacon(trial)
    velocity = np.stack([np.interp(time, r.time, v) for v in r.velocity[:, :2].T], axis=1)
    radial = np.gradient(np.linalg.norm(p, axis=1), time)
    speed = np.linalg.norm(velocity, axis=1)
    cosine = np.sum(velocity * p, axis=1) / (speed * np.linalg.norm(p, axis=1))
    # Where neither ends nor turns spoil the differences.
    inner = (time > 5.0) & (time < 190.0)
    apart = float(np.abs(radial / speed - cosine)[inner].max())
    figure = new_figure(9.0, 4.2)
    grid = new_grid(figure, 1, 2)
    track, ratio = (figure.add_subplot(grid[0, i]) for i in range(2))
    track.plot(*p.T, color=ACCENT, lw=1.2, label="track")
    track.plot(*np.array([p[100], [0.0, 0.0]]).T, color=GREY, lw=0.9, label="range")
    track.plot(0.0, 0.0, "k^", label="beacon")
    track.legend(fontsize=7)
    track.set_aspect("equal", "datalim")
    style(track, "east, m", "north, m")
    ratio.plot(time, cosine, color=ACCENT, lw=1.2, label="cosine of the bearing from the course")
    ratio.plot(time, radial / speed, color=DARK, lw=0.9, ls="--", label="v_r / u")
    ratio.legend(fontsize=7)
    style(ratio, "time, s", "v_r / u")
    return Result(
        f"v_r / u against the cosine of the angle between course and line of sight: {apart:.0e}",
        judged(apart < 1e-4),
        (),
        figure,
    )


def _figure_4(seeds: int) -> Result:
    name = _OUTWARD[0]
    trial = _trial(name, 0)
    start = _beacon(trial)
    figure = new_figure(9.0, 4.8)
    grid = new_grid(figure, 1, 2)
    for i, (title, tracks) in enumerate(
        (
            (
                "from (0, 0)",
                [run_filter(trial, m, start, np.full(2, 500.0)) for m in _METHODS],
            ),
            ("from the mirror pair", [_two_tracks(name, 0, m).filtered[0] for m in _METHODS]),
        )
    ):
        ax = figure.add_subplot(grid[0, i])
        ax.plot(*_truth(trial, tracks[0].time).T, color=DARK, lw=1.0, ls="--", label="true")
        for found, method, color in zip(tracks, _METHODS, (GREY, ACCENT), strict=True):
            ax.plot(*found.state[:, :2].T, color=color, lw=0.9, label=method)
        ax.set_xlim(-700, 700)
        ax.set_ylim(-200, 1200)
        ax.set_title(title, fontsize=9, loc="left")
        style(ax, "east, m", "north, m")
    figure.axes[0].legend(fontsize=7)
    ends = [_error(trial, _two_tracks(name, 0, m).filtered[0])[-1] for m in _METHODS]
    origin = [_from_origin(name, 0, m, 1.0, 500.0)[-1] for m in _METHODS]
    return Result(
        f"heading outward from the beacon, at the end off by {origin[0]:.0f} m (2OB) and "
        f"{origin[1]:.0f} m (3OB) from (0, 0), by "
        f"{ends[0]:.0f} "
        f"and {ends[1]:.0f} m from the mirror pair",
        judged(max(origin) < _CONVERGED, max(ends) < _CONVERGED),
        (),
        figure,
    )


def _figure_5(seeds: int) -> Result:
    name = _OUTWARD[0]
    figure = new_figure(9.0, 3.8)
    grid = new_grid(figure, 1, 2)
    medians: dict[str, list[float]] = {}
    for i, title in enumerate(("from (0, 0)", "from the mirror pair")):
        ax = figure.add_subplot(grid[0, i])
        for method, color in zip(_METHODS, (GREY, ACCENT), strict=True):
            errors = [
                _error(_trial(name, s), _two_tracks(name, s, method).filtered[0])
                if i
                else _from_origin(name, s, method, 1.0, 500.0)
                for s in range(seeds)
            ]
            found = float(np.median([_converged(e) for e in errors]))
            medians.setdefault(title, []).append(found)
            updates = np.arange(1, errors[0].size + 1)
            ax.semilogy(updates, errors[0], color=color, lw=0.9, label=method)
            ax.axvline(_PAPER[method], color=color, lw=0.8, ls=":")
        ax.set_title(title, fontsize=9, loc="left")
        style(ax, "update", "position error, m")
    figure.axes[0].legend(fontsize=7)

    def shown(values: list[float]) -> str:
        return ", ".join(f"{v:.0f}" if np.isfinite(v) else "never" for v in values)

    two, three = medians["from (0, 0)"]
    return Result(
        f"heading outward from the beacon, median updates to convergence, 2OB, 3OB: from (0, 0) "
        f"{shown(medians['from (0, 0)'])}; from the mirror pair "
        f"{shown(medians['from the mirror pair'])} ({counted(seeds)}); paper "
        f"{_PAPER['4sv-2ob']}, {_PAPER['4sv-3ob']}",
        judged(bool(np.isfinite(two) and three < 0.4 * two), three < two),
        (),
        figure,
    )


def _table_1(seeds: int) -> Result:
    return Result(
        "lost in the copy; 2 m/s, a current of 0.25 m/s, ranges to 1 and 10 m, range rates to "
        "0.05 m/s "
        "are taken, and the sweep of claim 1",
        "not reproducible",
    )


def _model(seeds: int) -> Result:
    """Compare the error of 4SV-3OB with its standard deviation, from the true start."""
    trial = _trial("two turns", 0)
    mean = _truth(trial, np.array([1.0]))[0]
    near = run_filter(trial, "4sv-3ob", mean, np.full(2, 1.0))
    error = _error(trial, near)
    sigma = np.sqrt(np.trace(near.covariance[:, :2, :2], axis1=1, axis2=2))
    inside = float(np.mean(error < 3.0 * sigma[: error.size]))
    return Result(
        f"four states, three observations; from the true start the error stays within 3σ for "
        f"{100 * inside:.0f} % of updates, {error[-1]:.1f} m at the end (equations lost: "
        "derived anew)",
        judged(False, inside > 0.9),
    )


_THREE = "`kalman --method 4sv-3ob`"
_PAIR = "`baselines/mirror_pair`"
CHEN_2021 = Paper(
    "chen-2021",
    "Chen X., Shang F., Lan Q. (2021): Model and algorithm improvement for UUV navigation based "
    "on single beacon",
    (
        Entry("figure 1", "geometry of range and range rate", "`sensors/beacon`", _geometry),
        Entry("figure 2", "two tracks fit the same ranges", "`solvers/hypotheses`", _mirror),
        Entry("figure 3", "v_r / u is the cosine of the bearing", "`sensors/beacon`", _geometry),
        Entry("start (eq. 7, lost)", "mirror pair from the ranges", _PAIR, _pair),
        Entry("equations (lost)", "4SV-2OB and 4SV-3OB", "`baselines/single_beacon`", _model),
        Entry("table 1", "settings of the simulation", "–", _table_1),
        Entry("figure 4", "tracks of 2OB and 3OB", _THREE, _figure_4),
        Entry("figure 5", "errors: 600 and 150 updates", _THREE, _figure_5),
        Entry("claim 1 (abstract)", "3OB converges 75 % sooner, from (0, 0)", _THREE, _headline),
        Entry("claim 2 (section 2)", "two tracks, one dropped", _PAIR, _initialised),
        Entry("claim 3 (section 2)", "the wrong one's variance grows", _PAIR, _dropped),
    ),
)
