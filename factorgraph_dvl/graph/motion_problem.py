"""A trial without IMU as a least-squares problem: a motion prior, and sensors in bulk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.graph.bordered_chain import (
    Covariances,
    Factorisation,
    NormalEquations,
)
from factorgraph_dvl.graph.clocks import linearized, true_time
from factorgraph_dvl.graph.motion_chain import Interpolation, MotionChain
from factorgraph_dvl.graph.priors import local_coordinates, places, prior_mean, prior_root
from factorgraph_dvl.imu.attitude_record import AttitudeRecord, BodyAttitude, level_axes
from factorgraph_dvl.sensors.attitude import heading_error
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Observation

# Names of the processes that are no error of a measurement.
ATTITUDE = "attitude"
CURRENT = "current"
_SCALE = "scale_error"
_LEVER_ARM = "lever_arm_m"
# Products e_i × with the unit vectors, (3, 3, 3).
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1)
# Largest share of the information on a lever arm that noise of rates may be. Measured: with five
# times the noise of a good compass the share is a tenth, and all of it four times too much.
_MOST_NOISE = 0.02
# Factor on the density of acceleration that makes a prior weak. Chosen: of its effect on constants
# a percent is left, and the states stay determined in gaps.
_WEAKER = 100.0
# Share of the current on which the motion over ground does not depend, and its standard deviation.
# Chosen: all of it if a vessel keeps its track, none if it drifts, any in between as likely.
_TRACK, TRACK_STD = 0.5, 12.0**-0.5
# Least inverse standard deviation of the states of the first node, 1/m and s/m, where early nodes
# are eliminated before a position is known. Chosen: digits stay, and fixes of 10 m lose 1 %.
_FIRST_NODE = 1e-2
# Least share of a residual's variance that its fit leaves. Chosen: below it rounding decides.
_LEAST_LEFT = 0.02


@dataclass(frozen=True)
class Seen:
    """An observation at one set of states.

    Parameters
    ----------
    motion : Motion
        At the true times.
    time : ndarray, shape (M,), s
        By the clock of the nodes.
    interpolation : Interpolation
        Of the states.
    body : BodyAttitude
        Attitude, as it was measured and without its errors.
    residual : ndarray, shape (M, d)
        Predicted minus measured.
    by_state, by_parameters : ndarray, shape (M, d, n) or (M, d, c)
        Derivatives.
    by_rph : ndarray, shape (M, d, 3)
        Derivatives by an error of roll, pitch, heading.
    covered : ndarray of bool, shape (M,)
        Whether motion and attitude are known.
    """

    motion: Motion
    time: Array
    interpolation: Interpolation
    body: BodyAttitude
    residual: Array
    by_state: Array
    by_parameters: Array
    by_rph: Array
    covered: np.ndarray


@dataclass(frozen=True)
class MotionEvaluation:
    """States, parameters, and what is observed there.

    Parameters
    ----------
    states : ndarray, shape (K, n)
        Of the nodes.
    parameters : dict of str to ndarray
        Values by name, rotations as matrices.
    seen : tuple of Seen
        By observation.
    whitening : tuple of ndarray
        By observation, inverse square roots (M, d, d) of covariances, 0 where not used.
    """

    states: Array
    parameters: dict[str, Array]
    seen: tuple[Seen, ...]
    whitening: tuple[Array, ...]


@dataclass(frozen=True)
class WhitenedRows:
    """Rows of unit noise: of an observation, or of the prior of the motion.

    Parameters
    ----------
    source : str
        Where the noise comes from.
    node : ndarray of int, shape (M,)
        Node before.
    before, after, constants : ndarray, shape (M, d, n) or (M, d, c)
        Derivatives.
    residual : ndarray, shape (M, d)
        Residuals.
    """

    source: str
    node: np.ndarray
    before: Array
    after: Array
    constants: Array
    residual: Array

    def leverage(self, covariances: Covariances) -> Array:
        """Return the variance of the rows' predictions, (M, d)."""
        return covariances.variance(self.node, self.before, self.after, self.constants)


class MotionProblem:
    """Motion prior, attitude record and measurements: what is minimised without an IMU.

    The nodes have their times by the clock of one sensor, and move with it, so that its
    measurements stay where they are between nodes. Those of others move, and with them the
    variance V of the motion between nodes: it is part of the covariance R of a residual r, and
    the derivative -½ rᵀ R⁻¹ (dR/dt) R⁻¹ r of the cost goes with it. With weights of the clock
    before, a clock was held back 13 times as strongly as the data pulled it (a river boat with
    pings every 1.3 s).

    Parameters
    ----------
    chain : MotionChain
        Prior of the motion, by the clock of the nodes.
    frame : LocalFrame
        Tangent frame n.
    attitude : AttitudeRecord
        How the body points.
    observations : sequence of Observation
        Measurements.
    parameters : sequence of Parameter
        Calibration parameters, fixed ones included.
    start : ndarray, shape (K, n)
        States near which the solution is; the prior of the first is loose about it.
    clock : str
        Name of the time offset of the nodes' clock.

    Attributes
    ----------
    noise_factors : mapping of str to ndarray
        By label, factors (d,) on stated standard deviations.
    rejected : mapping of str to ndarray
        By label, whether measurements (M,) are left out.
    slope : ndarray, shape (c,)
        Derivatives by the constants that are added to those of the cost, as `follow_motion` found
        them.
    total_sigma : list of ndarray
        Standard deviations (M, d) of the residuals by observation, infinite where not used: noise
        of the sensor and the attitude, and the motion between states.
    """

    def __init__(
        self,
        chain: MotionChain,
        frame: LocalFrame,
        attitude: AttitudeRecord,
        observations: Sequence[Observation],
        parameters: Sequence[Parameter],
        start: Array,
        clock: str,
    ) -> None:
        self.chain, self.frame, self.attitude = chain, frame, attitude
        self.observations = tuple(observations)
        self.all_parameters = tuple(parameters)
        self.parameters = tuple(p for p in parameters if p.estimated)
        self.clock = clock
        self.zero = 0.5 * float(chain.time[0] + chain.time[-1])
        self.noise_factors: Mapping[str, Array] = {}
        self.rejected: Mapping[str, np.ndarray] = {}
        self.slope = np.zeros(self.constants)
        self._slope_at = self.prior_values()
        self._start = start
        self._nRl = level_axes(frame, start[:, :3])
        self.total_sigma: list[Array] = []
        # By observation: noise but for the motion (M, d, d), derivatives by states, what is used.
        self._weights: list[tuple[Array, Array, Array]] = []
        self._bound: dict[str, Array] = {}
        self._last: tuple[MotionEvaluation, NormalEquations] | None = None
        self._last_rows: tuple[MotionEvaluation, tuple[WhitenedRows, ...]] | None = None
        # A parameter that no measurement names belongs to the attitude.
        self._of_attitude = {p.name for p in attitude.sensor.parameters()}

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Place of every estimated parameter among all of them."""
        return places(self.parameters)

    @cached_property
    def constants(self) -> int:
        """Number of estimated components."""
        return sum(p.mean.size for p in self.parameters)

    @cached_property
    def prior_root(self) -> Array:
        """Square root S of the prior covariance S Sᵀ of the parameters, SI."""
        return prior_root(self.parameters)

    def prior_values(self) -> dict[str, Array]:
        """Return the prior means of all parameters, rotations as matrices."""
        return {p.name: prior_mean(p) for p in self.all_parameters}

    def evaluate(self, states: Array, parameters: dict[str, Array]) -> MotionEvaluation:
        """Evaluate motion, residuals and derivatives."""
        seen = tuple(self._see(o, states, parameters) for o in self.observations)
        return MotionEvaluation(states, parameters, seen, self._whitening(seen))

    def weighed(self, states: Array, parameters: dict[str, Array]) -> MotionEvaluation:
        """Set the weights of all measurements from their covariances there, and evaluate."""
        self._bound = {}
        seen = tuple(self._see(o, states, parameters) for o in self.observations)
        return MotionEvaluation(states, parameters, seen, self._weigh(seen, parameters))

    def _whitening(self, seen: Sequence[Seen]) -> tuple[Array, ...]:
        return tuple(
            _inverse_root(own + s.interpolation.variance(J) * used) * used
            for s, (own, J, used) in zip(seen, self._weights, strict=False)
        )

    def body_at(
        self,
        time: Array,
        states: Array,
        parameters: Mapping[str, Array],
        bound: Array | None = None,
    ) -> tuple[Interpolation, Array, BodyAttitude, dict[str, Array]]:
        """Return states and attitude at true times (M,), and the heading's error by parameters.

        What lasts is that at `bound` (M,), by the clock of the nodes, where this lies between the
        same nodes.
        """
        by_nodes = time + self.offset(parameters)
        at = self.chain.at(by_nodes, bound)
        x = at.states(states)
        stamp = time + self._attitude_lag(time, parameters)
        error = np.zeros((time.size, 3))
        if self.chain.has(ATTITUDE):
            place = self.chain.place(ATTITUDE)
            error += x[:, place] * self._sigma(ATTITUDE)
        near = np.clip(np.searchsorted(self.chain.time, by_nodes), 0, self.chain.time.size - 1)
        nRl = self._nRl[near]
        own = {n: v for n, v in parameters.items() if n in self._of_attitude}
        heading = self.attitude.rph_at(stamp)[:, 2]
        lasting, by = heading_error(time, heading, own, self.zero)
        error[:, 2] += lasting
        return at, x, self.attitude.at(stamp, error, nRl), by

    def offset(self, parameters: Mapping[str, Array]) -> float:
        """Return the times of the nodes less true times, s."""
        return float(parameters[self.clock][0])

    def _weigh(
        self, all_seen: Sequence[Seen], parameters: Mapping[str, Array]
    ) -> tuple[Array, ...]:
        """Set the weights of all measurements from their covariances, and return the whitening."""
        self._weights, self.total_sigma = [], []
        whitening = []
        for o, seen in zip(self.observations, all_seen, strict=True):
            # A clock that moves must not follow errors that are as rough as a random walk.
            self._bound[o.label] = seen.time
            sigma = self.sigma(o, seen, parameters)
            used = np.isfinite(sigma) & self.usable(o, seen)[:, None]
            R = np.einsum("mi,ij->mij", np.where(used, sigma, 1.0) ** 2, np.eye(sigma.shape[1]))
            spread = seen.by_rph * self.attitude.white
            pairs = used[:, :, None] * used[:, None, :]
            R += spread @ spread.transpose(0, 2, 1) * pairs
            between = seen.interpolation.variance(seen.by_state)
            variance = np.diagonal(R + between, axis1=1, axis2=2)
            self.total_sigma.append(np.where(used, np.sqrt(variance), np.inf))
            self._weights.append((R, seen.by_state, pairs))
            whitening.append(_inverse_root(R + between * pairs) * pairs)
        return tuple(whitening)

    def usable(self, observation: Observation, seen: Seen) -> np.ndarray:
        """Whether measurements (M,) are covered and not rejected."""
        left_out = self.rejected.get(observation.label)
        return seen.covered if left_out is None else np.asarray(seen.covered & ~left_out)

    def sigma(
        self, observation: Observation, seen: Seen, parameters: Mapping[str, Array]
    ) -> Array:
        """Return the standard deviations (M, d) of the sensor itself, infinite if not measured."""
        factor = self.noise_factors.get(observation.label, 1.0)
        return observation.sigma(seen.motion, parameters, factor)

    def rows(self, evaluation: MotionEvaluation) -> tuple[WhitenedRows, ...]:
        """Return the whitened rows of each observation, unused ones as zeros, not to be changed.

        Those of the last evaluation are kept.
        """
        if self._last_rows is not None and self._last_rows[0] is evaluation:
            return self._last_rows[1]
        out = tuple(
            _rows(o, seen, W @ seen.by_state, W @ seen.by_parameters, rotate(W, seen.residual))
            for o, seen, W in zip(
                self.observations, evaluation.seen, evaluation.whitening, strict=True
            )
        )
        self._last_rows = (evaluation, out)
        return out

    def residuals(self, evaluation: MotionEvaluation, covariances: Covariances) -> Iterator[Array]:
        """Yield residuals (M, d) in their standard deviations, rejected ones too, nan if missing.

        The variance of a residual is that of the measurement less that of its prediction; of one
        that was left out, their sum.
        """
        for o, seen in zip(self.observations, evaluation.seen, strict=True):
            sigma = self.sigma(o, seen, evaluation.parameters)
            known = np.isfinite(sigma) & seen.covered[:, None]
            R = np.square(np.where(known, sigma, 1.0))
            spread = seen.by_rph * self.attitude.white
            J = seen.by_state
            R += np.sum(spread**2, axis=2)
            R += np.diagonal(seen.interpolation.variance(J), axis1=1, axis2=2)
            W = (known / np.sqrt(R))[:, :, None]
            leverage = _rows(o, seen, W * J, W * seen.by_parameters, seen.residual).leverage(
                covariances
            )
            used = self.usable(o, seen)[:, None]
            left = np.where(used, np.maximum(1.0 - leverage, _LEAST_LEFT), 1.0 + leverage)
            yield np.where(known, seen.residual / np.sqrt(R * left), np.nan)

    def motion_rows(self, states: Array) -> WhitenedRows:
        """Return the whitened rows of the motion prior, a process of n rows for each step."""
        before, after = self.chain.transitions()
        residual = rotate(before, states[:-1]) + rotate(after, states[1:])
        none = np.zeros((*residual.shape, self.constants))
        return WhitenedRows("motion", np.arange(len(before)), before, after, none, residual)

    def cost(self, evaluation: MotionEvaluation) -> float:
        """Return half the sum of all squared whitened residuals."""
        whitened = [
            rotate(W, seen.residual)
            for W, seen in zip(evaluation.whitening, evaluation.seen, strict=True)
        ]
        whitened.append(self.motion_rows(evaluation.states).residual)
        whitened.append(self.chain.first() * (evaluation.states[0] - self._first()))
        whitened.append(self._prior_residual(evaluation.parameters))
        linear = self.slope @ self.coordinates(self._slope_at, evaluation.parameters)
        return 0.5 * sum(float(np.vdot(r, r)) for r in whitened) + float(linear)

    def follow_motion(
        self, evaluation: MotionEvaluation, factors: Factorisation, covariances: Covariances
    ) -> Array:
        """Set the slope that takes the prior of the motion and noise of rates out of constants.

        At the least cost the prior holds the velocity back, and a scale error makes up for it: in
        a tidal race one of 0.29 came from it. Its gradient is therefore that of residuals about
        the states that a much weaker prior allows, with the derivatives at these states: the
        residuals then contain noise alone, whatever the motion is like. Of a single velocity that
        GNSS and log measure this is the least-squares fit of one to the other, with the smoothed
        velocity as the instrument. Lever arms and mountings gain nothing from it but noise.

        A vessel that keeps its track moves independently of the current, one that drifts moves
        with it. In between, a share of the current's information on the scale error counts.

        Rates of a record have noise n, and a lever arm l that is too short makes less of n × l.
        The gradient by l has the expectation of this, and the slope is its opposite (corrected
        score: Nakamura, Biometrika 77 (1990)). No more than a share of the information on l is
        taken: motion follows part of strong noise, and rounds would take steps that grow.

        Returns
        -------
        ndarray, shape (c,)
            Change of the slope from a vessel that drifts to one that keeps its track.
        """
        weak = self.with_chain(replace(self.chain, density=_WEAKER * self.chain.density))
        data = self._without_motion(evaluation)
        equations = data.copy()
        weak._add_motion(equations, evaluation.states)
        try:
            freed = equations.factorise().node_step() - factors.node_step()
        except np.linalg.LinAlgError:
            # No digits are left for a weaker prior, because it alone determines some states.
            freed = np.zeros_like(evaluation.states)
        slope = np.zeros(self.constants)
        for name, column in self.columns.items():
            if name.endswith(_SCALE):
                slope[column] = np.einsum("kic,ki->c", data.border[:, :, column], freed)
        by_track = np.zeros(self.constants)
        if self.chain.has(CURRENT) and _SCALE in self.columns:
            given, place = covariances.given_constants(), self.chain.place(CURRENT)
            gain = 1.0 + evaluation.parameters[_SCALE]
            for o, rows in zip(self.observations, self.rows(evaluation), strict=True):
                if _SCALE not in o.parameters:
                    continue
                through = given.with_states(rows.node, rows.before, rows.after, place)
                by_row = np.zeros(rows.residual.shape[1])
                for J, each in zip((rows.before, rows.after), through, strict=True):
                    by_row += np.sum(J[:, :, place] * each, axis=(0, 2))
                by_scale = by_row.sum() if gain.size == 1 else by_row
                by_track[self.columns[_SCALE]] += by_scale / gain
        for name, column in self.columns.items():
            if name.endswith(_LEVER_ARM):
                by_noise = self._by_noise_of_rates(name, evaluation, covariances)
                share = np.linalg.eigvals(by_noise @ covariances.constants[column, column])
                by_noise *= min(_MOST_NOISE / max(np.abs(share).max(), 1e-300), 1.0)
                slope[column] -= by_noise @ evaluation.parameters[name]
        self.slope = slope + _TRACK * by_track
        self._slope_at = dict(evaluation.parameters)
        return by_track

    def _by_noise_of_rates(
        self, name: str, evaluation: MotionEvaluation, covariances: Covariances
    ) -> Array:
        """Return the information on a lever arm that noise of the rates pretends, (3, 3)."""
        out = np.zeros((3, 3))
        for o, seen, W, rows in zip(
            self.observations,
            evaluation.seen,
            evaluation.whitening,
            self.rows(evaluation),
            strict=True,
        ):
            if name not in o.parameters:
                continue
            time = seen.time - self.offset(evaluation.parameters)
            stamp = time + self._attitude_lag(time, evaluation.parameters)
            variance = self.attitude.rate_noise(stamp, seen.body.theta_by_rph)
            if not variance.any():
                continue
            # Derivatives by the velocity in the body, as those by the velocity in n. Residuals
            # lack the noise that the states follow.
            J = W @ seen.by_state[:, :, 3:6] @ seen.motion.nRb
            left = np.maximum(1.0 - rows.leverage(covariances), 0.0)
            weight = J.transpose(0, 2, 1) @ (left[:, :, None] * J)
            # By noise along each axis, whose product with the lever arm is e_i × l.
            out += np.einsum("mi,mjk,ijp,ikq->pq", variance, weight, _CROSS, _CROSS, optimize=True)
        return out

    def equations(self, evaluation: MotionEvaluation) -> NormalEquations:
        """Return the normal equations at an evaluation."""
        out = self._without_motion(evaluation).copy()
        out.constant_gradient += self.slope
        self._add_motion(out, evaluation.states)
        return out

    def known_before(self, evaluation: MotionEvaluation, node: int) -> NormalEquations:
        """Return the equations of one node and the constants by all that came before the node."""
        early = tuple(
            W * (seen.interpolation.node < node)[:, None, None]
            for W, seen in zip(evaluation.whitening, evaluation.seen, strict=True)
        )
        out = self._without_motion(replace(evaluation, whitening=early)).copy()
        out.constant_gradient += self.slope
        rows = self.motion_rows(evaluation.states)
        rows.before[node:], rows.after[node:], rows.residual[node:] = 0.0, 0.0, 0.0
        out.add_steps(rows.before, rows.after, rows.residual)
        self._add_first(out, evaluation.states)
        return out.without_first(node).first_alone()

    def constants_along(
        self, evaluation: MotionEvaluation, nodes: Sequence[int]
    ) -> Iterator[Array]:
        """Yield covariances (c, c) of the constants by all that came before each of some nodes.

        Parameters
        ----------
        evaluation : MotionEvaluation
            Linearised there.
        nodes : sequence of int
            Increasing, from 1 on.
        """
        measured, motion = list(self.rows(evaluation)), self.motion_rows(evaluation.states)
        known = NormalEquations(1, self.chain.size, self.constants)
        known.diagonal[0] = np.diag(np.maximum(self.chain.first(), _FIRST_NODE) ** 2)
        if self.parameters:
            gain = np.linalg.inv(self.prior_root)
            known.corner = gain.T @ gain
        for a, b in pairwise((0, *nodes)):
            part = NormalEquations(b - a + 1, self.chain.size, self.constants)
            part.diagonal[0], part.border[0] = known.diagonal[0], known.border[0]
            part.corner[:] = known.corner
            for rows in measured:
                own = (rows.node >= a) & (rows.node < b)
                each = (rows.before, rows.after, rows.constants, rows.residual)
                part.add(rows.node[own] - a, *(values[own] for values in each))
            steps = slice(a, b)
            part.add_steps(motion.before[steps], motion.after[steps], motion.residual[steps])
            known = part.without_first(b - a)
            yield known.factorise().constants

    def deviance(self, evaluation: MotionEvaluation, name: str) -> Callable[[Array, float], float]:
        """Return twice the negative logarithm of the restricted likelihood, but for a constant.

        It is a function of standard deviations (p,) and correlation time, s, of a process. States
        and parameters are integrated out, linear at the evaluation, so that only what they leave
        says how strong a process is. Weights of measurements and interpolation are those of the
        present one. The slope is left out: where a process is strong, it would pull constants that
        are then little known so far that no likelihood stood against it.

        Parameters
        ----------
        evaluation : MotionEvaluation
            Near the minimum.
        name : str
            Of the process.
        """
        place, present = self.chain.place(name), self._sigma(name)
        rows = self.motion_rows(evaluation.states)
        for values in (rows.before, rows.after, rows.residual):
            values[:, place] = 0.0
        equations = self._without_motion(evaluation).copy()
        equations.add_steps(rows.before, rows.after, rows.residual)
        self._add_first(equations, evaluation.states)
        own = np.arange(place.start, place.stop)
        x, dt = evaluation.states[:, place], np.diff(self.chain.time)[:, None]
        diagonal, off = equations.diagonal[:, own, own], equations.off[:, own, own]
        # The prior of the first state is replaced too.
        diagonal[0] -= 1.0
        gradient = equations.node_gradient[:, own]
        gradient[0] -= x[0]

        def of(sigma: Array, tau: float) -> float:
            gain = (present / sigma) ** 2
            phi, new = np.exp(-dt / tau), -np.expm1(-2.0 * dt / tau)
            weight, change = gain / new, x[1:] - phi * x[:-1]
            by_change = weight * change
            equations.diagonal[:, own, own] = diagonal
            equations.diagonal[1:, own, own] += weight
            equations.diagonal[:-1, own, own] += phi**2 * weight
            equations.diagonal[0, own, own] += gain
            equations.off[:, own, own] = off - phi * weight
            equations.node_gradient[:, own] = gradient
            equations.node_gradient[1:, own] += by_change
            equations.node_gradient[:-1, own] -= phi * by_change
            equations.node_gradient[0, own] += gain * x[0]
            factors = equations.factorise()
            prior = float(np.sum(by_change * change) + gain @ x[0] ** 2)
            of_prior = float(np.sum(np.log(weight)) + np.sum(np.log(gain)))
            return prior - 2.0 * factors.decrease - of_prior + factors.log_determinant

        return of

    def measured(self, evaluation: MotionEvaluation) -> NormalEquations:
        """Return the normal equations of measurements alone."""
        out = NormalEquations(self.chain.time.size, self.chain.size, self.constants)
        for rows in self.rows(evaluation):
            out.add(rows.node, rows.before, rows.after, rows.constants, rows.residual)
        self._add_variances(out, evaluation)
        return out

    def _without_motion(self, evaluation: MotionEvaluation) -> NormalEquations:
        """Return the normal equations of measurements and parameters alone, not to be changed.

        Those of the last evaluation are kept: the step, the slope and the strength of the current
        take them.
        """
        if self._last is not None and self._last[0] is evaluation:
            return self._last[1]
        out = self.measured(evaluation)
        if self.parameters:
            gain = np.linalg.inv(self.prior_root)
            out.corner += gain.T @ gain
            out.constant_gradient += gain.T @ self._prior_residual(evaluation.parameters)
        self._last = (evaluation, out)
        return out

    def _add_variances(self, equations: NormalEquations, evaluation: MotionEvaluation) -> None:
        """Add the gradient of the cost by clocks through the variance of the motion."""
        for o, seen, W, (_, J, _) in zip(
            self.observations, evaluation.seen, evaluation.whitening, self._weights, strict=True
        ):
            u = rotate(W.transpose(0, 2, 1), rotate(W, seen.residual))
            by_time = -0.5 * np.sum(u * rotate(seen.interpolation.variance_rate(J), u), axis=1)
            later = {self.clock: np.ones(by_time.size)}
            if o.clock is not None:
                offset, rate = o.clock.names
                later[offset] = later.get(offset, np.zeros(by_time.size)) - 1.0
                later[rate] = self.zero - o.time
            for name, change in later.items():
                if name in self.columns:
                    equations.constant_gradient[self.columns[name]] += by_time @ change

    def _add_motion(self, equations: NormalEquations, states: Array) -> float:
        """Add the prior of the motion, and return its sum of squares."""
        rows = self.motion_rows(states)
        equations.add_steps(rows.before, rows.after, rows.residual)
        return float(np.vdot(rows.residual, rows.residual)) + self._add_first(equations, states)

    def _add_first(self, equations: NormalEquations, states: Array) -> float:
        """Add the prior of the first node, and return its sum of squares."""
        first = self.chain.first()
        beyond = first * (states[0] - self._first())
        equations.diagonal[0] += np.diag(first**2)
        equations.node_gradient[0] += first * beyond
        return float(beyond @ beyond)

    def _first(self) -> Array:
        first = self._start[0].copy()
        first[6:] = 0.0
        return first

    def _prior_residual(self, parameters: Mapping[str, Array]) -> Array:
        if not self.parameters:
            return np.zeros(0)
        off = self.coordinates({p.name: prior_mean(p) for p in self.parameters}, parameters)
        return np.asarray(np.linalg.solve(self.prior_root, off))

    def coordinates(self, origin: Mapping[str, Array], parameters: Mapping[str, Array]) -> Array:
        """Return the estimated parameters in coordinates (c,) about others."""
        off = [local_coordinates(p, parameters[p.name], origin[p.name]) for p in self.parameters]
        return np.concatenate([np.zeros(0), *off])

    def _sigma(self, name: str) -> Array:
        return next(p.sigma for p in self.chain.processes if p.name == name)

    def _attitude_lag(self, time: Array, parameters: Mapping[str, Array]) -> Array:
        """Return the stamps of the attitude less true times (M,), s."""
        offset, rate = (parameters[name][0] for name in self.attitude.sensor.clock.names)
        return np.asarray(offset + rate * (time - self.zero))

    def _see(self, o: Observation, states: Array, parameters: dict[str, Array]) -> Seen:
        """Return an observation with its derivatives."""
        time = true_time(o, parameters, self.zero)
        at, x, body, by_heading = self.body_at(time, states, parameters, self._bound.get(o.label))
        stamp = time + self._attitude_lag(time, parameters)
        by_nodes = time + self.offset(parameters)
        covered = self.chain.covers(by_nodes) & self.attitude.covers(stamp)
        v_n = x[:, 3:6]
        flows = self.chain.has(CURRENT) and any(n.startswith("current") for n in o.parameters)
        if flows:
            v_n = v_n.copy()
            v_n[:, :2] -= x[:, self.chain.place(CURRENT)] * self._sigma(CURRENT)
        motion = Motion(
            nRb=body.nRb,
            p_n=x[:, :3],
            v_n=v_n,
            omega_eb_b=body.omega_eb_b,
            a_n=at.accelerations(states),
            alpha_b=body.alpha_b,
            omega_sigma=body.omega_sigma,
        )
        wanted = [p.name for p in self.parameters]
        lin = linearized(o, motion, parameters, wanted, self.zero)
        m, d = lin.residual.shape
        by_rph = np.zeros((m, d, 3))
        if lin.d_theta is not None:
            by_rph = -lin.d_theta @ body.theta_by_rph
        by_state = np.zeros((m, d, self.chain.size))
        if lin.d_p is not None:
            by_state[:, :, :3] = lin.d_p
        if lin.d_v is not None:
            by_state[:, :, 3:6] = lin.d_v
            if flows:
                place = self.chain.place(CURRENT)
                by_state[:, :, place] = -lin.d_v[:, :, :2] * self._sigma(CURRENT)
        if self.chain.has(ATTITUDE):
            by_state[:, :, self.chain.place(ATTITUDE)] = by_rph * self._sigma(ATTITUDE)
        residual = lin.residual
        if self.chain.has(o.label):
            place = self.chain.place(o.label)
            residual = residual + x[:, place] * self._sigma(o.label)
            by_state[:, :, place] = np.diag(self._sigma(o.label))
        by_parameters = np.zeros((m, d, self.constants))
        found = self._by_attitude(lin, body, by_rph, by_heading, time)
        if self.clock in self.columns:
            # The nodes move with this clock, and their motion with them.
            by_time = np.zeros((m, d))
            for by, change in ((lin.d_p, motion.v_n), (lin.d_v, motion.a_n)):
                if by is not None:
                    by_time += rotate(by, change)
            found[self.clock] = by_time[:, :, None]
        for name, place in self.columns.items():
            if name in lin.d_parameters:
                by_parameters[:, :, place] += lin.d_parameters[name]
            if name in found:
                by_parameters[:, :, place] += found[name]
        return Seen(motion, by_nodes, at, body, residual, by_state, by_parameters, by_rph, covered)

    def _by_attitude(
        self,
        lin: Linearization,
        body: BodyAttitude,
        by_rph: Array,
        by_heading: Mapping[str, Array],
        time: Array,
    ) -> dict[str, Array]:
        """Return derivatives of a residual by errors of the heading and the attitude's clock."""
        found = {name: by_rph[:, :, 2:] * by[:, None, :] for name, by in by_heading.items()}
        late = np.zeros(lin.residual.shape)
        if lin.d_theta is not None:
            late += rotate(lin.d_theta, body.omega_eb_b)
        if lin.d_omega is not None:
            late += rotate(lin.d_omega, body.alpha_b)
        offset, rate = self.attitude.sensor.clock.names
        found[offset] = late[:, :, None]
        found[rate] = found[offset] * (time - self.zero)[:, None, None]
        return found

    def with_chain(self, chain: MotionChain) -> MotionProblem:
        """Return the same problem with another prior."""
        out = copy(self)
        out.chain = chain
        out._bound = {}
        return out


def _inverse_root(covariances: Array) -> Array:
    """Return the inverses (M, d, d) of the lower Cholesky factors of covariances."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def _rows(
    observation: Observation, seen: Seen, by_state: Array, by_parameters: Array, residual: Array
) -> WhitenedRows:
    """Return rows by the nodes before and after from rows by the state between them."""
    at = seen.interpolation
    return WhitenedRows(
        observation.label, at.node, *at.by_nodes(by_state), by_parameters, residual
    )


def with_sigma(chain: MotionChain, name: str, sigma: Array, tau: float) -> MotionChain:
    """Return a chain with another standard deviation and correlation time of a process."""
    processes = [
        replace(p, sigma=sigma, tau=tau) if p.name == name else p for p in chain.processes
    ]
    return replace(chain, processes=tuple(processes))
