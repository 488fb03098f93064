"""A trial as a factor graph: native IMU factors, and sensors linearised in bulk.

A measurement depends on the nodes around it, through what was measured of the motion in between.
Each sensor states its residual in terms of the motion at its time; the chain rule takes it to the
nodes. A clock that is estimated moves its measurements along the chain at every evaluation. All
measurements of a kind are evaluated in one NumPy pass and written into one Jacobian factor per
node, because a Python callback per factor would be slow and makes GTSAM's optimisers copy all
values.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.bound_observation import (
    BoundObservation,
    Processes,
    bound_to,
    processes_of,
)
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.elimination_order import Spans, elimination_order
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.measurement_factors import Evaluation, MeasurementFactors, Rows
from factorgraph_dvl.graph.native_graph import native_graph
from factorgraph_dvl.graph.priors import (
    ConstantsPrior,
    Tilt,
    add_priors,
    linear_prior,
    local_coordinates,
    places,
    prior_mean,
    prior_root,
    value_at,
)
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.graph.template import jacobian_template
from factorgraph_dvl.imu.window_means import SHORTEST
from factorgraph_dvl.sensors.gross_errors import gross_errors
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import (
    Motion,
    Observation,
)

__all__ = ["Evaluation", "Problem", "Rows"]

# Stands for zero in a fixed direction, in standard deviations of the prior. Chosen: what data
# that do not determine the direction cannot move.
FIXED_DIRECTION_STD = 1e-4
# Relative change of a standard deviation from which on measurements are weighed anew. Chosen:
# less hardly moves the minimum.
SAME_WEIGHT = 0.2


class Problem:
    """A chain with aiding sensors: what a solver minimises.

    Parameters
    ----------
    chain : Chain
        Nodes, and what ties them to each other.
    observations : sequence of Observation
        Measurements of the aiding sensors.
    parameters : sequence of Parameter
        Calibration parameters of the aiding sensors, fixed ones included.
    start : dict of str to ndarray, optional
        Values of parameters near which the solution is expected; by default the prior means.
    constants_prior : ConstantsPrior, optional
        Joint prior of biases and parameters, in place of their own.
    clock_zero : float, optional
        Reference time of the clock offsets, s; by default in the middle of the chain.
    processes : sequence of Process, optional
        Correlated errors of the observations, at most one each.
    usable : mapping of str to ndarray of bool, optional
        Measurements (M,) of each label that may be used where the chain covers them; by default
        all.
    tilt : Tilt, optional
        Gradient of the objective by the parameters that no residual has.

    Attributes
    ----------
    bound_at : dict of str to ndarray
        Values of parameters at which measurements were bound to the chain.
    processes : tuple of Process
        They may be replaced by others at the same nodes.
    noise_factors : mapping of str to ndarray
        Factors (d,) of each label on the standard deviations that sensors state for their own
        noise; 1 where there are none. `weigh` applies them.
    noise_growth : mapping of str to ndarray
        Factors (2,) of each label beside these, on the part of noise that is constant and on what
        grows with speed; one on average. Likewise.
    long_run : mapping of str to ndarray
        Factors (d,) of each label for noise that persists for some measurements; likewise.
    gain : float
        Fall of -2 log likelihood by that noise, against white noise.
    robust_weights : mapping of str to ndarray
        Weights of each label from 0 to 1 on the squares of residuals, (M, d) or (M, 1); likewise.
    imu_errors : ImuErrors or None
        Errors of the IMU that are estimated, None if there are none.

    Examples
    --------
    `solved_problems` makes the problem of a trial:

    >>> import factorgraph_dvl as fd
    >>> solved, *_ = fd.solved_problems(fd.simulate("examples/short.yaml", seed=1))
    >>> [p.name for p in solved.problem.parameters][:3]
    ['gnss_lever_arm_m', 'gnss_time_offset_s', 'misalignment_deg']
    """

    def __init__(
        self,
        chain: Chain,
        observations: Sequence[Observation],
        parameters: Sequence[Parameter],
        start: dict[str, Array] | None = None,
        constants_prior: ConstantsPrior | None = None,
        clock_zero: float | None = None,
        processes: Sequence[Process] = (),
        usable: Mapping[str, BoolArray] | None = None,
        tilt: Tilt | None = None,
    ) -> None:
        self.chain = chain
        self.processes = tuple(processes)
        # Reference time of the clock offsets, s.
        self.clock_zero = chain.middle if clock_zero is None else clock_zero
        self.all_parameters = tuple(parameters)
        self.parameters = tuple(p for p in parameters if p.estimated)
        self._key = {
            p.name: keys.calibration(i, p.mean.size) for i, p in enumerate(self.parameters)
        }
        self._fixed = {p.name: prior_mean(p) for p in parameters if not p.estimated}
        self.graph = gtsam.NonlinearFactorGraph(chain.graph)
        others = chain.add_prior(self.graph, self.parameters, self._key, constants_prior)
        add_priors(self.graph, others, self._key)
        self.tilt = tilt if self.parameters else None
        self._weighed_at: gtsam.Values | None = None
        # Factors from node to node, their matrices and vectors: views that live no longer.
        self._steps: list[tuple[gtsam.JacobianFactor, Array, Array]] = []
        self.uncovered: dict[str, int] = {}
        self.rejected: Mapping[str, Array] = {}
        self.noise_factors: Mapping[str, Array] = {}
        self.noise_growth: Mapping[str, Array] = {}
        self.long_run: Mapping[str, Array] = {}
        self.gain = 0.0
        self.robust_weights: Mapping[str, Array] = {}
        # What measurements that it does not cover cost where all were weighed, (M,) by label.
        self.usual_costs: dict[str, Array] = {}
        self.bound_at = {**self.prior_values(), **(start or {})}
        # Where measurements were at the last evaluation, by their times.
        self._attachments: dict[Hashable, Any] = {}
        self._bound: list[BoundObservation] = []
        for observation in observations:
            may_be_used = (usable or {}).get(observation.label)
            averages = observation.averaging in self._key
            bound = bound_to(
                chain, observation, self.bound_at, self.clock_zero, may_be_used, averages=averages
            )
            self._bound.append(bound)
            if not bound.usable.all():
                self.uncovered[observation.label] = int((~bound.usable).sum())
        self.imu_errors: ImuErrors | None = chain.errors(self.parameters, self._key)
        for bound in self._bound:
            bound.errors = self.imu_errors
        self._factors = MeasurementFactors.of(
            chain, self._bound, self.parameters, self._key, self.processes
        )

    @property
    def observations(self) -> tuple[Observation, ...]:
        """The observations, in the order of `Evaluation.residuals`."""
        return tuple(b.observation for b in self._bound)

    @property
    def bound(self) -> tuple[BoundObservation, ...]:
        """The observations as they are tied to the chain."""
        return tuple(self._bound)

    @property
    def usable(self) -> dict[str, BoolArray]:
        """Measurements (M,) that may be used and that the chain covers, by label."""
        return {b.observation.label: b.usable for b in self._bound}

    @property
    def weights(self) -> tuple[Array, ...]:
        """Inverse standard deviations of the observations, (M, d) each; 0 = not used."""
        return tuple(b.weight for b in self._bound)

    @property
    def used_count(self) -> int:
        """Number of components that are used, of all measurements."""
        return sum(int(np.count_nonzero(weight)) for weight in self.weights)

    @cached_property
    def clock_keys(self) -> list[int]:
        """Keys of the times that are estimated and move measurements along the chain.

        Clocks, and lengths of windows, which are cut where the samples end.
        """
        names = {n for b in self._bound for n in (*b.clocks, b.observation.averaging)}
        return [key for name, key in self._key.items() if name in names]

    def prior_values(self) -> dict[str, Array]:
        """Return the prior means of all parameters, rotations as matrices."""
        return {p.name: prior_mean(p) for p in self.all_parameters}

    def values(self, states: Any, parameters: dict[str, Array]) -> gtsam.Values:
        """Return GTSAM's values of states and parameters."""
        out = self.chain.values(states)
        for process in self.processes:
            for j, node in enumerate(process.nodes_of(parameters)):
                out.insert(process.key(j), node)
        for p in self.parameters:
            value = parameters[p.name]
            out.insert(self._key[p.name], gtsam.Rot3(value) if p.rotation else value)
        return out

    def arrays(self, values: gtsam.Values) -> tuple[Any, dict[str, Array]]:
        """Return states, and parameters by name, of GTSAM's values; rotations as matrices."""
        parameters = {**self._fixed}
        for p in self.parameters:
            parameters[p.name] = value_at(values, self._key[p.name], p)
        for process in self.processes:
            nodes = [values.atVector(process.key(j)) for j in range(process.time.size)]
            parameters[process.name] = np.array(nodes)
        return self.chain.states(values), parameters

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Place of every estimated parameter among all of them."""
        return places(self.parameters)

    @cached_property
    def prior_root(self) -> Array:
        """Square root S of the prior covariance S Sᵀ of all estimated parameters, (P, P), SI.

        In the tangent space at the prior's mean. Priors are stated for the rotation vector:
        Exp(alpha + a) = Exp(alpha) Exp(Jr(alpha) a).
        """
        return prior_root(self.parameters)

    def difference(self, parameters: dict[str, Array], origin: dict[str, Array]) -> Array:
        """Return parameters minus origin in the origin's tangent space, (P,), SI."""
        return np.concatenate(
            [local_coordinates(p, parameters[p.name], origin[p.name]) for p in self.parameters]
        )

    def fix_directions(self, directions: Array, origin: dict[str, Array]) -> None:
        """Fix combinations of the parameters at an origin.

        Parameters
        ----------
        directions : ndarray, shape (P, h)
            Orthonormal, in the coordinates u of a step S u, S `prior_root`.
        origin : dict of str to ndarray
            Values of the parameters there.
        """
        gain = directions.T @ np.linalg.inv(self.prior_root) / FIXED_DIRECTION_STD
        # Copies of the problem stay as they are.
        self.graph = gtsam.NonlinearFactorGraph(self.graph)
        self.graph.add(linear_prior(self.parameters, self._key, np.asarray(gain, float), origin))

    def evaluate(self, values: gtsam.Values) -> Evaluation:
        """Evaluate motion, residuals and cost."""
        states, parameters = self.arrays(values)
        own_cost = self.graph.error(values)
        if self.tilt is not None:
            own_cost += self.tilt.cost(self.parameters, parameters)
        imu = None
        if self.imu_errors is not None:
            errors = self.imu_errors.vector(parameters)
            imu = self.imu_errors.linearized(self.graph.linearize(values), errors)
            own_cost += imu.more_cost
        for step in self.chain.steps(states):
            own_cost += 0.5 * float(np.vdot(step.residual, step.residual))
        for process in self.processes:
            own_cost += 0.5 * float(np.sum(process.prior_residuals(parameters[process.name]) ** 2))
        attached = self._attached_at(parameters)
        motions = []
        computed: dict[int, Motion] = {}
        for bound, at in zip(self._bound, attached, strict=True):
            # Measurements at the same true times share the motion, of whatever sensor they are.
            if id(at) not in computed:
                computed[id(at)] = bound.motion(at, states, parameters)
            motions.append(computed[id(at)])
        residuals, cost = self._whitened(motions, parameters)
        return Evaluation(
            values,
            states,
            parameters,
            attached,
            motions,
            residuals,
            own_cost + cost,
            own_cost,
            imu,
        )

    def attach_as(self, other: Problem, evaluation: Evaluation) -> None:
        """Take the places on the chain from another problem with these nodes, as evaluated."""
        self._attachments = {
            other.place(bound, evaluation.parameters): at
            for bound, at in zip(other.bound, evaluation.attached, strict=True)
        }

    def place(self, bound: BoundObservation, parameters: Mapping[str, Array]) -> Hashable:
        """Return what decides where measurements are attached to the chain."""
        shift, times = self.chain.shift(parameters), bound.times(parameters)
        return bound.of_attitude, shift, times.tobytes(), bound.window(parameters)

    def _attached_at(self, parameters: dict[str, Array]) -> list[Any]:
        """Return where observations are attached to the chain.

        Those at the same times have the same attachment, until a clock moves them.
        """
        found: dict[Hashable, Any] = {}
        out = []
        for bound in self._bound:
            own = self.place(bound, parameters)
            if own not in found:
                at = self._attachments.get(own)
                found[own] = bound.attached(parameters) if at is None else at
            out.append(found[own])
        self._attachments = found
        if self.imu_errors is not None:
            self.imu_errors.attach(out)
        return out

    def without_tilt(self, evaluation: Evaluation) -> Evaluation:
        """Return an evaluation whose cost is that of residuals alone."""
        if self.tilt is None:
            return evaluation
        more = self.tilt.cost(self.parameters, evaluation.parameters)
        return replace(
            evaluation, cost=evaluation.cost - more, own_cost=evaluation.own_cost - more
        )

    def _whitened(
        self, motions: Sequence[Motion], parameters: dict[str, Array]
    ) -> tuple[list[Array], float]:
        """Return the whitened residuals of all observations, and their cost."""
        residuals = [
            bound.weight * bound.residual(motion, parameters, self.processes_of(bound))
            for bound, motion in zip(self._bound, motions, strict=True)
        ]
        return residuals, sum(0.5 * float(np.vdot(each, each)) for each in residuals)

    def residual(
        self, observation: Observation, motion: Motion, parameters: dict[str, Array]
    ) -> Array:
        """Return predicted - measured, (M, d), its correlated error included in what is predicted.

        Parameters
        ----------
        observation : Observation
            One of the problem's.
        motion : Motion
            Motion at the true times.
        parameters : dict of str to ndarray
            Parameters of an evaluation.
        """
        (bound,) = (b for b in self._bound if b.observation is observation)
        return bound.residual(motion, parameters, self.processes_of(bound))

    def processes_of(self, bound: BoundObservation) -> Processes:
        """Return the processes that an observation depends on."""
        return processes_of(bound.observation, self.processes)

    def reject(self, rejected: Mapping[str, Array]) -> None:
        """Use no measurements at the times (K,) that are given by label."""
        self.rejected = rejected
        for bound in self._bound:
            times = rejected.get(bound.observation.label, np.empty(0))
            left_out = np.isin(bound.observation.time, times)
            bound.usable[left_out] = False
            bound.weight[left_out] = 0.0

    def outliers(self, evaluation: Evaluation) -> dict[str, Array]:
        """Return the times of measurements that miss by more than their gate, by label.

        A sensor whose measurements may be none at all, as the range of an echo, has a `gate`
        in standard deviations as stated; others have none.
        """
        out = {}
        for bound, motion, sigma in zip(
            self._bound, evaluation.motions, self.sigma(evaluation, {}), strict=True
        ):
            o = bound.observation
            if o.gate is None:
                continue
            before = np.isin(o.time, self.rejected.get(o.label, np.empty(0)))
            miss = self.residual(o, motion, evaluation.parameters)
            far = np.abs(miss) > o.gate * sigma
            times = o.time[(before | (bound.weight > 0.0).any(axis=1)) & far.any(axis=1)]
            if times.size:
                out[o.label] = times
        return out

    def weigh(self, evaluation: Evaluation) -> None:
        """Set the weights of all measurements from their standard deviations there."""
        self._weighed_at = evaluation.values
        weights = self._weights(evaluation)
        for bound, weight in zip(self._bound, weights, strict=True):
            bound.weight = weight
        self.usual_costs = {
            bound.observation.label: self._usual_cost(i, evaluation)
            for i, bound in enumerate(self._bound)
            if not bound.usable.all()
        }
        if not self.chain.interpolates:
            gradient = self._gradient_of_windows(evaluation, weights)
            sigma = [p.sigma for p in self.parameters]
            self.tilt = None
            if gradient.any():
                self.tilt = Tilt(gradient, np.concatenate(sigma), self.prior_values())

    def _gradient_of_windows(self, evaluation: Evaluation, weights: Sequence[Array]) -> Array:
        """Return what lengths of windows take of the cost by averaging noise of the IMU, (P,).

        Residuals have this noise. A longer window has less of it, whatever the sensor does, and
        would be the better model for that alone.
        """
        gradient = np.zeros(len(self.prior_root))
        for bound, weight, at, motion in zip(
            self._bound, weights, evaluation.attached, evaluation.motions, strict=True
        ):
            name = bound.observation.averaging
            if name not in self.columns:
                continue
            size = abs(float(evaluation.parameters[name][0]))
            length = max(size, SHORTEST)
            lin = bound.by_motion(motion, evaluation.parameters, self.processes_of(bound))
            saved = bound.averaged_noise(at, lin, length, weight)
            # Below that, what a window does goes by the square x² of its length: it takes
            # (6 x² - 2 x⁴) / 24 of it, as its covariance with what it averages is 1/8 of it.
            short = size / length
            share = 1.5 * short - 0.5 * short**3
            gradient[self.columns[name]] += 0.5 * share * saved / length
        return gradient

    def weighed(self, evaluation: Evaluation) -> Evaluation:
        """Weigh the measurements as `weigh` does; return what the evaluation then is."""
        at = self.without_tilt(evaluation)
        self.weigh(evaluation)
        own_cost = at.own_cost
        if self.tilt is not None:
            own_cost += self.tilt.cost(self.parameters, evaluation.parameters)
        residuals, cost = self._whitened(evaluation.motions, evaluation.parameters)
        return replace(evaluation, residuals=residuals, cost=own_cost + cost, own_cost=own_cost)

    def needs_reweighting(self, evaluation: Evaluation) -> bool:
        """Whether standard deviations there are other than those that measurements count by."""
        weights = self._weights(evaluation)
        for bound, weight in zip(self._bound, weights, strict=True):
            used = weight > 0.0
            if np.any(np.abs(bound.weight[used] / weight[used] - 1.0) > SAME_WEIGHT):
                return True
        if self.chain.interpolates:
            return False
        then = self._gradient_of_windows(evaluation, weights)
        now = 0.0 if self.tilt is None else self.tilt.gradient
        return bool(np.any(np.abs(now - then) > SAME_WEIGHT * np.abs(then)))

    @property
    def white_factors(self) -> dict[str, Array]:
        """Factors (d,) on the stated standard deviations of white noise, by label."""
        return {
            label: np.asarray(self.noise_factors.get(label, 1.0) * self.long_run.get(label, 1.0))
            for label in {*self.noise_factors, *self.long_run}
        }

    @property
    def factors_by_part(self) -> dict[str, Array]:
        """The same by label, (2, d) where a constant part and one by speed have their own."""
        return {label: self._by_part(label, own) for label, own in self.white_factors.items()}

    def _by_part(self, label: str, factor: Array | float) -> Array:
        growth = self.noise_growth.get(label)
        return np.asarray(factor if growth is None else growth[:, None] * factor)

    def sigma(
        self, evaluation: Evaluation, factors: Mapping[str, Array | float] | None = None
    ) -> list[Array]:
        """Return the standard deviations of all observations, (M, d) each.

        Infinite where a component was not measured.

        Parameters
        ----------
        evaluation : Evaluation
            Where they are taken.
        factors : mapping of str to ndarray, optional
            Factors (d,) by label, by default `noise_factors`; (2, d) where noise has two parts.
        """
        factors = self.noise_factors if factors is None else factors
        out = []
        for bound, at, motion in zip(
            self._bound, evaluation.attached, evaluation.motions, strict=True
        ):
            label = bound.observation.label
            own = self._by_part(label, factors.get(label, 1.0) * self.long_run.get(label, 1.0))
            values = bound.values(evaluation.parameters, self.processes_of(bound))
            sigma = bound.observation.sigma(motion, values, own)
            missing = bound.missing(at, motion, evaluation.parameters, self.processes_of(bound))
            out.append(sigma if missing is None else np.sqrt(sigma**2 + missing))
        return out

    def log_sigma(self, evaluation: Evaluation) -> list[Array]:
        """Return the sums of the logarithms of the standard deviations of measurements, (M,) each.

        Those that measurements count by: where these follow a prediction, as a share of the speed,
        they are not those of the evaluation. Costs of minima whose measurements weigh differently
        compare with these added. Where a measurement is rejected, the cost of a gross error. Where
        the chain does not cover it, as at the ends by another clock, what it costs on average by
        noise as stated, so that problems with more measurements and with fewer compare.
        """
        out = []
        sigma: list[Array] | None = None
        for i, bound in enumerate(self._bound):
            used = bound.weight > 0.0
            logarithm = np.where(used, -np.log(np.where(used, bound.weight, 1.0)), 0.0)
            o = bound.observation
            left_out = np.isin(o.time, self.rejected.get(o.label, np.empty(0)))
            wrong = (self.robust_weights.get(o.label, np.ones(1)) == 0.0) | left_out[:, None]
            if wrong.any():
                sigma = sigma or self.sigma(evaluation)
                measured = np.isfinite(sigma[i])
                error = self.residual(o, evaluation.motions[i], evaluation.parameters)
                cost = gross_errors(np.where(measured, error, np.nan), sigma[i], wrong, o.unit)
                logarithm = np.where(wrong & measured, cost - 0.5 * np.log(2.0 * np.pi), logarithm)
            each = np.sum(logarithm, axis=1)
            uncovered = ~(bound.usable | wrong.any(axis=1))
            if uncovered.any():
                usual = self.usual_costs.get(o.label)
                usual = self._usual_cost(i, evaluation) if usual is None else usual
                each[uncovered] = usual[uncovered]
            out.append(each)
        return out

    def _usual_cost(self, i: int, evaluation: Evaluation) -> Array:
        """Return what measurements cost on average by noise as it is stated, (M,)."""
        bound = self._bound[i]
        values = bound.values(evaluation.parameters, self.processes_of(bound))
        sigma = bound.observation.sigma(evaluation.motions[i], values, 1.0)
        return np.sum(np.where(np.isfinite(sigma), np.log(sigma) + 0.5, 0.0), axis=1)

    def _weights(self, evaluation: Evaluation) -> list[Array]:
        """Return the weights that measurements have by their standard deviations there."""
        out = []
        for bound, sigma in zip(self._bound, self.sigma(evaluation), strict=True):
            root = np.sqrt(self.robust_weights.get(bound.observation.label, 1.0))
            out.append(bound.usable[:, None] * root / sigma)
        return out

    def linearize(self, evaluation: Evaluation) -> gtsam.GaussianFactorGraph:
        """Return the Gaussian graph at an evaluation.

        Its measurement factors are written in place at the next call.
        """
        gaussian = self.native(evaluation)
        if self.tilt is not None:
            tilt = self.tilt.factor(self.parameters, self._key)
            gaussian.push_back(tilt.linearize(evaluation.values))
        self._add_steps(gaussian, evaluation)
        for factor in self._factors.written(evaluation, self.processes):
            gaussian.push_back(factor)
        return gaussian

    def release(self) -> None:
        """Free the factors of measurements; the next linearisation makes others."""
        self._factors.release()
        self._steps = []
        if self.imu_errors is not None:
            self.imu_errors.release()

    def observation_rows(self, evaluation: Evaluation) -> Iterator[Rows]:
        """Yield the rows of each observation, some at a time.

        Unused ones are included: these are zero.
        """
        yield from self._factors.rows(evaluation, self.processes)

    def observation_rows_at(
        self, evaluation: Evaluation, parameters: Mapping[str, Array]
    ) -> Iterator[Rows]:
        """Yield the rows of the observations that depend on parameters, at values of these.

        States, other parameters and weights are those of the evaluation.

        Parameters
        ----------
        evaluation : Evaluation
            Where the graph is linear but for these parameters.
        parameters : mapping of str to ndarray
            Values of some parameters by name, rotations as matrices; not of clocks.
        """
        yield from self._factors.rows_at(evaluation, parameters, self.processes)

    def nonlinear_graph(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the whole problem for GTSAM's own optimisers, and values to start from.

        The graph has clocks, errors of the IMU, priors, gravity per segment, weights and outliers
        as they are in the problem now; the values are those at which measurements were weighed
        last. GTSAM copies all values at each measurement factor: use short trials, up to some
        hundred states.

        Returns
        -------
        graph : gtsam.NonlinearFactorGraph
            Its minimum is that of the problem, and its error the cost but for a constant: that of
            the tilt, which is a factor of its own.
        values : gtsam.Values
            States `x`, biases `b` or rates `w`, and parameters, at `key`.

        Raises
        ------
        ValueError
            If measurements have not been weighed yet.
        """
        if self._weighed_at is None:
            raise ValueError("the measurements have no weights yet: call `weigh` first")
        self._factors.follow(self.evaluate(self._weighed_at))
        return native_graph(self), gtsam.Values(self._weighed_at)

    def native(self, evaluation: Evaluation) -> gtsam.GaussianFactorGraph:
        """Return the factors of priors, of processes and of GTSAM, linear at an evaluation."""
        if self.imu_errors is None or evaluation.imu is None:
            out = self.graph.linearize(evaluation.values)
        else:
            out = self.imu_errors.filled(evaluation.imu)
        for process in self.processes:
            process.add_prior(out, evaluation.parameters[process.name])
        return out

    def _add_steps(self, gaussian: gtsam.GaussianFactorGraph, evaluation: Evaluation) -> None:
        """Add the factors from node to node; these are written in place at the next call."""
        count = 0
        for rows in self.chain_rows(evaluation):
            for own, by, residual in zip(
                rows.keys.tolist(), rows.matrix, rows.vector, strict=True
            ):
                if count == len(self._steps):
                    factor = jacobian_template(own, rows.sizes, len(rows.components))
                    self._steps.append((factor, factor.getA(), factor.getb()))
                factor, matrix, vector = self._steps[count]
                matrix[...], vector[...] = by, -residual
                gaussian.push_back(factor)
                count += 1

    def chain_rows(self, evaluation: Evaluation) -> Iterator[Rows]:
        """Yield the rows from node to node that GTSAM does not linearise itself."""
        for step in self.chain.steps(evaluation.states):
            node = np.arange(step.first, step.first + len(step.residual))
            variables = np.column_stack(self.chain.variables(node[:, None]))
            yield Rows(
                step.source,
                step.components,
                variables,
                tuple(self.chain.sizes),
                step.by_nodes,
                step.residual,
                step.first,
            )

    def ordering(self) -> gtsam.Ordering:
        """Return an elimination order in which biases and calibration come last."""
        every = self.chain.spans(self.bound_at)
        of_processes = [
            Spans([[p.key(j)] for j in range(p.time.size)], p.time) for p in self.processes
        ]
        first = elimination_order(self.chain.node_time, [*every, *of_processes])
        last = [*self.chain.constants, *(self._key[p.name] for p in self.parameters)]
        return keys.ordering([*first, *last])

    def key(self, name: str) -> int:
        """Return the key of an estimated parameter."""
        return self._key[name]
