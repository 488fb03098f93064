"""The newest nodes of a replay without IMU, and what is known of them by all that came before.

Variables that leave are eliminated in the order of time. What is left of their factors is one
linear factor on the first node that stays, on the processes there and on the constants. Noise and
strengths are those of a batch solution of the records up to a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.estimates import Noise, Trajectory
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.bound_observation import BoundObservation, processes_of
from factorgraph_dvl.graph.priors import ConstantsPrior
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.graph.template import jacobian_template
from factorgraph_dvl.graph.trajectory import TRAJECTORY_RATE
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeAngles
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Observation
from factorgraph_dvl.solvers.correlated_noise import noise_of
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.phases import PHASES, phases
from factorgraph_dvl.solvers.posterior import Posterior, posterior
from factorgraph_dvl.solvers.preparation_without_imu import (
    PreparationWithoutImu,
    lasting_observations,
    node_clock,
)
from factorgraph_dvl.solvers.true_times import (
    covariances_at_true_times,
    epochs_at_most,
    known_span,
    motion_at_true_times,
    nodes_late,
)
from factorgraph_dvl.statistics.elimination import eliminated
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation
from factorgraph_dvl.trial import Trial

# Density of acceleration in turns, m²/s³, until the first one; chosen: that of ships.
_FIRST_TURNS = 1e-3
# What sensors measure whose noise is that of their record.
_Measured = AttitudeAngles | PointPosition | PointVelocity
# Steps of a window. Measured: after one, σ of clocks were 5 % too small in turns.
_STEPS = 2


@dataclass(frozen=True)
class BatchSolution:
    """What windows take from a batch solution of the records up to a time.

    Parameters
    ----------
    trial : Trial
        Records up to then.
    chain : SmoothChain
        Its nodes.
    parameters : tuple of Parameter
        All of them, those that are not estimated included.
    clock_zero : float, s
        Reference time of the clock offsets.
    noise_factors, long_run : mapping of str to ndarray
        Factors of the problem.
    noise : tuple of Noise
        The same, as it is reported.
    late : float, s
        Stamps of the attitude less times of the nodes where it started: phases are by these.
    pings_late : float, s
        Stamps of pings less times of the nodes; zero where nodes have the clock of the pings.
    densities : ndarray, shape (4, 6)
        Densities of acceleration in each phase.
    tilt : ndarray, shape (P,), 1/s
        Gradient of the states' volume that every second adds.
    std : dict of str to ndarray
        Standard deviations (d,) of each label, of noise that sensors take from the whole record.
    labels : dict of str to set of str
        Labels of the measurements of each sensor, by its section.
    """

    trial: Trial
    chain: SmoothChain
    parameters: tuple[Parameter, ...]
    clock_zero: float
    noise_factors: Mapping[str, Array]
    long_run: Mapping[str, Array]
    noise: tuple[Noise, ...]
    late: float
    pings_late: float
    densities: Array
    tilt: Array
    std: dict[str, Array]
    labels: dict[str, set[str]]

    @classmethod
    def of(
        cls, prepared: PreparationWithoutImu, problem: Problem, duration: float
    ) -> BatchSolution:
        """Return what windows take from a minimum of records of some duration, s."""
        trial, chain = prepared.trial, problem.chain
        assert isinstance(chain, SmoothChain)
        assert trial.attitude is not None
        tilt = np.zeros(sum(p.mean.size for p in problem.parameters))
        if problem.tilt is not None:
            tilt = problem.tilt.gradient / duration
        start = problem.prior_values() | prepared.values
        lag = float(start[node_clock(trial, chain.frame)][0])
        late = float(start[trial.attitude.clock.offset.name][0])
        by_aid = [
            (aid, lasting_observations(aid, chain.frame, trial.body_axes, trial))
            for aid in trial.aids
        ]
        return cls(
            trial=trial,
            chain=chain,
            parameters=problem.all_parameters,
            clock_zero=problem.clock_zero,
            noise_factors=problem.noise_factors,
            long_run=problem.long_run,
            noise=noise_of(problem),
            late=late if chain.clock is None else late - lag,
            pings_late=lag if chain.clock is None else 0.0,
            densities=_densities(chain.density, prepared.phase),
            tilt=tilt,
            std={
                o.label: _typical(o.std)
                for aid, every in by_aid
                if isinstance(aid, Attitude | Ins)
                for o in every
                if isinstance(o, _Measured)
            },
            labels={aid.section: {o.label for o in every} for aid, every in by_aid},
        )

    def density(
        self, record: AttitudeRecord, records: Trial, time: Array, values: Mapping[str, Array]
    ) -> Array:
        """Return the densities of acceleration at times (M,) by the nodes' clock, (M, 6)."""
        mounting = values.get("misalignment_deg", np.eye(3))
        late = self.late - self.pings_late
        kinds = phases(record, time + self.late, records, mounting, late)
        return np.asarray(np.take_along_axis(self.densities, kinds, axis=0))

    def observations(self, aid: Aid) -> list[Observation]:
        """Return what some rows of a sensor measured, with the noise of the whole record."""
        out: list[Observation] = []
        axes = self.trial.body_axes
        for o in lasting_observations(aid, self.chain.frame, axes, self.trial):
            if not o.time.size:
                continue
            if isinstance(o, _Measured) and o.label in self.std:
                o = replace(o, std=o.std * (self.std[o.label] / _typical(o.std)))
            out.append(o)
        return out


def _densities(density: Array, phase: IntArray) -> Array:
    """Return the density (4, 6) of each phase from those of steps, and phases, (K - 1, 6).

    Where the vessel has not turned or climbed yet, another strength is assumed for that.
    """
    # It may have turned from the beginning.
    out = np.tile(np.take_along_axis(density, np.argmin(phase, axis=0)[None], axis=0), (PHASES, 1))
    for kind in range(PHASES):
        own = phase == kind
        first = np.take_along_axis(density, np.argmax(own, axis=0)[None], axis=0)[0]
        before = np.maximum(out[max(kind - 1, 0)], np.repeat([0.0, _FIRST_TURNS], 3))
        out[kind] = np.where(own.any(axis=0), first, before if kind else out[kind])
    return out


def _typical(std: Array) -> Array:
    """Return the median standard deviation of each component of measurements (M, d)."""
    return np.array([np.median(own[np.isfinite(own)]) for own in std.T])


@dataclass(frozen=True)
class Known:
    """What is known of the first node of a window by all that came before it.

    Parameters
    ----------
    keys, sizes : list of int
        Keys of the variables of the node, of processes and of constants, and their
        dimensions.
    root : ndarray, shape (m, n)
        Square root R of their information: R (x - x0) = d + unit noise. There may be less than n
        rows: of nodes after the first one a part is known.
    right : ndarray, shape (m,)
        Right-hand side d.
    values : gtsam.Values
        Where the rows are linear, x0.
    """

    keys: list[int]
    sizes: list[int]
    root: Array
    right: Array
    values: gtsam.Values

    def tilted(self, gradient: Array) -> Known:
        """Return it with a gradient (P,) of the cost by the constants, its last variables."""
        of_all = np.append(np.zeros(self.root.shape[1] - gradient.size), gradient)
        # Constants have priors, so that what is known has rows for every gradient by them.
        moved = np.linalg.lstsq(self.root.T, of_all, rcond=None)[0]
        return replace(self, right=self.right - moved)

    def factor(self) -> gtsam.LinearContainerFactor:
        """Return it as a factor."""
        linear = jacobian_template(self.keys, self.sizes, self.right.size)
        linear.getA()[...], linear.getb()[...] = self.root, self.right
        return gtsam.LinearContainerFactor(linear, self.values)


@dataclass(frozen=True)
class WindowChain(SmoothChain):
    """Nodes of which the first, and the constants, have a prior by all that came before.

    Parameters
    ----------
    known : Known
        The prior.
    """

    known: Known = field(kw_only=True)

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """What is known of the first node and the constants."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self.known.factor())
        return graph

    def add_prior(
        self,
        graph: gtsam.NonlinearFactorGraph,
        parameters: Sequence[Parameter],
        key_of: Mapping[str, int],
        constants_prior: ConstantsPrior | None,
    ) -> Sequence[Parameter]:
        """Add nothing, and leave nothing to add: what is known has all priors of parameters."""
        return ()

    def covers(self, time: Array) -> BoolArray:
        """Whether times (M,) are up to the last node but one: what came before is gone."""
        return np.asarray(time <= self.node_time[-2])


@dataclass(frozen=True)
class Past:
    """What leaves a window at a node that becomes the first.

    Parameters
    ----------
    known : Known
        What is known of what stays.
    processes : tuple of Process
        Processes as they go on.
    nodes : mapping of str to ndarray
        Their nodes (J, size) that stay, by name.
    measured : mapping of str to float
        Time, s, of the last measurement of each label that leaves.
    """

    known: Known
    processes: tuple[Process, ...]
    nodes: Mapping[str, Array]
    measured: Mapping[str, float]

    def going_on(
        self, observations: Sequence[Observation]
    ) -> tuple[list[Process], dict[str, Array]]:
        """Return processes with nodes as far as measurements need them, and values there."""
        processes, values = [], {}
        for process in self.processes:
            own = [o for o in observations if process in processes_of(o, [process]).all]
            last = max((float(o.time[-1]) for o in own), default=-np.inf)
            end, step = process.time[-1], float(process.time[-1] - process.time[-2])
            more = int(np.ceil((last - end) / step)) if last > end else 0
            time = np.append(process.time, end + step * np.arange(1, more + 1))
            walks = (o.scale_walk for o in own if o.label == process.label and process.walk)
            processes.append(process.going_on(time, next(walks, process.walk)))
            nodes = self.nodes[process.name]
            values[process.name] = np.concatenate([nodes, nodes[-1:].repeat(more, axis=0)])
        return processes, values


@dataclass(frozen=True)
class SteppedNodes:
    """Nodes and where a step of their problem led; also those of a batch solution.

    Parameters
    ----------
    problem : Problem
        Problem with a chain without IMU.
    evaluation : Evaluation
        Where the step ended.
    information : SquareRootInformation
        Square-root information from the elimination of the step, the constants last.
    """

    problem: Problem
    evaluation: Evaluation
    information: SquareRootInformation

    @property
    def last(self) -> int:
        """The last node at which something was measured."""
        raise NotImplementedError

    @property
    def now(self) -> float:
        """True time up to which the motion is known, s."""
        raise NotImplementedError

    @property
    def values(self) -> dict[str, Array]:
        """Values of parameters, and of the nodes of processes."""
        return self.evaluation.parameters

    @cached_property
    def constants(self) -> Array:
        """Covariance (P, P) of the parameters, in their tangent space, SI."""
        root = self.problem.prior_root
        return np.asarray(root @ self._posterior.parameters @ root.T)

    @property
    def _minimum(self) -> Minimum:
        return Minimum(self.evaluation, self.information, converged=True, iterations=0)

    @cached_property
    def _posterior(self) -> Posterior:
        return posterior(self.problem, self._minimum)

    def newest(self, body_axes: BodyAxes) -> Trajectory:
        """Return the newest motion that is known, as a trajectory of one epoch."""
        return self._at(np.array([self.now]), body_axes)

    def motion(self, since: float, last: int, body_axes: BodyAxes) -> Trajectory:
        """Return the motion after a true time, s, and up to a node."""
        return self._at(self._epochs(since, last), body_axes)

    def _epochs(self, since: float, last: int) -> Array:
        """Return the epochs after a true time, s, and up to a node."""
        raise NotImplementedError

    def _at(self, time: Array, body_axes: BodyAxes) -> Trajectory:
        """Return the motion at true times (M,), s."""
        raise NotImplementedError


@dataclass(frozen=True)
class Window(SteppedNodes):
    """Nodes of a smooth motion, the newest or all."""

    @property
    def chain(self) -> SmoothChain:
        """The nodes."""
        chain = self.problem.chain
        assert isinstance(chain, SmoothChain)
        return chain

    @property
    def last(self) -> int:
        """The last node at which something was measured; one more has the attitude after it."""
        return self.chain.node_time.size - 2

    @property
    def lag(self) -> float:
        """Times of the nodes less true times, s."""
        return nodes_late(self.chain, self.values)

    @property
    def now(self) -> float:
        """True time up to which the motion is known, s."""
        return known_span(self.chain, self.values)[1]

    @cached_property
    def states(self) -> Array:
        """Covariances (K, 3, 3, 3) of the states in n where the true times are exact."""
        return covariances_at_true_times(self.problem, self.evaluation, self._posterior)

    def _epochs(self, since: float, last: int) -> Array:
        first, end = known_span(self.chain, self.values)
        end = min(float(self.chain.node_time[last]) - self.lag, end)
        return epochs_at_most(self.chain, max(since, first), end, TRAJECTORY_RATE)

    def _at(self, time: Array, body_axes: BodyAxes) -> Trajectory:
        return motion_at_true_times(self.chain, self.evaluation, self.states, body_axes, time)

    def before(self, first: int) -> Past:
        """Return what all that came before a node say of what stays.

        The factors of measurements and steps after the node are left out: they are to be linear
        where the next window is.
        """
        problem, at = self.problem, self.evaluation
        gaussian = problem.linearize(at)
        starts = {p.name: self._first_node_of(p, first) for p in problem.processes}
        gone = set(self.chain.keys_of(range(first)))
        gone.update(p.key(j) for p in problem.processes for j in range(starts[p.name]))
        constants = {problem.key(p.name) for p in problem.parameters}
        past, priors = gtsam.GaussianFactorGraph(), problem.graph.size()
        for i in range(gaussian.size()):
            own = gaussian.at(i).keys()
            # Priors come first, but for those of processes, which have one variable, and for what
            # is of constants alone.
            prior = i < priors or constants.issuperset(own)
            prior = prior or (len(own) == 1 and keys.is_process(own[0]))
            if prior or not gone.isdisjoint(own):
                past.push_back(gaussian.at(i))
        ordering = problem.ordering()
        every = [ordering.at(i) for i in range(ordering.size())]
        leaving = keys.ordering(key for key in every if key in gone)
        _, rest = past.eliminatePartialMultifrontal(leaving, gtsam.EliminateQR)
        kept, matrix, vector = _depended_on(rest, every, at.values.dims())
        triangle = np.asarray(np.linalg.qr(np.column_stack([matrix, vector]), mode="r"))
        n = matrix.shape[1]
        chain, count = problem.chain, problem.chain.node_time.size
        staying, then = (
            chain.keys_of(each) for each in (range(first, count), range(count - first))
        )
        renamed = dict(zip(staying, then, strict=True))
        for p in problem.processes:
            first_left = starts[p.name]
            renamed |= {p.key(j): p.key(j - first_left) for j in range(first_left, p.time.size)}
        sizes, values = at.values.dims(), gtsam.Values()
        rotations = {problem.key(p.name) for p in problem.parameters if p.rotation}
        rotations.update(keys.attitude(k) for k in range(first, count))
        for key in kept:
            if key in rotations:
                values.insert(renamed.get(key, key), at.values.atRot3(key))
            else:
                values.insert(renamed.get(key, key), at.values.atVector(key))
        known = Known(
            [renamed.get(key, key) for key in kept],
            [int(sizes[key]) for key in kept],
            triangle[:n, :n],
            triangle[:n, n],
            values,
        )
        return Past(
            known,
            tuple(p.going_on(p.time[starts[p.name] :], p.walk) for p in problem.processes),
            {p.name: self.values[p.name][starts[p.name] :] for p in problem.processes},
            self._measured_before(first),
        )

    def _first_node_of(self, process: Process, first: int) -> int:
        """Return the first node of a process that measurements after a node of the chain need."""
        time = [self.chain.node_time[first:]]
        for bound in self.problem.bound:
            if process in self.problem.processes_of(bound).all:
                time.append(bound.observation.time[~self._leaving(bound, first)])
        return int(process.place(np.concatenate(time))[0].min())

    def _leaving(self, bound: BoundObservation, first: int) -> BoolArray:
        """Whether measurements (M,) depend on nodes before one."""
        return np.asarray(self.chain.nodes_at(bound.attachment).min(axis=1) < first)

    def _measured_before(self, first: int) -> dict[str, float]:
        """Return the time of the last measurement before a node, by label."""
        out = {}
        for bound in self.problem.bound:
            time = bound.observation.time[self._leaving(bound, first)]
            if time.size:
                out[bound.observation.label] = float(time[-1])
        return out


def information_without(
    problem: Problem, at: Evaluation, which: Mapping[str, BoolArray]
) -> SquareRootInformation:
    """Return the information without some measurements, of which the weights are as they were."""
    weights = [bound.weight for bound in problem.bound]
    for bound in problem.bound:
        bound.weight = bound.weight * ~which[bound.observation.label][:, None]
    information = _eliminated(problem, at)
    for bound, weight in zip(problem.bound, weights, strict=True):
        bound.weight = weight
    return information


def stepped(problem: Problem, at: Evaluation) -> Window:
    """Return a window after Gauss-Newton steps.

    The second is for the newest states: where they are only predicted, turns seem to say more of
    clocks than they do.
    """
    for _ in range(_STEPS):
        at = problem.weighed(at)
        information = _eliminated(problem, at)
        at = problem.evaluate(at.values.retract(information.solution()))
    return Window(problem, at, information)


def _eliminated(problem: Problem, at: Evaluation) -> SquareRootInformation:
    try:
        ordering = problem.ordering()
        return eliminated(problem.linearize(at), ordering, at.values.dims())
    except (RuntimeError, np.linalg.LinAlgError):
        raise SolveError(
            "the information is not positive definite",
            where="replay",
            hint="Inspect the trial: standard deviations may differ by too many digits",
        ) from None


def _depended_on(
    graph: gtsam.GaussianFactorGraph, every: Sequence[int], sizes: Mapping[int, int]
) -> tuple[list[int], Array, Array]:
    """Return the variables, in order, on which a graph depends, with its matrix and vector.

    A node of a process has zeros only where the last measurement was at the node before.
    """
    there = set(graph.keyVector())
    order = [key for key in every if key in there]
    matrix, vector = graph.jacobian(keys.ordering(order))
    parts = np.split(matrix, np.cumsum([sizes[key] for key in order])[:-1], axis=1)
    kept = {key: part for key, part in zip(order, parts, strict=True) if part.any()}
    return list(kept), np.concatenate(list(kept.values()), axis=1), vector
