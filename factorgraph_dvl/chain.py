"""The inertial part of the graph: IMU factors, walking biases, priors of the states."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl import keys
from factorgraph_dvl.conventions import Array, rotation_from_rph, rph_jacobian
from factorgraph_dvl.earth import LocalFrame
from factorgraph_dvl.preintegration import Segments, States, preintegrate
from factorgraph_dvl.trial import Trial

# Bounds, not knowledge: they keep an unaided chain from being singular.
_FREE_ATTITUDE = np.pi
_FREE_POSITION = 1e5
_FREE_VELOCITY = 1e2
# What a standard deviation of 0 in `initial` stands for, rad; far below what is measured.
_LEAST_STD = 1e-7
# Keeps the walk of a bias that does not walk regular.
_LEAST_WALK = 1e-12


@dataclass(frozen=True)
class Chain:
    """The inertial part of a graph, common to every set of aiding sensors.

    Parameters
    ----------
    trial, frame, segments : what it was made from.
    gravity_n : (S, 3) along the segments, m/s².
    graph : IMU factors, walks of the biases, priors of states and biases.
    """

    trial: Trial
    frame: LocalFrame
    segments: Segments
    gravity_n: Array
    graph: gtsam.NonlinearFactorGraph

    @property
    def walking(self) -> bool:
        """Whether every node has a bias of its own."""
        return self.trial.imu.settings.bias_walks

    def bias_key(self, k: int) -> int:
        """Return the key of the bias at node k."""
        return keys.bias(k if self.walking else 0)


def inertial_chain(trial: Trial, frame: LocalFrame, seg: Segments, start: States) -> Chain:
    """Return the inertial part of the graph, with gravity at the positions of `start`."""
    middle = 0.5 * (start.p_n[seg.origin] + start.p_n[seg.origin + 1])
    gravity_n = frame.gravity_without_rotation(middle)
    settings = trial.imu.settings
    graph = gtsam.NonlinearFactorGraph()
    chain = Chain(trial, frame, seg, gravity_n, graph)
    pims = preintegrate(seg, settings, gravity_n, frame.earth_rate)
    for k, pim in zip(seg.origin.tolist(), pims, strict=True):
        graph.add(gtsam.GalileanImuFactor2(keys.node(k), keys.node(k + 1), chain.bias_key(k), pim))
    gyro, accel = trial.imu.parameters(0.0)
    sigmas = np.concatenate([accel.sigma, gyro.sigma])
    graph.addPriorConstantBias(keys.bias(0), gtsam.imuBias.ConstantBias(), loose_diagonal(sigmas))
    if chain.walking:
        root_psd = np.repeat(
            [settings.accel_bias_walk_root_psd, settings.gyro_bias_walk_root_psd], 3
        )
        step = np.diff(seg.node_time)
        for k in range(step.size):
            walk = np.maximum(root_psd * np.sqrt(step[k]), _LEAST_WALK)
            graph.add(
                gtsam.BetweenFactorConstantBias(
                    keys.bias(k),
                    keys.bias(k + 1),
                    gtsam.imuBias.ConstantBias(),
                    loose_diagonal(walk),
                )
            )
    for a, (first, _) in enumerate(seg.arc_nodes):
        mean, covariance = _state_prior(trial, frame, start, int(first), known=a == 0)
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance, False)
        graph.add(gtsam.PriorFactorNavState(keys.node(int(first)), mean, noise))
    return chain


def _state_prior(
    trial: Trial, frame: LocalFrame, start: States, k: int, *, known: bool
) -> tuple[gtsam.NavState, Array]:
    """Return mean and covariance, in GTSAM's tangent space, of a state at the start of an arc."""
    nRb, p_n = start.nRb[k], start.p_n[k]
    attitude = np.eye(3) * _FREE_ATTITUDE**2
    position = np.eye(3) * _FREE_POSITION**2
    if known and trial.initial_attitude is not None:
        nRb = rotation_from_rph(trial.initial_attitude.rph, trial.body_axes)
        inverse = np.linalg.inv(rph_jacobian(trial.initial_attitude.rph, trial.body_axes))
        std = np.maximum(trial.initial_attitude.std, _LEAST_STD)
        attitude = inverse @ np.diag(std**2) @ inverse.T
    if known and trial.initial_position is not None:
        p_n = frame.position(*trial.initial_position.geodetic)
        std = np.maximum(trial.initial_position.std, 1e-6)
        position = nRb.T @ np.diag(std**2) @ nRb
    covariance = np.zeros((9, 9))
    covariance[:3, :3] = attitude
    covariance[3:6, 3:6] = position
    covariance[6:, 6:] = np.eye(3) * _FREE_VELOCITY**2
    return gtsam.NavState(gtsam.Rot3(nRb), p_n, start.v_n[k]), covariance


def loose_diagonal(sigmas: Array) -> gtsam.noiseModel.Diagonal:
    """Return a diagonal noise model that stays one.

    GTSAM's default takes a sigma below 1e-8, as of a good gyro's bias, for a constraint.
    """
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas, False)
