"""Smoothing by iSAM2, with or without a lag: newest state at the root, the oldest a leaf.

`gtsam.IncrementalFixedLagSmoother` eliminates its whole window anew at every update, because
it leaves the order of the variables in it open. With the newest state and the calibration
last, and states in the order of time before them, an update touches the top of the tree
only, the joint covariance of state and calibration is read off there, and the oldest state
is a leaf that can be marginalised as it is. The estimates are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, takewhile

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph import keys
from factorgraph_dvl.graph.inertial_chain import states_of
from factorgraph_dvl.graph.keys import STATE_SIZE
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.sensors.parameters import Parameter

# Steps after which a state is linearised anew: rad, m, m/s; chosen. Positions enter linearly, but
# for ranges: at 10 m from a beacon the last step changes one by 0.2 m more than it should.
_STATE_STEP = np.repeat([1e-3, 1e2, 0.05], 3)
_POSITION_STEP_BY_RANGES = 2.0
# The same for biases; chosen never to happen: preintegration is linear in them.
_BIAS_STEP = np.full(6, 1e2)
# The same for parameters, SI, where all states are kept. Measured: a step of 0.1 biased the
# pitch misalignment by 7 standard deviations.
_CALIBRATION_STEP = 1e-2
# Stands for no step at all; chosen.
_NEVER = 1e9
# Share of the states from which on all are eliminated anew; chosen below that at which iSAM2 does
# so by itself.
_MOST = 0.4
# Interval at which steps are checked, s; chosen.
_CHECK = 1.0
# What rounding may take off a time, s: it must not decide when steps are checked.
_ROUNDING = 1e-6


class Smoother:
    """Incremental smoother over states, biases and calibration.

    Parameters
    ----------
    prior : gtsam.NonlinearFactorGraph
        Factors on the first state, its bias and the parameters.
    values : gtsam.Values
        Their start values.
    node : int
        Index of the first state.
    time : float
        Its time, s.
    parameters : sequence of Parameter
        Parameters that are estimated, in the order of `keys.calibration`.
    walking : bool
        Whether every state has a bias of its own.
    lag : float or None
        Age at which states are marginalised, s; None = never.
    ranges : bool, default False
        Whether there are ranges, which are not linear in the position.
    errors : int, default 0
        Size of the vector of correlated errors that every state has, `keys.correlated`.
    """

    def __init__(
        self,
        prior: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        *,
        node: int,
        time: float,
        parameters: Sequence[Parameter],
        walking: bool,
        lag: float | None,
        ranges: bool = False,
        errors: int = 0,
    ) -> None:
        self.parameters = tuple(parameters)
        self.calibration_keys = {
            p.name: keys.calibration(i, p.mean.size) for i, p in enumerate(self.parameters)
        }
        self.node = node
        self.times = {node: time}
        self._walking = walking
        self._errors = errors
        self._lag = lag
        self._checked = time
        self._state_step = _STATE_STEP.copy()
        if ranges:
            self._state_step[3:6] = _POSITION_STEP_BY_RANGES
        settings = _settings(self.parameters, self._state_step, errors, fixed=lag is not None)
        self._isam = gtsam.ISAM2(settings)
        self._sizes = {key: int(size) for key, size in values.dims().items()}
        self._update(prior, values, node)

    def bias_key(self, k: int) -> int:
        """Return the key of the bias at state k."""
        return keys.bias(k if self._walking else 0)

    @property
    def oldest(self) -> int:
        """Index of the oldest state that can still be corrected."""
        return next(iter(self.times))

    def extend(
        self, time: float, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> None:
        """Add the next state, and marginalise those that leave the lag.

        Parameters
        ----------
        time : float
            Time of the new state, s.
        factors : gtsam.NonlinearFactorGraph
            Factors that tie it to the one before, and measurements after that one.
        values : gtsam.Values
            Start values of the new state, of its bias if that walks, and of its errors.
        """
        if self._lag is not None:
            end = time - self._lag
            for k in takewhile(lambda k: self.times[k] < end, range(self.oldest, self.node)):
                self._marginalise(k)
        self.node += 1
        self.times[self.node] = time
        self._sizes.update(values.dims())
        self._update(factors, values, self.node - 1)

    def correct(self, factors: gtsam.NonlinearFactorGraph, first: int) -> None:
        """Add measurements of states that are there, the oldest of index `first`."""
        self._update(factors, gtsam.Values(), first)

    def state(self, k: int) -> gtsam.NavState:
        """Return the estimate of state k."""
        key = keys.node(k)
        if key not in self._place:
            return self._isam.calculateEstimateNavState(key)
        if k not in self._states:
            at = self._isam.getLinearizationPoint().atNavState(key)
            self._states[k] = at.retract(self._step[self._place[key]])
        return self._states[k]

    def bias(self, k: int) -> gtsam.imuBias.ConstantBias:
        """Return the estimate of the bias at state k."""
        key = self.bias_key(k)
        if key not in self._place:
            return self._isam.calculateEstimateConstantBias(key)
        if key not in self._biases:
            at = self._isam.getLinearizationPoint().atConstantBias(key)
            self._biases[key] = at.retract(self._step[self._place[key]])
        return self._biases[key]

    def errors(self, k: int) -> Array:
        """Return the estimate of the correlated errors at state k, (n,), of unit variance."""
        key = keys.correlated(k)
        if key in self._place:
            at = self._isam.getLinearizationPoint().atVector(key)
            return np.asarray(at + self._step[self._place[key]])
        return self._isam.calculateEstimateVector(key)

    def calibration(self) -> dict[str, Array]:
        """Return the estimates of the parameters, SI; rotations as matrices."""
        at, out = self._isam.getLinearizationPoint(), {}
        for p in self.parameters:
            key = self.calibration_keys[p.name]
            step = self._step[self._place[key]]
            value = (
                at.atRot3(key).retract(step).matrix() if p.rotation else at.atVector(key) + step
            )
            out[p.name] = np.asarray(value)
        return out

    def joint_covariance(self) -> Array:
        """Return the joint covariance of newest state, its bias, the parameters and its errors.

        In that order, in GTSAM's tangent space, SI: attitude, position, velocity, bias of
        accelerometer and gyro, parameters, correlated errors.
        """
        own = np.concatenate([self._inverse[self._place[key]] for key in self._top()])
        return np.asarray(own @ own.T)

    def _solve_newest(self) -> None:
        """Solve for the newest two states and what all share.

        iSAM2's own estimates are of all states, and take longer than this.
        """
        before = self._of_state(self.node - 1) if self.node - 1 in self.times else []
        net = self._isam.jointBayesNet([*before, *self._top()], gtsam.EliminateQR)
        order = [net.at(i).firstFrontalKey() for i in range(net.size())]
        ends = accumulate(self._sizes[key] for key in order)
        self._place = {
            key: slice(end - self._sizes[key], end) for key, end in zip(order, ends, strict=True)
        }
        R, d = net.matrix()
        self._inverse, _ = dtrtri(R)
        self._step = self._inverse @ d
        # Of the newest, which are asked for again and again.
        self._states: dict[int, gtsam.NavState] = {}
        self._biases: dict[int, gtsam.imuBias.ConstantBias] = {}

    def states(self, wanted: Sequence[int]) -> States:
        """Return the estimates of states, by their indices, with the biases there."""
        own = wanted if self._walking else [self.node]
        return states_of([self.state(k) for k in wanted], [self.bias(k) for k in own])

    def state_covariances(self, wanted: Sequence[int]) -> Array:
        """Return covariances (K, 9, 9) of states, by their indices, given all that came since."""
        return np.array([self._isam.marginalCovariance(keys.node(k)) for k in wanted])

    def _top(self) -> list[int]:
        errors = [keys.correlated(self.node)] if self._errors else []
        calibration = self.calibration_keys.values()
        return [keys.node(self.node), self.bias_key(self.node), *calibration, *errors]

    def _of_state(self, k: int) -> list[int]:
        """Return the keys of state k, of its bias if that walks, and of its errors."""
        out = [keys.node(k)]
        if self._walking:
            out.append(keys.bias(k))
        if self._errors:
            out.append(keys.correlated(k))
        return out

    def _in_time(self) -> list[int]:
        """Return all keys in the order of elimination."""
        shared = [*([] if self._walking else [keys.bias(0)]), *self.calibration_keys.values()]
        return [*(key for k in self.times for key in self._of_state(k)), *shared]

    def _update(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, first: int
    ) -> None:
        settings = gtsam.ISAM2UpdateParams()
        if self._lag is None:
            settings.constrainedKeys = _groups([(key, 1) for key in self._top()])
            self._isam.update(factors, values, settings)
            self._solve_newest()
            return
        moved = self._moved()
        if moved is not None:
            first = min(first, moved)
            settings.force_relinearize = True
        # What is touched, and all above it in the tree, is eliminated anew: in the order of
        # time, so that the oldest state stays a leaf. Groups beyond the number of variables
        # are not allowed; calibration and bias are in one.
        first -= len(self.parameters)
        nodes = list(range(max(first, self.oldest), self.node))
        if len(nodes) > _MOST * len(self.times):
            # iSAM2 goes over to eliminating everything once it is most of it.
            nodes = [k for k in self.times if k < self.node]
            again = gtsam.KeyList()
            for key in self._in_time():
                if self._isam.valueExists(key):
                    again.push_back(key)
            settings.extraReelimKeys = again
        pairs = [(key, i) for i, k in enumerate(nodes) for key in self._of_state(k)]
        pairs += [(key, len(nodes)) for key in self._top()]
        settings.constrainedKeys = _groups(pairs)
        self._isam.update(factors, values, settings)
        self._solve_newest()

    def _moved(self) -> int | None:
        """Return the oldest state that has moved too far from where it was linearised."""
        now = self.times[self.node]
        if now < self._checked + _CHECK - _ROUNDING:
            return None
        self._checked = now
        delta = self._isam.getDelta()
        # The newest state may be yet to come.
        nodes = [k for k in self.times if k < self.node or delta.exists(keys.node(k))]
        steps = delta.vector([keys.node(k) for k in nodes]).reshape(-1, STATE_SIZE)
        fixed = self._isam.getFixedVariables()
        for i in np.flatnonzero((np.abs(steps) > self._state_step).any(axis=1)).tolist():
            if not fixed.count(keys.node(nodes[i])):
                return nodes[i]
        return None

    def _marginalise(self, k: int) -> None:
        leaves = gtsam.KeyList()
        for key in self._of_state(k):
            leaves.push_back(key)
            del self._sizes[key]
        self._isam.marginalizeLeaves(leaves)
        del self.times[k]


def _settings(
    parameters: Sequence[Parameter], state_step: Array, errors: int, *, fixed: bool
) -> gtsam.ISAM2Params:
    settings = gtsam.ISAM2Params()
    # Cholesky has no digits left at navigation grade.
    settings.setFactorization("QR")
    # With a lag, only where `Smoother` asks for it.
    settings.relinearizeSkip = 10**6 if fixed else 1
    # Without it the list of factors grows for ever.
    settings.findUnusedFactorSlots = True
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", state_step))
    thresholds.insert(("b", _BIAS_STEP))
    step = _NEVER if fixed else _CALIBRATION_STEP
    for size in {p.mean.size for p in parameters}:
        thresholds.insert((keys.letter(size), np.full(size, step)))
    if errors:
        # Measurements are linear in them.
        letter = keys.letter_of(keys.correlated(0))
        thresholds.insert((letter, np.full(errors, _NEVER)))
    settings.setRelinearizeThreshold(thresholds)
    return settings


def _groups(pairs: Sequence[tuple[int, int]]) -> gtsam.KeyGroupMap:
    out = gtsam.KeyGroupMap()
    for key, group in pairs:
        out.insert2(key, group)
    return out
