"""A planar trial as a problem: its chain, its measurements, and tracks that fit them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array, interpolate
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.planar_chain import PlanarChain, Recorded
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.ranging.dead_reckoning import DeadReckoning, dead_reckoned
from factorgraph_dvl.ranging.search import RangingRows, ranging_rows
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.solvers.levenberg_marquardt import factorized, minimise
from factorgraph_dvl.solvers.posterior import Posterior
from factorgraph_dvl.trial import Trial

# Time between nodes, s, at least. Chosen: a vehicle does not turn in less.
_LEAST_STEP = 0.5
# Standard deviation of the first velocity, m/s. Chosen: any vehicle's.
_ANY_VELOCITY = 100.0
# Standard deviation of a first position that is stated, m, at least.
_LEAST_POSITION = 1e-3
# Searches for echoes after which a track counts as it is. Chosen: most take one or two.
_SEARCHES = 6
# Gates within which a measurement may be none of an echo, before it is fitted. Chosen: dead
# reckoning has gone off by then.
_BEFORE = 3.0
# Share of rejected measurements among the newest from which on the track is fitted anew. Chosen:
# so many are no echoes.
_MOSTLY_REJECTED = 0.5
# Promised fall of the cost at which a track fits, and steps after which it counts as it is.
# Chosen: with few ranges the cost is a narrow valley around the beacon, along which whole steps
# fail; what is left of it changes no weight.
_ROUGHLY = 0.03
_STEPS = 8


@dataclass(frozen=True)
class Track:
    """A track that fits the measurements of the first nodes.

    Parameters
    ----------
    problem : Problem
        Problem of these nodes.
    evaluation : Evaluation
        Its minimum.
    converged : bool
        Whether it is one.
    """

    problem: Problem
    evaluation: Evaluation
    converged: bool

    @property
    def x(self) -> Array:
        """Positions and velocities of the nodes, (n, 4), m, m/s."""
        return np.asarray(self.evaluation.states.x)

    @property
    def values(self) -> dict[str, Array]:
        """Constants by name."""
        return self.evaluation.parameters

    @cached_property
    def terms(self) -> tuple[Array, float]:
        """Terms of the cost of data and motion, a rejected measurement's gate; cost by priors."""
        problem, evaluation = self.problem, self.evaluation
        parts = []
        for o, residual, usable in zip(
            problem.observations, evaluation.residuals, problem.usable.values(), strict=True
        ):
            own = 0.5 * np.sum(residual**2, axis=1)
            parts.append(np.where(usable, own, 0.5 * (o.gate or 0.0) ** 2))
        steps = problem.chain.steps(evaluation.states)
        parts += [0.5 * np.sum(step.residual**2, axis=1) for step in steps]
        return np.concatenate(parts), float(problem.graph.error(evaluation.values))

    @property
    def cost(self) -> float:
        """Sum of all terms."""
        return float(self.terms[0].sum()) + self.terms[1]

    @cached_property
    def last_position(self) -> Array:
        """Covariance of the last position, (2, 2), m²."""
        information, _ = factorized(self.problem, self.evaluation)
        key = keys.node(len(self.x) - 1)
        return information.marginals([key])[key][:2, :2]

    def trajectory(self, rate_hz: float) -> Trajectory:
        """Return the motion at a rate, with its covariance."""
        chain = self.problem.chain
        assert isinstance(chain, PlanarChain)
        information, _ = factorized(self.problem, self.evaluation)
        every = chain.keys_of(range(len(self.x)))
        found = information.marginals(every)
        P = np.stack([found[key] for key in every])
        time = chain.epochs(rate_hz)
        return chain.trajectory(self.evaluation.states, P, chain.body_axes, time)


@dataclass(frozen=True)
class PlanarSetup:
    """What every minimisation of a planar trial starts from.

    Parameters
    ----------
    trial : Trial
        Trial with compass, log, depth and beacons.
    track : DeadReckoning
        Track by their records.
    chain : PlanarChain
        Chain of the whole trial.
    observations : tuple of Observation
        Observations of log and beacons.
    known_start : bool
        Whether the prior of the first position is measured, not a mere bound.
    """

    trial: Trial
    track: DeadReckoning
    chain: PlanarChain
    observations: tuple[Observation, ...]
    known_start: bool

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Constants with priors, fixed ones included."""
        return self.track.parameters

    @cached_property
    def rows(self) -> RangingRows:
        """Ranges and range rates that the track covers."""
        return ranging_rows(self.track, self.chain.frame, self.chain.body_axes)

    @cached_property
    def zero(self) -> dict[str, Array]:
        """Prior means of the constants."""
        return Problem(self.chain.until(2), (), self.parameters).prior_values()

    def problem(self, nodes: int, rejected: Mapping[str, Array]) -> Problem:
        """Return the problem of the first nodes, without measurements at some times by label."""
        out = Problem(
            self.chain.until(nodes),
            self.observations,
            self.parameters,
            clock_zero=self.chain.middle,
        )
        out.reject(rejected)
        return out

    def reckoned(self, first: Array, values: Mapping[str, Array], nodes: int) -> Array:
        """Return states (nodes, 4) from a first position (2,), m, by dead reckoning alone."""
        moved, velocity = self.track.over_ground(self.chain.node_time[:nodes], values)
        return np.hstack([first + moved - moved[0], velocity])

    def carried(self, earlier: Track, nodes: int) -> Array:
        """Return the states of a track, dead-reckoned on to more nodes, or cut."""
        chain, time = earlier.problem.chain, self.chain.node_time[:nodes]
        count = max(int(np.searchsorted(time, chain.node_time[-1], side="right")), 1)
        there = chain.motion(chain.attach(time[:count]), earlier.evaluation.states)
        x = np.hstack([there.p_n[:, :2], there.v_n[:, :2]])
        if count == nodes:
            return x
        on = self.reckoned(np.zeros(2), earlier.values, nodes)
        on[:, :2] += x[-1, :2] - on[count - 1, :2]
        return np.concatenate([x, on[count:]])

    def fitted(
        self, x: Array, values: Mapping[str, Array], rejected: Mapping[str, Array]
    ) -> Track:
        """Return the most probable track near a start, without the measurements that do not fit.

        Parameters
        ----------
        x : ndarray, shape (n, 4)
            Start of the first nodes.
        values : mapping of str to ndarray
            Start of the constants.
        rejected : mapping of str to ndarray
            Times that are left out at first, by label.
        """
        for _ in range(_SEARCHES):
            problem = self.problem(len(x), rejected)
            chain = problem.chain
            states = self.chain.with_recorded(chain.node_time, x)
            found = minimise(
                problem,
                problem.values(states, self.zero | dict(values)),
                stage="hypotheses",
                proven=False,
                tolerance=_ROUGHLY,
                max_iterations=_STEPS,
            )
            x, values = found.evaluation.states.x, found.evaluation.parameters
            echoes = problem.outliers(found.evaluation)
            if _same(echoes, rejected):
                break
            rejected = echoes
        return Track(problem, found.evaluation, found.converged)

    def followed(self, earlier: Track, nodes: int) -> Track:
        """Return the track that an earlier one becomes with the measurements of more nodes."""
        x, known = self.carried(earlier, nodes), earlier.problem.rejected
        since = self.chain.node_time[len(earlier.x) - 1]
        problem = self.problem(nodes, known)
        states = self.chain.with_recorded(problem.chain.node_time, x)
        at = problem.weighed(problem.evaluate(problem.values(states, earlier.values)))
        off = {
            o.label: o.time[(np.abs(residual) > _BEFORE * o.gate).any(axis=1) & (o.time > since)]
            for o, residual in zip(problem.observations, at.residuals, strict=True)
            if o.gate is not None
        }
        rejected = {
            label: np.union1d(known.get(label, np.empty(0)), off.get(label, np.empty(0)))
            for label in {*known, *off}
        }
        found = self.fitted(x, earlier.values, rejected)
        if self._newly_rejected(found, since) < _MOSTLY_REJECTED:
            return found
        # So many are not echoes: dead reckoning has left the region in which they pass the gate.
        other = self.fitted(x, earlier.values, known)
        return min(found, other, key=lambda each: each.cost)

    def _newly_rejected(self, found: Track, since: float) -> float:
        """Return the largest share, of all kinds, of the newest measurements that are rejected."""
        end, shares = found.problem.chain.node_time[-1], [0.0]
        for o in self.observations:
            new = o.time[(o.time > since) & (o.time <= end)]
            out = found.problem.rejected.get(o.label, np.empty(0))
            if o.gate is not None and new.size:
                shares.append(float(np.mean(np.isin(new, out))))
        return max(shares)


def planar_setup(trial: Trial, frame: LocalFrame) -> PlanarSetup:
    """Return the chain and the measurements of a planar trial.

    Raises
    ------
    ConfigError, DataError
        As of `dead_reckoned`.
    """
    track = dead_reckoned(trial)
    nodes = [track.time[0]]
    for t in track.time[1:]:
        if t - nodes[-1] >= _LEAST_STEP:
            nodes.append(t)
    # The last node is where the track ends.
    nodes[-1 if len(nodes) > 2 else len(nodes) :] = [track.time[-1]]
    time = np.array(nodes)
    initial = trial.initial_position
    first = np.mean(frame.position(*track.beacons.places.T)[:, :2], axis=0)
    # A bound only: the vehicle is within hearing of the beacons.
    std = np.full(2, 2.0 * float(np.nanmax(track.beacons.range, initial=1e4)))
    if initial is not None:
        first = frame.position(*initial.geodetic)[:2]
        std = np.maximum(initial.std[:2], _LEAST_POSITION)
    chain = PlanarChain(
        frame=frame,
        node_time=time,
        density=interpolate(0.5 * (time[1:] + time[:-1]), track.time, track.density),
        recorded=Recorded(
            track.time,
            track.heading,
            track.height,
            track.climb,
            track.heading_std,
            track.height_std,
            track.climb_std,
        ),
        start=np.array([*first, 0.0, 0.0]),
        start_std=np.array([*std, _ANY_VELOCITY, _ANY_VELOCITY]),
        body_axes=trial.body_axes,
        heading_bias=track.heading_bias,
    )
    observations = tuple(
        o for aid in (track.log, track.beacons) for o in aid.observations(frame, trial.body_axes)
    )
    return PlanarSetup(trial, track, chain, observations, initial is not None)


def planar_trajectory(problem: Problem, at: Evaluation, P: Posterior, time: Array) -> Trajectory:
    """Return the motion at times (M,), s, with headings less their constant error.

    Parameters
    ----------
    problem : Problem
        Problem of a planar chain.
    at : Evaluation
        Its minimum.
    P : Posterior
        Covariances there.
    time : ndarray, shape (M,), s
        The times.
    """
    chain = problem.chain
    assert isinstance(chain, PlanarChain)
    out = chain.trajectory(at.states, P.nodes, chain.body_axes, time)
    bias = chain.heading_bias
    if bias not in problem.columns:
        return out
    rph, rph_cov = out.rph.copy(), out.rph_cov.copy()
    rph[:, 2] = (rph[:, 2] - at.parameters[bias][0]) % (2.0 * np.pi)
    root = problem.prior_root[problem.columns[bias]][0]
    rph_cov[:, 2, 2] += root @ P.parameters @ root
    return replace(out, rph=rph, rph_cov=rph_cov)


def _same(a: Mapping[str, Array], b: Mapping[str, Array]) -> bool:
    kept = [{k: v for k, v in each.items() if v.size} for each in (a, b)]
    return kept[0].keys() == kept[1].keys() and all(
        np.array_equal(kept[0][k], kept[1][k]) for k in kept[0]
    )
