"""From a planar trial to a solution: all hypotheses; the most probable one is the answer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from factorgraph_dvl.errors import ConfigError, SolveError
from factorgraph_dvl.estimates import (
    Estimate,
    Hypothesis,
    Residuals,
    Trajectory,
    as_estimates,
    mixed,
)
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.results import (
    ambiguity,
    consistency_findings,
    mostly_rejected,
    not_observable,
)
from factorgraph_dvl.ranging.hypotheses import TrackedHypothesis, follow
from factorgraph_dvl.ranging.marginal_posterior import grid_points, posterior_weights
from factorgraph_dvl.ranging.model import EARTH_RADIUS, PlanarProblem
from factorgraph_dvl.ranging.planar_track import SLOPE_OVER
from factorgraph_dvl.ranging.problem import RangingSetup, planar_setup
from factorgraph_dvl.ranging.smoother import Fit, covariance, residuals
from factorgraph_dvl.sensors.beacon import SOUND_SPEED_ERROR, Beacons
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.protocol import Aid
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.solution import Progress, Solution
from factorgraph_dvl.trial import Trial

# Chosen: number of times at which hypotheses are fitted and weighed.
_UPDATES = 40
# Chosen: indices of those at which to search for new hypotheses as well, denser at first, when
# the ranges determine little.
_SEARCHES = (0, 1, 2, 4, 8, 16, 28)
# Chosen: rows before the first of them; a start and a current have four unknowns.
_FIRST_ROWS = 8


def solve_planar(
    trial: Trial, *, rate_hz: float = 10.0, progress: Progress | None = None
) -> Solution:
    """Estimate the track of a planar trial, with current and sound speed.

    Parameters
    ----------
    trial : Trial
        With compass, log, depth and beacons.
    rate_hz : float, default 10.0
        Rate of the trajectory in the solution.
    progress : callable, optional
        Called with stage, iteration and cost.

    Returns
    -------
    Solution
        Of the most probable hypothesis. The others are in `Solution.hypotheses`; the
        covariances include their spread.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be solved as it is.
    SolveError
        If there are too few ranges to find a position.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise ConfigError(f"rate_hz is {rate_hz}", expected="a number above 0")
    report = progress or (lambda stage, iteration, cost: None)
    report("dead reckoning", 0, None)
    setup = planar_setup(trial)
    problem = setup.problem
    updates, searches = schedule(problem)
    hypotheses = follow(
        problem,
        updates,
        searches,
        lambda nodes, living: report(
            f"hypotheses {len(living)}", nodes, living[0].fit.cost if living else None
        ),
    )
    living = [c for c in hypotheses if c.died is None]
    if not living:
        count = int(np.isfinite(problem.ranging.range).sum())
        raise SolveError(
            f"{count} {'range is' if count == 1 else 'ranges are'} too few to find a position",
            where=trial.required(Beacons).source,
            hint="Give `initial.position` in trial.yaml, or a longer record",
        )
    report("covariance", 0, None)
    return _summary(trial, setup, hypotheses, rate_hz)


def schedule(problem: PlanarProblem) -> tuple[list[int], list[int]]:
    """Return the numbers of nodes at which to weigh hypotheses, and to search for new ones."""
    rows = problem.ranging.node.size
    counts = np.unique(np.linspace(min(_FIRST_ROWS, rows), rows, _UPDATES).astype(int))
    updates = [int(problem.ranging.node[count - 1]) + 1 for count in counts]
    updates[-1] = problem.time.size
    return updates, [*(updates[i] for i in _SEARCHES if i < len(updates)), updates[-1]]


def _summary(
    trial: Trial,
    setup: RangingSetup,
    hypotheses: Sequence[TrackedHypothesis],
    rate_hz: float,
) -> Solution:
    problem = setup.problem
    depth_std = trial.required(Depth).settings.std_m
    living = [c for c in hypotheses if c.died is None]
    grids = [grid_points(problem, c.fit) for c in living]
    best = grids[0][0].fit
    along = [
        [_trajectory(depth_std, setup, s.fit, s.parts, rate_hz) for s in grid] for grid in grids
    ]
    shares = [posterior_weights(grid) for grid in grids]
    tracks = [mixed(parts, share) for parts, share in zip(along, shares, strict=True)]
    every = [point for grid in grids for point in grid]
    weights = np.concatenate([c.weight * share for c, share in zip(living, shares, strict=True)])
    gone = [
        _trajectory(depth_std, setup, c.fit, covariance(problem, c.fit), rate_hz)
        for c in hypotheses
        if c.died is not None
    ]
    reported = tuple(
        Hypothesis(c.weight, c.born, c.died, track, _history(c))
        for c, track in zip(hypotheses, [*tracks, *gone], strict=True)
    )
    values = [s.fit.theta / problem.si for s in every]
    covs = [s.parts[2] / np.outer(problem.si, problem.si) for s in every]
    joint = _mixture(values, covs, weights)
    estimates = as_estimates(problem.constants, values[0], joint)
    used, rejected = measurements(trial.required(Beacons), setup, best)
    findings = [*trial.notes]
    if not best.converged:
        text = message("not_converged.smoother")
        findings.append(Finding(Code.NOT_CONVERGED, text, severity="error"))
    if setup.uncovered:
        text = message("unused.without_heading", count=setup.uncovered)
        findings.append(Finding(Code.UNUSED, text, sensor="Beacon"))
    findings += ambiguity(reported)
    findings += consistency_findings(estimates, used)
    findings += mostly_rejected(used, rejected)
    findings += _unobservable(estimates, (trial.required(Heading), trial.required(SpeedLog)))
    return Solution(
        trial=trial.name,
        solver="planar",
        inputs=trial.inputs,
        body_axes=trial.body_axes,
        converged=best.converged,
        iterations=len(living[0].history),
        cost=best.cost,
        estimates=estimates,
        covariance=joint,
        trajectory=mixed([track for parts in along for track in parts], weights),
        residuals=used,
        findings=tuple(findings),
        hypotheses=reported if len(reported) > 1 else (),
        rejected=rejected,
    )


def reported_hypothesis(
    setup: RangingSetup, hypothesis: TrackedHypothesis, depth_std: float
) -> Hypothesis:
    """Return a hypothesis with its track at 1 Hz."""
    parts = covariance(setup.problem, hypothesis.fit)
    track = _trajectory(depth_std, setup, hypothesis.fit, parts, 1.0)
    weight, born, died = hypothesis.weight, hypothesis.born, hypothesis.died
    return Hypothesis(weight, born, died, track, _history(hypothesis))


def _history(hypothesis: TrackedHypothesis) -> Array:
    return np.array(hypothesis.history).reshape(-1, 2)


def _mixture(values: Sequence[Array], covs: Sequence[Array], weights: Array) -> Array:
    """Return the mean square error of the first of some values that have weights."""
    out = np.zeros_like(covs[0])
    for value, cov, weight in zip(values, covs, weights / weights.sum(), strict=True):
        error = value - values[0]
        out += weight * (cov + np.outer(error, error))
    return out


def _trajectory(
    depth_std: float,
    setup: RangingSetup,
    fit: Fit,
    parts: tuple[Array, Array, Array],
    rate_hz: float,
) -> Trajectory:
    """Return the motion between the nodes, dead-reckoned and closed onto the node after."""
    problem, frame = setup.problem, setup.frame
    states, cross, constants = parts
    nodes = problem.time[: fit.x.shape[0]]
    first, last = np.ceil(nodes[0] * rate_hz - 1e-6), np.floor(nodes[-1] * rate_hz + 1e-6)
    time = np.arange(first, last + 1) / rate_hz + 0.0
    time = np.clip(time, nodes[0], nodes[-1])
    k = np.clip(np.searchsorted(nodes, time, side="right") - 1, 0, nodes.size - 2)
    at, before = setup.track.at(time), setup.track.at(nodes)
    current = problem.value(fit.theta, "current", 2)
    since = time - nodes[k]
    part = (since / np.diff(nodes)[k])[:, None]
    moved = problem.turned(at.displacement - before.displacement[k], fit.p[k, 0], fit.theta)
    ends, _ = problem.moves(fit.p[:-1, 0], fit.theta, slice(0, nodes.size - 1))
    closing_error = np.diff(fit.p, axis=0) - ends
    p = fit.p[k] + moved + current * since[:, None] + part * closing_error[k]
    noise = fit.x[k, 2:] + part * (fit.x[k + 1, 2:] - fit.x[k, 2:])
    through = problem.turned(at.velocity, p[:, 0], fit.theta)
    v = np.column_stack([through - noise + current, at.climb])

    down = np.sum(p**2, axis=1) / (2.0 * EARTH_RADIUS)
    lat, lon, _ = frame.geodetic(np.column_stack([p, at.height - frame.height - down]))
    lRn = frame.level_from_tangent(lat, lon)
    bias = problem.value(fit.theta, "heading_bias")[0]
    own = problem.columns.get("heading_bias", slice(0, 0))
    heading_var = setup.track.heading_std**2 + float(np.sum(constants[own, own]))
    m = time.size
    position_cov, velocity_cov = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))

    def between(values: Array) -> Array:
        return values[k] + part[:, :, None] * (values[k + 1] - values[k])

    position_cov[:, :2, :2] = between(states[:, :2, :2])
    position_cov[:, 2, 2] = depth_std**2
    velocity_cov[:, 2, 2] = 2.0 * (depth_std / SLOPE_OVER) ** 2
    through_water = problem.turned(problem.velocity[: fit.x.shape[0]], fit.p[:, 0], fit.theta)
    D = problem.by_constants(through_water, fit.theta, np.ones(fit.x.shape[0]))
    mixed_terms = D @ cross[:, 2:].transpose(0, 2, 1)
    at_nodes = states[:, 2:, 2:] + D @ constants @ D.transpose(0, 2, 1)
    velocity_cov[:, :2, :2] = between(at_nodes - mixed_terms - mixed_terms.transpose(0, 2, 1))
    rph = np.zeros((m, 3))
    rph[:, 2] = (at.heading - bias) % (2.0 * np.pi)
    # Nothing measures roll and pitch.
    rph_cov = np.full((m, 3, 3), np.nan)
    rph_cov[:, 2, 2] = heading_var
    return Trajectory(
        time=time,
        geodetic=np.stack([lat, lon, at.height], axis=1),
        velocity=rotate(lRn, v),
        rph=rph,
        position_cov=lRn @ position_cov @ lRn.transpose(0, 2, 1),
        velocity_cov=lRn @ velocity_cov @ lRn.transpose(0, 2, 1),
        rph_cov=rph_cov,
    )


def measurements(
    beacons: Beacons, setup: RangingSetup, fit: Fit
) -> tuple[tuple[Residuals, ...], tuple[Residuals, ...]]:
    """Return residuals that were used, and those that were rejected, beacon by beacon."""
    ranges, rates, range_std, rate_std = residuals(setup.problem, fit)
    time, names = beacons.time[setup.rows], beacons.name[setup.rows]
    used: list[Residuals] = []
    rejected: list[Residuals] = []
    for name in beacons.settings.positions:
        for kind, unit, values, std, weight in (
            ("range", "m", ranges, range_std, fit.range_used),
            ("range rate", "m/s", rates, rate_std, fit.rate_used),
        ):
            own = (names == name) & ~np.isnan(values)
            for keep, out in ((weight > 0.0, used), (weight == 0.0, rejected)):
                m = own & keep
                if m.any():
                    label = f"Beacon {name} {kind}"
                    parts = (time[m], values[m, None], std[m, None])
                    out.append(Residuals(label, unit, (kind,), *parts))
    return tuple(used), tuple(rejected)


def _unobservable(estimates: Sequence[Estimate], carried: Sequence[Aid]) -> list[Finding]:
    def why(name: str, component: int) -> Message | str:
        for aid in carried:
            if name in {p.name for p in aid.parameters()}:
                return aid.explain(name, component, None)
        if name == SOUND_SPEED_ERROR:
            return message("not_observable.sound_speed_by_log")
        return message("not_observable.place")

    return [f for e in estimates for f in not_observable(e, partial(why, e.name))]
