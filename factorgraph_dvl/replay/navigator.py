"""Navigation from segment to segment: predict, compare, update."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.inertial_chain import InertialChain, states_of
from factorgraph_dvl.graph.keys import BIAS_SIZE, STATE_SIZE
from factorgraph_dvl.graph.priors import ConstantsPrior, local_coordinates, value_at
from factorgraph_dvl.graph.sensor_factor import (
    Linearized,
    NodeMeasurements,
    bind,
    measurement_factor,
)
from factorgraph_dvl.graph.trajectory import (
    TRAJECTORY_RATE,
    Epochs,
    attached_epochs,
    epochs_between,
    reported,
    successive,
    tangent_in_n,
    trajectory_at,
)
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.replay.calibration import CalibrationEstimate, CalibrationReport
from factorgraph_dvl.replay.gate import InnovationGate, gated
from factorgraph_dvl.replay.record import Innovations
from factorgraph_dvl.replay.smoother import Smoother
from factorgraph_dvl.replay.spurious import SpuriousInformation
from factorgraph_dvl.replay.start import ReplayStart
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Observation

# Agreement of smoother and batch solution, in standard deviations, and standard deviation of
# rotations, rad, from which on linearising once is enough; chosen. Measured: final estimates are
# then within 0.1 standard deviations of those of a batch solution.
_AGREEMENT = 0.1
_SETTLED_ROTATION = np.radians(0.2)
# Distance, m, over which gravity is taken as linear. Measured against the full model: the error
# stays below 3e-9 m/s².
_LINEAR = 100.0


class LocalGravity:
    """`LocalFrame.gravity_without_rotation`, expanded to first order about a recent position.

    Parameters
    ----------
    frame : LocalFrame
        Navigation frame in which positions are given.
    """

    def __init__(self, frame: LocalFrame) -> None:
        self._frame = frame
        self._origin = np.full(3, np.inf)

    def at(self, p_n: Array) -> Array:
        """Return gravity (1, 3), m/s², at a position (1, 3), m."""
        shift = p_n[0] - self._origin
        if shift @ shift > _LINEAR**2:
            self._origin = p_n[0]
            nearby = p_n + _LINEAR * np.vstack([np.zeros(3), np.eye(3)])
            found = self._frame.gravity_without_rotation(nearby)
            self._value, self._gradient = found[0], (found[1:] - found[0]) / _LINEAR
        return self._value + (p_n - self._origin) @ self._gradient


@dataclass(frozen=True)
class _LinearizationPoint:
    """Where GTSAM linearises the newest state, its bias and the parameters."""

    state: gtsam.NavState
    bias: gtsam.imuBias.ConstantBias
    parameters: Mapping[str, Array]


@dataclass(frozen=True)
class _Segment:
    """A segment as a chain of its own, and the epochs in it."""

    chain: InertialChain

    @cached_property
    def epochs(self) -> Epochs:
        """The epochs of a trajectory, attached once they are asked for."""
        start, end = self.chain.node_time.tolist()
        return self.at(epochs_between(start, end, TRAJECTORY_RATE))

    def at(self, time: Array) -> Epochs:
        """Return some epochs, attached."""
        rate = self.chain.frame.earth_rate
        return attached_epochs(self.chain.segments, time, rate, np.empty(0))[0]


class Navigator:
    """Navigation between two batch solutions.

    Parameters
    ----------
    start : ReplayStart
        State, covariance and parameters to start from.
    gate : InnovationGate
        Gate that decides which measurements are used.
    lag : float or None
        Lag of the smoother, s; None to correct all states for ever.
    memory : float
        Span for which segments are kept for measurements that arrive late, s.

    Attributes
    ----------
    smoother : Smoother
        Incremental smoother.
    frame : LocalFrame
        Navigation frame of the states.
    first_motion : Trajectory
        Motion that the start has found.
    values : dict of str to ndarray
        Values of all parameters, SI; rotations as matrices.
    undetermined : ndarray, shape (P, h)
        Directions of the parameters that are not observable.
    innovations : list of Innovations
        Innovations since they were last taken.
    findings : list of Finding
        Findings since they were last taken.
    """

    def __init__(
        self,
        start: ReplayStart,
        gate: InnovationGate,
        *,
        lag: float | None,
        memory: float,
    ) -> None:
        self.start = start
        self.frame, self.first_motion = start.frame, start.trajectory
        self._gate = gate
        self._memory = memory
        self._smoothed_to = start.node
        self.smoother = Smoother(
            start.prior,
            start.values,
            node=start.node,
            time=start.time,
            parameters=start.parameters,
            walking=start.walking,
            lag=lag,
            ranges=start.ranges,
            errors=start.errors.size,
        )
        self._report = CalibrationReport(start.all_parameters, *start.chain.first_biases)
        self._gravity = LocalGravity(start.frame)
        self._segments: dict[int, _Segment] = {}
        # By the names of parameters: their columns, and those of state and bias before them.
        self._own: dict[tuple[str, ...], IntArray] = {}
        self.innovations: list[Innovations] = []
        self.findings: list[Finding] = []
        self._refresh()
        self._start_values = {
            p.name: value_at(start.values, self.smoother.calibration_keys[p.name], p)
            for p in start.parameters
        }
        self.spurious = SpuriousInformation(start)
        self.undetermined = self.spurious.undetermined(self._parameter_covariance)
        # Without a lag GTSAM moves the linearisation point by itself.
        self._linear: _LinearizationPoint | None = None
        if lag is not None:
            bias = start.values.atConstantBias(self.smoother.bias_key(start.node))
            state = start.values.atNavState(keys.node(start.node))
            self._linear = _LinearizationPoint(state, bias, self._start_values)

    @property
    def time(self) -> float:
        """Time of the newest state, s."""
        return self.smoother.times[self.smoother.node]

    @property
    def rotation_change(self) -> float:
        """Largest change of a rotation among the parameters since the start, rad."""
        changes = (
            local_coordinates(p, self.values[p.name], self._start_values[p.name])
            for p in self.start.parameters
            if p.rotation
        )
        return max((float(np.linalg.norm(change)) for change in changes), default=0.0)

    @property
    def _parameter_covariance(self) -> Array:
        return self._P[STATE_SIZE + BIAS_SIZE :, STATE_SIZE + BIAS_SIZE :]

    def covariance_of(self, parameter: Parameter) -> Array:
        """Return the covariance of a parameter in its tangent space, SI."""
        own = self.start.columns([parameter.name])
        return self._parameter_covariance[np.ix_(own, own)]

    def extend(self, seg: Segments, aids: Sequence[Aid]) -> None:
        """Add the segment after the newest state, and what was measured in it."""
        s = self.smoother
        k = s.node
        state, bias = s.state(k), s.bias(k)
        duration = float(seg.duration[0])
        middle = state.position() + 0.5 * duration * state.velocity()
        gravity = self._gravity.at(middle[None])
        chain = self.start.chain.following(seg, gravity, k)
        self._segments[k] = _Segment(chain)
        measured, imu_errors = self._bound(chain, aids)
        motion: Any = chain.graph.at(0)
        predicted = motion.preintegratedMeasurements().predict(state, bias)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if imu_errors is not None:
            predicted = predicted.retract(imu_errors.ends(self.values)[0])
            (motion,) = imu_errors.factors(chain.graph)
        factors.add(motion)
        values.insert(keys.node(k + 1), nav_state=predicted)
        if self.start.walking:
            factors.add(chain.graph.at(1))
            values.insert(keys.bias(k + 1), bias)
        errors = self.start.errors
        if errors.size:
            factors.add(errors.transition(k, duration))
            values.insert(keys.correlated(k + 1), errors.after(duration) * s.errors(k))
        end = float(seg.node_time[1])
        if measured is not None:
            self._add_factor(factors, k, measured, motion, predicted)
        s.extend(end, factors, values)
        if self._linear is not None:
            if not self.start.walking:
                bias = self._linear.bias
            self._linear = _LinearizationPoint(predicted, bias, self._start_values)
        self._P_before = self._P[:STATE_SIZE, :STATE_SIZE]
        since = max(s.times[s.oldest], self.time - self._memory)
        while self._segments:
            old = next(iter(self._segments))
            if s.times.get(old, -np.inf) >= since:
                break
            del self._segments[old]
        self._refresh()

    def correct(self, aids: Mapping[int, Sequence[Aid]]) -> None:
        """Add measurements that arrived late, by the index of the state before them."""
        factors = gtsam.NonlinearFactorGraph()
        for k, records in aids.items():
            chain = self._segments[k].chain
            measured, imu_errors = self._bound(chain, records)
            if measured is not None:
                motion = chain.graph.at(0)
                if imu_errors is not None:
                    (motion,) = imu_errors.factors(chain.graph)
                self._add_factor(factors, k, measured, motion)
        if factors.size():
            self.smoother.correct(factors, min(aids))
            self._refresh()

    def _bound(
        self, chain: InertialChain, aids: Sequence[Aid]
    ) -> tuple[NodeMeasurements | None, ImuErrors | None]:
        """Return what was measured in a segment, None if nothing, and errors of the IMU there."""
        start = self.start
        observations: list[Observation] = []
        for aid in aids:
            observations += aid.observations(start.frame, start.body_axes)
        own = self.smoother.calibration_keys
        bound, errors = bind(chain, observations, start.parameters, own, start.clock_zero)
        if not bound:
            return None, errors
        return NodeMeasurements.of(bound, start.parameters, start.fixed), errors

    def known(self, later: float) -> ConstantsPrior:
        """Return what will be known of biases and parameters `later` seconds from now."""
        values, P = self._with_walks()
        P = P.copy()
        P[:BIAS_SIZE, :BIAS_SIZE] += np.diag(self._walk_root_psd**2) * later
        bias = self.smoother.bias(self.smoother.node).vector()
        parameters = {p.name: values[p.name] for p in self.start.parameters}
        return ConstantsPrior(bias, parameters, P)

    def node_before(self, time: float) -> int | None:
        """Return the state whose segment contains a time, None if it is gone or yet to come."""
        for k in reversed(self._segments):
            if self.smoother.times[k] <= time:
                return k if time < self.smoother.times[k + 1] else None
        return None

    def agrees_with(self, before: Navigator) -> bool:
        """Whether this start is what the smoother before it had found, and stays linear there."""
        if before.start.sections != self.start.sections or self.undetermined.size:
            return False
        old, new = before.calibration(), self.calibration()
        if [e.name for e in old.estimates] != [e.name for e in new.estimates]:
            # A parameter that was stated as known is estimated instead.
            return False
        std = np.sqrt(np.diag(new.covariance))
        free = std > 0.0
        moved = np.concatenate(
            [a.value - b.value for a, b in zip(old.estimates, new.estimates, strict=True)]
        )
        return bool(np.all(np.abs(moved[free]) < _AGREEMENT * std[free])) and all(
            np.all(np.diag(self.covariance_of(p)) < _SETTLED_ROTATION**2)
            for p in self.start.parameters
            if p.rotation
        )

    def calibration(self) -> CalibrationEstimate:
        """Return the calibration as it is reported."""
        return self.find_calibration()()

    def find_calibration(self) -> Callable[[], CalibrationEstimate]:
        """Return what computes the calibration that is known now, whenever it is called."""
        bias = self.smoother.bias(self.smoother.node).vector()
        values, P = self._with_walks()
        return partial(self._report.at, values, bias, P, self.undetermined)

    def _with_walks(self) -> tuple[dict[str, Array], Array]:
        """Return values, and covariance of biases and parameters, with scales as they are now."""
        errors = self.start.errors
        P, values = self._P[STATE_SIZE:, STATE_SIZE:], self.values
        if not errors.walks:
            return values, P
        now = errors.sigma * self.smoother.errors(self.smoother.node)
        size = len(P)
        to_now = np.eye(size, size + errors.size)
        for name, i in errors.walks.values():
            values = {**values, name: values[name] + now[i]}
            to_now[BIAS_SIZE + self.start.columns([name]), size + i] = errors.sigma[i]
        whole = self._P_with_errors[STATE_SIZE:, STATE_SIZE:]
        return values, to_now @ whole @ to_now.T

    def newest(self, body_axes: BodyAxes) -> Callable[[], Trajectory]:
        """Return what computes the newest state as known now, as a trajectory of one epoch."""
        k, P = self.smoother.node, self._P[:STATE_SIZE, :STATE_SIZE]
        states, time = self.smoother.states([k]), np.array([self.time])

        def state() -> Trajectory:
            P_n = tangent_in_n(P[None], states.nRb)
            return reported(time, states, P_n, self.start.frame, body_axes)

        return state

    def smoothed(self, body_axes: BodyAxes, *, rest: bool = False) -> Trajectory | None:
        """Return smoothed motion that was not returned before: what is old, or all the rest.

        None if there is none, or the older half of it stays within the lag for now.
        """
        s = self.smoother
        oldest = s.times.get(self._smoothed_to, np.inf)
        if not rest and self.time - oldest <= self._memory - 2.0 * self.start.interval:
            return None
        newest = np.inf if rest else self.time - 0.5 * self._memory
        first, last = self._smoothed_to, max(k for k, t in s.times.items() if t <= newest)
        if last <= first:
            return None
        self._smoothed_to = last
        wanted = [k for k in self._segments if first <= k < last]
        P = s.state_covariances([*wanted, last])
        states = s.states([*wanted, last])
        parts = [self._segments[k] for k in wanted]
        gravity = np.concatenate([part.chain.gravity_n for part in parts])
        epochs = successive([part.epochs for part in parts])
        return trajectory_at(epochs, states, P, gravity, self.start.frame, body_axes)

    def last_segment(self, body_axes: BodyAxes, since: float) -> Callable[[], Trajectory]:
        """Return what computes the motion as known now, at the epochs after a time, s.

        The time is that of the state before it, but for what stamps have been corrected since.
        """
        k, start = self.smoother.node - 1, self.start
        part, states = self._segments[k], self.smoother.states([k, k + 1])
        covariances = self._P_before, self._P[:STATE_SIZE, :STATE_SIZE]
        end = self.time

        def motion() -> Trajectory:
            time = epochs_between(since, end, TRAJECTORY_RATE)
            epochs, P = part.epochs, np.stack(covariances)
            if not np.array_equal(time, epochs.time):
                epochs = part.at(time)
            return trajectory_at(epochs, states, P, part.chain.gravity_n, start.frame, body_axes)

        return motion

    @property
    def _walk_root_psd(self) -> Array:
        s = self.start.chain.imu
        return np.repeat([s.accel_bias_walk_root_psd, s.gyro_bias_walk_root_psd], 3)

    def _refresh(self) -> None:
        self._P_with_errors = self.smoother.joint_covariance()
        size = len(self._P_with_errors) - self.start.errors.size
        self._P = self._P_with_errors[:size, :size]
        self.values = {**self.start.fixed, **self.smoother.calibration()}

    def _add_factor(
        self,
        factors: gtsam.NonlinearFactorGraph,
        k: int,
        measured: NodeMeasurements,
        motion: gtsam.NonlinearFactor,
        predicted: gtsam.NavState | None = None,
    ) -> None:
        """Add the factor of measurements after state k that the gate accepts.

        Parameters
        ----------
        factors : gtsam.NonlinearFactorGraph
            Added to.
        k : int
            State.
        measured : NodeMeasurements
            What was measured between it and the next.
        motion : gtsam.NonlinearFactor
            Factor of the IMU between both.
        predicted : gtsam.NavState, optional
            The next state where it is yet to come.
        """
        s, walking = self.smoother, self.start.walking
        names = tuple(p.name for p in measured.parameters)
        if names not in self._own:
            own = np.arange(STATE_SIZE + BIAS_SIZE)
            self._own[names] = np.append(own, own.size + self.start.columns(names))
        own = self._own[names]
        after = s.state(k + 1) if predicted is None else predicted
        bias_after = s.bias(k if predicted is not None else k + 1)
        # Where GTSAM will linearise what is new, so this is done once only.
        at = None if predicted is None else self._linear
        state, bias = (s.state(k), s.bias(k)) if at is None else (at.state, at.bias)
        parameters = self.values if at is None else at.parameters
        states = states_of([state, after], [bias, bias_after] if walking else [bias])
        residual, matrix, motions, missing = measured.linearize(states, parameters)
        first = None if at is None else Linearized(states, parameters, residual, matrix)
        if at is not None:
            by_known = np.delete(matrix, self._of_node_after, axis=1)
            residual = residual + by_known @ self._local_coordinates(at)[own]
        there = gtsam.Values()
        # By its name GTSAM finds the overload in a third of the time.
        there.insert(keys.node(k), nav_state=state)
        there.insert(keys.node(k + 1), nav_state=after)
        there.insert(s.bias_key(k), constant_bias=bias)
        for p in measured.parameters:
            if p.name in ERRORS:
                there.insert(s.calibration_keys[p.name], parameters[p.name])
        jacobian, added = self._from_before(measured, matrix, motion.linearize(there))
        sigma = measured.sigma(motions, missing, self.values, self.start.noise_factors)
        errors = None
        if self.start.errors.size:
            errors, error = self._correlated_errors(k, measured)
            residual = residual + error
            jacobian = np.hstack([jacobian, sum(errors.values())])
            own = np.append(own, np.arange(len(self._P), len(self._P_with_errors)))
        P = self._P_with_errors[own[:, None], own]
        added += ((jacobian @ P) * jacobian).sum(axis=1)
        weights, innovations, findings = gated(measured, residual, added, sigma, self._gate)
        self.innovations += innovations
        self.findings += findings
        state_P = self._P[:STATE_SIZE, :STATE_SIZE]
        if self.spurious.add(measured, motions, weights, self.values, state_P, self.time):
            self.undetermined = self.spurious.undetermined(self._parameter_covariance)
        weight = np.concatenate([w.ravel() for w in weights])
        if weight.any():
            shared = [s.calibration_keys[name] for name in names]
            nodes = [int(key) for (key,) in self.start.chain.variables(np.array([[k]]))]
            factors.add(measurement_factor(measured, weight, nodes, shared, first, errors))

    @property
    def _of_node_after(self) -> slice:
        """Columns of measurements by the node after."""
        return slice(STATE_SIZE + BIAS_SIZE, sum(self.start.chain.sizes))

    def _from_before(
        self, measured: NodeMeasurements, matrix: Array, motion: gtsam.GaussianFactor
    ) -> tuple[Array, Array]:
        """Return derivatives of measurements by what was known at the node before.

        The node after is that node carried by the IMU, of which the noise adds a variance (R,).

        Parameters
        ----------
        measured : NodeMeasurements
            Measurements of R components in all.
        matrix : ndarray, shape (R, c + n)
            Derivatives by the variables of both nodes and by n parameters.
        motion : gtsam.GaussianFactor
            Factor of the IMU, linear: states, bias, errors.
        """
        step = motion.augmentedJacobian()[:, :-1]
        before, after, bias, by_errors = np.split(
            step, np.cumsum([STATE_SIZE, STATE_SIZE, BIAS_SIZE]), axis=1
        )
        of_after = matrix[:, self._of_node_after]
        by_noise = of_after[:, :STATE_SIZE] @ np.linalg.inv(after)
        out = np.delete(matrix, self._of_node_after, axis=1)
        out[:, :STATE_SIZE] -= by_noise @ before
        out[:, STATE_SIZE : STATE_SIZE + BIAS_SIZE] -= by_noise @ bias
        if self.start.walking:
            out[:, STATE_SIZE : STATE_SIZE + BIAS_SIZE] += of_after[:, STATE_SIZE:]
        place = STATE_SIZE + BIAS_SIZE
        for p in measured.parameters:
            size = p.mean.size
            if p.name in ERRORS:
                own, by_errors = by_errors[:, :size], by_errors[:, size:]
                out[:, place : place + size] -= by_noise @ own
            place += size
        return out, np.sum(by_noise**2, axis=1)

    def _correlated_errors(
        self, k: int, measured: NodeMeasurements
    ) -> tuple[dict[int, Array], Array]:
        """Return the derivatives of residuals after state k by its errors, and their estimate."""
        s, errors = self.smoother, self.start.errors
        duration = float(self._segments[k].chain.segments.duration[0])
        by_before, by_after = errors.gains(measured, duration)
        before = s.errors(k)
        after = errors.after(duration) * before if k == s.node else s.errors(k + 1)
        gains = {keys.correlated(k): by_before, keys.correlated(k + 1): by_after}
        return gains, by_before @ before + by_after @ after

    def _local_coordinates(self, origin: _LinearizationPoint) -> Array:
        """Return newest state, bias and parameters in the tangent space at a point."""
        s = self.smoother
        parts = [
            origin.state.localCoordinates(s.state(s.node)),
            s.bias(s.node).vector() - origin.bias.vector(),
        ]
        parts += [
            local_coordinates(p, self.values[p.name], origin.parameters[p.name])
            for p in self.start.parameters
        ]
        return np.concatenate(parts)
