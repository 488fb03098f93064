"""From segment to segment: predict, compare, update."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

import gtsam
import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.inertial_chain import loose_diagonal
from factorgraph_dvl.graph.priors import ConstantsPrior, local_coordinates, prior_root
from factorgraph_dvl.graph.sensor_factor import (
    Linearized,
    NodeMeasurements,
    Rows,
    measurement_factor,
    state_of,
)
from factorgraph_dvl.imu.preintegration import Segments, preintegrate
from factorgraph_dvl.imu.propagation import States, attach
from factorgraph_dvl.replay.estimate import (
    CalibrationEstimate,
    Innovations,
    calibration_of,
    concatenated,
    trajectory_of,
)
from factorgraph_dvl.replay.gate import Gate
from factorgraph_dvl.replay.smoother import Smoother
from factorgraph_dvl.replay.start import ReplayStart
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Motion
from factorgraph_dvl.solution import Trajectory
from factorgraph_dvl.solvers.trajectory import TRAJECTORY_RATE, epochs_between, trajectory_between
from factorgraph_dvl.statistics.spurious_information import spurious_by, undetermined_directions

# Distance, m, up to which gravity is taken as linear: to 3e-9 m/s².
_NEAR = 100.0
# Keeps the walk of a bias that does not walk regular.
_LEAST_WALK = 1e-12
# Time after which it is worked out anew what the motion's error feigns, s.
_SPURIOUS_EVERY = 1.0
_STATE = 9


class Navigator:
    """The smoother between two starts.

    Parameters
    ----------
    start : ReplayStart
        What it starts from.
    imu : Imu
        For its settings.
    gate : Gate
        What decides which measurements are used.
    lag : float or None
        S, of the smoother; None = none.
    memory : float
        S, for which segments are kept for measurements that arrive late.
    """

    def __init__(
        self, start: ReplayStart, imu: Imu, gate: Gate, *, lag: float | None, memory: float
    ) -> None:
        self.start = start
        self._imu = imu
        self._gate = gate
        self._memory = memory
        self.smoother = Smoother(
            start.prior,
            start.values,
            node=start.node,
            time=start.time,
            parameters=start.parameters,
            walking=start.walking,
            lag=lag,
            ranges=start.ranges,
        )
        self._prior_root = prior_root(start.parameters)
        self._spurious = start.spurious
        # By kind: when it was last worked out, and how many were used since.
        self._spurious_at: dict[str, float] = {}
        self._not_counted: dict[str, int] = {}
        self._near = np.full(3, np.inf)
        self._segments: dict[int, tuple[Segments, Array]] = {}
        self.innovations: list[Innovations] = []
        self.messages: list[str] = []
        self._refresh()
        first = keys.node(start.node)
        self._begun = {
            p.name: start.values.atRot3(key).matrix() if p.rotation else start.values.atVector(key)
            for p, key in zip(start.parameters, self.smoother.calibration_keys, strict=True)
        } | start.fixed
        self._held = self._not_observable()
        # Of the newest state; without a lag GTSAM moves it on its own account.
        self._linear: tuple[gtsam.NavState, gtsam.imuBias.ConstantBias] | None = None
        if lag is not None:
            bias = start.values.atConstantBias(self.smoother.bias_key(start.node))
            self._linear = (start.values.atNavState(first), bias)

    @property
    def time(self) -> float:
        """Time of the newest state, s."""
        return self.smoother.times[self.smoother.node]

    @property
    def oldest(self) -> float:
        """Time from which on measurements are still of use, s."""
        return self.smoother.times[next(iter(self._segments), self.smoother.node)]

    @property
    def values(self) -> dict[str, Array]:
        """Values of all parameters, rotations as matrices."""
        return self._values

    @property
    def turned(self) -> float:
        """Angle by which a rotation among the parameters differs from the start's, rad."""
        return max(
            (
                float(
                    np.linalg.norm(local_coordinates(p, self._values[p.name], self._begun[p.name]))
                )
                for p in self.start.parameters
                if p.rotation
            ),
            default=0.0,
        )

    @property
    def held(self) -> Array:
        """Directions of the parameters that are not observable, as `feigned_directions`."""
        return self._held

    @property
    def spurious(self) -> Array:
        """Information that only noise makes, (P, P), as `Start.spurious`."""
        return self._spurious

    @property
    def parameter_covariance(self) -> Array:
        """Joint covariance of accelerometer bias, gyro bias and parameters, SI."""
        return self._P[_STATE:, _STATE:]

    def covariance_of(self, parameter: Parameter) -> Array:
        """Return the covariance of a parameter in its tangent space, SI."""
        before = self.start.parameters[: self.start.parameters.index(parameter)]
        a = _STATE + 6 + sum(p.mean.size for p in before)
        b = a + parameter.mean.size
        return self._P[a:b, a:b]

    def extend(self, seg: Segments, aids: Sequence[Aid]) -> None:
        """Add the segment after the newest state, and what was measured in it."""
        s = self.smoother
        k = s.node
        state, bias = s.state(k), s.bias(k)
        states = state_of(state, bias)
        earth = self.start.frame.earth_rate
        duration = float(seg.duration[0])
        gravity = self._gravity(states.p_n + 0.5 * duration * states.v_n)

        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pim = preintegrate(seg, self._imu.settings, gravity, earth)[0]
        factors.add(gtsam.GalileanImuFactor2(keys.node(k), keys.node(k + 1), s.bias_key(k), pim))
        predicted = pim.predict(state, bias)
        values.insert(keys.node(k + 1), predicted)
        if self.start.walking:
            factors.add(self._walk(k, duration))
            values.insert(keys.bias(k + 1), bias)
        self._segments[k] = (seg, gravity)
        measured = self._measured(k, aids, states)
        if measured is not None:
            factors.add(measured)
        s.extend(float(seg.node_time[1]), factors, values)
        if self._linear is not None:
            self._linear = (predicted, bias if self.start.walking else self._linear[1])
        self._before = self._P[:_STATE, :_STATE]
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
            measured = self._measured(
                k, records, state_of(self.smoother.state(k), self.smoother.bias(k))
            )
            if measured is not None:
                factors.add(measured)
        if factors.size():
            self.smoother.correct(factors, min(aids))
            self._refresh()

    def known(self, later: float) -> ConstantsPrior:
        """Return what is known of biases and parameters, `later` seconds from now."""
        P = self.parameter_covariance.copy()
        s = self._imu.settings
        walk = np.repeat([s.accel_bias_walk_root_psd, s.gyro_bias_walk_root_psd], 3)
        P[:6, :6] += np.diag(walk**2) * later
        return ConstantsPrior(
            self.smoother.bias(self.smoother.node).vector(), self.smoother.calibration(), P
        )

    def node_before(self, time: float) -> int | None:
        """Return the state whose segment holds a time, None if it is gone or yet to come."""
        for k in reversed(self._segments):
            if self.smoother.times[k] <= time:
                return k if time < self.smoother.times[k + 1] else None
        return None

    def calibration(self) -> CalibrationEstimate:
        """Return the calibration as it is reported."""
        bias = self.smoother.bias(self.smoother.node).vector()
        gyro, accel = self._imu.parameters(0.0)
        return calibration_of(
            self.start.all_parameters,
            self._values,
            ((gyro, bias[3:]), (accel, bias[:3])),
            self.parameter_covariance,
            self._held,
        )

    def filtered(self, body_axes: BodyAxes) -> Trajectory:
        """Return the newest state."""
        return self._trajectory([self.smoother.node], self._P[None, :_STATE, :_STATE], body_axes)

    def smoothed(self, first: int, last: int, body_axes: BodyAxes) -> Trajectory:
        """Return the motion from state `first` to state `last`, given all that came since."""
        wanted = [k for k in self._segments if first <= k < last]
        P = self.smoother.state_covariances([*wanted, last])
        parts = [self._between(k, np.stack([P[k], P[k + 1]]), body_axes) for k in wanted]
        return concatenated(parts)

    def passed(self, body_axes: BodyAxes) -> Trajectory:
        """Return the motion from the state before the newest to the newest."""
        P = np.stack([self._before, self._P[:_STATE, :_STATE]])
        return self._between(self.smoother.node - 1, P, body_axes)

    def _between(self, k: int, P: Array, body_axes: BodyAxes) -> Trajectory:
        """Return the motion from state k to the next at the epochs of a batch solution."""
        s = self.smoother
        seg, gravity = self._segments[k]
        time = epochs_between(s.times[k], s.times[k + 1], TRAJECTORY_RATE)
        pair = [state_of(s.state(i), s.bias(i)) for i in (k, k + 1)]
        states = States(
            *(np.concatenate([getattr(x, f.name) for x in pair]) for f in fields(States))
        )
        return trajectory_between(seg, states, P, gravity, self.start.frame, body_axes, time)

    def _trajectory(self, nodes: Sequence[int], P: Array, body_axes: BodyAxes) -> Trajectory:
        found = [self.smoother.state(k) for k in nodes]
        zero = np.zeros((len(nodes), 3))
        states = States(
            np.stack([x.attitude().matrix() for x in found]),
            np.stack([x.position() for x in found]),
            np.stack([x.velocity() for x in found]),
            zero,
            zero,
        )
        time = np.array([self.smoother.times[k] for k in nodes])
        return trajectory_of(time, states, P, self.start.frame, body_axes)

    def _gravity(self, p_n: Array) -> Array:
        """Return gravity at a position (1, 3), linear about one that is near."""
        if np.linalg.norm(p_n - self._near) > _NEAR:
            self._near = p_n[0]
            at = p_n + _NEAR * np.vstack([np.zeros(3), np.eye(3)])
            found = self.start.frame.gravity_without_rotation(at)
            self._near_gravity, self._gradient = found[0], (found[1:] - found[0]) / _NEAR
        return self._near_gravity + (p_n - self._near) @ self._gradient

    def _refresh(self) -> None:
        self._P = self.smoother.joint_covariance()
        self._values = {**self.start.fixed, **self.smoother.calibration()}

    def _walk(self, k: int, duration: float) -> gtsam.BetweenFactorConstantBias:
        s = self._imu.settings
        root_psd = np.repeat([s.accel_bias_walk_root_psd, s.gyro_bias_walk_root_psd], 3)
        walk = np.maximum(root_psd * np.sqrt(duration), _LEAST_WALK)
        return gtsam.BetweenFactorConstantBias(
            keys.bias(k), keys.bias(k + 1), gtsam.imuBias.ConstantBias(), loose_diagonal(walk)
        )

    def _measured(self, k: int, aids: Sequence[Aid], states: States) -> gtsam.CustomFactor | None:
        """Return the factor of measurements after state k that pass the gate."""
        observations = [o for aid in aids for o in aid.observations(self.start.frame)]
        if not observations:
            return None
        seg, gravity = self._segments[k]
        rows: list[Rows] = []
        times: list[Array] = []
        count = 0
        for o in observations:
            time = o.true_time(self._values)
            if rows and np.array_equal(time, rows[-1].time):
                rows.append(Rows(o, rows[-1].at, time))
                continue
            rows.append(Rows(o, slice(count, count + time.size), time))
            times.append(time)
            count += time.size
        used = {name for o in observations for name in o.parameters}
        parameters = tuple(p for p in self.start.parameters if p.name in used)
        measured = NodeMeasurements(
            attachment=attach(seg, np.concatenate(times), self.start.frame.earth_rate),
            rows=tuple(rows),
            parameters=parameters,
            fixed=self.start.fixed,
            gravity_n=gravity,
            earth_rate_n=self.start.frame.earth_rate,
        )
        first = None
        if self._linear is not None and k == self.smoother.node:
            # Where GTSAM will linearise: so it is done once.
            states = state_of(*self._linear)
            residual, matrix, motions = measured.linearize(states, self._begun)
            first = Linearized(states, self._begun, residual, matrix)
            residual = residual + matrix @ self._away()[self._columns(parameters)]
        else:
            residual, matrix, motions = measured.linearize(states, self._values)
        sigma = measured.sigma(motions, self._values)
        weight = self._weigh(measured, residual, matrix, sigma)
        self._feign(measured, motions, weight)
        if not weight.any():
            return None
        s = self.smoother
        index = [self.start.parameters.index(p) for p in parameters]
        return measurement_factor(
            measured,
            weight,
            keys.node(k),
            s.bias_key(k),
            [s.calibration_keys[i] for i in index],
            first,
        )

    def _away(self) -> Array:
        """Return newest state, bias and parameters minus where they are linearised."""
        assert self._linear is not None
        state, bias = self._linear
        s = self.smoother
        k = s.node
        parts = [
            state.localCoordinates(s.state(k)),
            s.bias(k).vector() - bias.vector(),
        ]
        for p in self.start.parameters:
            parts.append(local_coordinates(p, self._values[p.name], self._begun[p.name]))
        return np.concatenate(parts)

    def _columns(self, parameters: Sequence[Parameter]) -> list[int]:
        """Return the place of state, bias and some parameters among all."""
        columns = list(range(_STATE + 6))
        at = _STATE + 6
        for p in self.start.parameters:
            if p in parameters:
                columns += range(at, at + p.mean.size)
            at += p.mean.size
        return columns

    def _weigh(
        self, measured: NodeMeasurements, residual: Array, matrix: Array, sigma: Array
    ) -> Array:
        """Return inverse standard deviations, 0 for what the gate does not let pass."""
        columns = self._columns(measured.parameters)
        P = self._P[np.ix_(columns, columns)]
        total = np.sqrt(np.sum((matrix @ P) * matrix, axis=1) + sigma**2)
        weight = np.empty_like(sigma)
        row = 0
        for r in measured.rows:
            m, d = r.time.size, len(r.observation.components)
            part = slice(row, row + m * d)
            row += m * d
            there = np.isfinite(sigma[part])
            found = np.where(there, residual[part], np.nan).reshape(m, d)
            spread = np.where(there, total[part], np.nan).reshape(m, d)
            used, message = self._gate.passes(
                r.observation.label, found / spread, r.observation.gate
            )
            if message:
                self.messages.append(message)
            weight[part] = (used[:, None] / sigma[part].reshape(m, d)).ravel()
            o = r.observation
            self.innovations.append(
                Innovations(o.label, o.unit, o.components, o.time, found, spread, used)
            )
        return weight

    def _feign(self, measured: NodeMeasurements, motions: Sequence[Motion], weight: Array) -> None:
        """Add the information that the motion's error feigns.

        It is worked out for some measurements of each kind, once a second, and counts for
        all that were used since: kinds come at rates of their own, and late. The error is
        the whole one, not what is left where the parameters are known: each state is
        linearised at what was known then, so an error that all states share changes too.
        """
        start = {}
        at = 0
        for p in self.start.parameters:
            start[p.name] = at
            at += p.mean.size
        values = {**self.start.fixed, **self._values}
        row = 0
        for r, motion in zip(measured.rows, motions, strict=True):
            m, d = r.time.size, len(r.observation.components)
            own = weight[row : row + m * d].reshape(m, d)
            row += m * d
            wanted = [p for p in measured.parameters if p.name in r.observation.parameters]
            used = int(np.count_nonzero(own.any(axis=1)))
            if not wanted or not used:
                continue
            label = r.observation.label
            count = self._not_counted.get(label, 0) + used
            self._not_counted[label] = count
            if self.time - self._spurious_at.get(label, self.start.time) < _SPURIOUS_EVERY:
                continue
            columns = np.concatenate([start[p.name] + np.arange(p.mean.size) for p in wanted])
            part = spurious_by(
                r.observation,
                measured.attachment_of(r),
                motion,
                own,
                np.broadcast_to(self._P[:_STATE, :_STATE], (m, _STATE, _STATE)),
                values,
                [p.name for p in wanted],
            )
            root = self._prior_root[columns]
            self._spurious = self._spurious + root.T @ part.sum(axis=0) @ root * (count / used)
            self._spurious_at[label], self._not_counted[label] = self.time, 0
            self._held = self._not_observable()

    def _not_observable(self) -> Array:
        size = len(self._prior_root)
        if size == 0:
            return np.zeros((0, 0))
        root = self._prior_root
        information = root.T @ np.linalg.inv(self._P[_STATE + 6 :, _STATE + 6 :]) @ root
        return undetermined_directions(information - np.eye(size), self._spurious)
