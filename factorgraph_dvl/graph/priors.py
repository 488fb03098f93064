"""Priors of the calibration parameters: each for itself, or of several together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag

from factorgraph_dvl.geometry.rotations import exp_so3, inverse_right_jacobian, right_jacobian
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.keys import BIAS_SIZE
from factorgraph_dvl.sensors.parameters import Parameter, Relative

# Source of noise of a prior.
PRIOR = "prior of {}"
# Stands for a standard deviation of 0 in a parameter of which other components are estimated,
# SI. Chosen: far below what is measured.
_FIXED_STD = 1e-7
# What the factor of a tilt adds to the cost where it holds. Chosen: along the gradient it adds a
# millionth of the square of the slope, in standard deviations, and leaves the cost nine digits.
_TILT_CONSTANT = 1e6
# Share of its prior's standard deviation by which a parameter that is held may move, inverted.
# Chosen: below what is measured.
_HELD = 1e4
# Least eigenvalue of the correlations of a calibration. Chosen: it may know a combination of
# parameters a million times better than each.
_LEAST_EIGENVALUE = 1e-12


@dataclass(frozen=True)
class ConstantsPrior:
    """Joint prior of biases and calibration parameters, in place of their own priors.

    Parameters
    ----------
    bias : ndarray, shape (6,), SI
        Mean of accelerometer and gyro bias at the first node.
    parameters : dict of str to ndarray
        Means of the parameters that are estimated, rotations as matrices.
    covariance : ndarray, shape (6 + P, 6 + P)
        Covariance of biases and parameters, in the tangent space at the mean, SI.
    """

    bias: Array
    parameters: dict[str, Array]
    covariance: Array


def add_priors(
    graph: gtsam.NonlinearFactorGraph, parameters: Sequence[Parameter], key_of: Mapping[str, int]
) -> None:
    """Add the priors of parameters, those of one calibration as one factor."""
    origin = {p.name: prior_mean(p) for p in parameters}
    for group in _groups(parameters):
        if len(group) == 1 and group[0].joint is None:
            _add_prior(graph, group[0], key_of[group[0].name])
        else:
            gain = np.asarray(np.linalg.inv(_root_of(group)), float)
            graph.add(linear_prior(group, key_of, gain, origin))


def add_bias_prior(
    graph: gtsam.NonlinearFactorGraph,
    biases: tuple[Parameter, Parameter],
    bias_key: int,
    parameters: Sequence[Parameter],
    key_of: Mapping[str, int],
) -> None:
    """Add the prior of gyro and accelerometer bias, with the parameters of their calibration."""
    gyro, accel = biases
    mean = np.concatenate([accel.mean, gyro.mean])
    if gyro.joint is None:
        at = gtsam.imuBias.ConstantBias(accel.mean, gyro.mean)
        sigmas = np.concatenate([accel.sigma, gyro.sigma])
        graph.addPriorConstantBias(bias_key, at, loose_diagonal(sigmas))
        return
    root = _root_of([accel, gyro, *parameters])
    prior = ConstantsPrior(mean, {p.name: prior_mean(p) for p in parameters}, root @ root.T)
    graph.add(joint_linear_prior(prior, bias_key, parameters, key_of))


def prior_root(parameters: Sequence[Parameter]) -> Array:
    """Return a square root S of the prior covariance S Sᵀ of parameters, (P, P), SI.

    In the tangent space at the prior's mean. Priors are stated for the rotation vector:
    Exp(alpha + a) = Exp(alpha) Exp(Jr(alpha) a).
    """
    size = sum(p.mean.size for p in parameters)
    place = places(parameters)
    out = np.zeros((size, size))
    for group in _groups(parameters):
        own = np.concatenate([np.arange(size)[place[p.name]] for p in group])
        out[np.ix_(own, own)] = _root_of(group)
    return out


@dataclass(frozen=True)
class Tilt:
    """A gradient of the objective by the parameters that no residual has.

    As that of the volume of the states: the minimum of the squares alone is not the most probable
    one where the states are known the better, the larger a parameter is.

    Parameters
    ----------
    gradient : ndarray, shape (P,), 1/SI
        Gradient in the tangent space at the origin.
    sigma : ndarray, shape (P,), SI
        Standard deviations of the parameters.
    origin : dict of str to ndarray
        Values of the parameters that it is about.
    hold : ndarray, shape (P, P), 1/SI, optional
        Square root of the information that keeps a step short, about the origin.
    """

    gradient: Array
    sigma: Array
    origin: dict[str, Array]
    hold: Array | None = None

    @classmethod
    def holding(cls, parameters: Sequence[Parameter], values: Mapping[str, Array]) -> Tilt:
        """Return what leaves parameters where they are, while states find their minimum."""
        free = [p for p in parameters if p.estimated]
        sigma = np.concatenate([p.sigma for p in free]) if free else np.zeros(0)
        origin = {p.name: values[p.name] for p in free}
        return cls(
            np.zeros(sigma.size), sigma, origin, np.diag(_HELD / np.maximum(sigma, _FIXED_STD))
        )

    @property
    def constant(self) -> float:
        """What its factor adds to the cost beside `cost`."""
        return _TILT_CONSTANT

    def cost(self, parameters: Sequence[Parameter], values: Mapping[str, Array]) -> float:
        """Return what it adds to the cost: zero at the origin."""
        off = np.concatenate(
            [local_coordinates(p, values[p.name], self.origin[p.name]) for p in parameters]
        )
        held = 0.0 if self.hold is None else 0.5 * float(np.sum((self.hold @ off) ** 2))
        return float(self.gradient @ off) + held

    def of(self, before: Sequence[Parameter], after: Sequence[Parameter]) -> Tilt:
        """Return it for other parameters: without a gradient by those that it does not have."""
        known = places(before)
        parts = [
            (self.gradient[known[p.name]], self.sigma[known[p.name]])
            if p.name in known
            else (np.zeros(p.mean.size), p.sigma)
            for p in after
        ]
        gradient, sigma = map(np.concatenate, zip(*parts, strict=True))
        means = {p.name: prior_mean(p) for p in after}
        return Tilt(gradient, sigma, means | self.origin)

    def factor(
        self, parameters: Sequence[Parameter], key_of: Mapping[str, int]
    ) -> gtsam.CustomFactor:
        """Return a factor with this gradient, and with hardly any information but that of `hold`.

        The error e has half the square c + g d, so that its slope is g wherever it is.
        """
        gradient, origin = self.gradient, self.origin
        hold = np.zeros((0, gradient.size)) if self.hold is None else self.hold
        own = list(places(parameters).values())

        def error(
            this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None
        ) -> Array:
            off = [
                local_coordinates(p, value_at(at, key_of[p.name], p), origin[p.name])
                for p in parameters
            ]
            every = np.concatenate(off)
            total = np.sqrt(2.0 * (_TILT_CONSTANT + gradient @ every))
            if jacobians is not None:
                for i, (p, each) in enumerate(zip(parameters, off, strict=True)):
                    slope = np.vstack([gradient[None, own[i]] / total, hold[:, own[i]]])
                    by_step = slope @ inverse_right_jacobian(each) if p.rotation else slope
                    jacobians[i] = np.asfortranarray(by_step)
            return np.concatenate([[total], hold @ every])

        noise = gtsam.noiseModel.Unit.Create(1 + len(hold))
        return gtsam.CustomFactor(noise, [key_of[p.name] for p in parameters], error)


def linear_prior(
    parameters: Sequence[Parameter],
    key_of: Mapping[str, int],
    gain: Array,
    origin: Mapping[str, Array],
) -> gtsam.CustomFactor:
    """Return a factor of unit noise on gain times the difference of parameters to an origin.

    The callback must not know the problem: GTSAM would keep it, and it GTSAM's graph, and
    nothing would ever free the two.
    """
    columns = [gain[:, place] for place in places(parameters).values()]

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        total = np.zeros(gain.shape[0])
        for i, (p, part) in enumerate(zip(parameters, columns, strict=True)):
            off = local_coordinates(p, value_at(at, key_of[p.name], p), origin[p.name])
            total += part @ off
            if jacobians is not None:
                by_step = part @ inverse_right_jacobian(off) if p.rotation else part
                jacobians[i] = np.asfortranarray(by_step)
        return total

    noise = gtsam.noiseModel.Unit.Create(gain.shape[0])
    return gtsam.CustomFactor(noise, [key_of[p.name] for p in parameters], error)


def joint_linear_prior(
    prior: ConstantsPrior,
    bias_key: int,
    parameters: Sequence[Parameter],
    key_of: Mapping[str, int],
) -> gtsam.CustomFactor:
    """Return the joint prior of biases and parameters as one factor."""
    sigma = np.sqrt(np.diag(prior.covariance))
    correlation = prior.covariance / np.outer(sigma, sigma)
    gain = np.linalg.inv(np.linalg.cholesky(correlation)) / sigma
    ends = np.cumsum([BIAS_SIZE, *(p.mean.size for p in parameters)])
    columns = np.split(gain, ends[:-1], axis=1)

    def error(this: gtsam.CustomFactor, at: gtsam.Values, jacobians: list[Array] | None) -> Array:
        total = columns[0] @ (at.atConstantBias(bias_key).vector() - prior.bias)
        parts = [columns[0]]
        for p, part in zip(parameters, columns[1:], strict=True):
            off = local_coordinates(p, value_at(at, key_of[p.name], p), prior.parameters[p.name])
            total = total + part @ off
            parts.append(part @ inverse_right_jacobian(off) if p.rotation else part)
        if jacobians is not None:
            for i, part in enumerate(parts):
                jacobians[i] = np.asfortranarray(part)
        return np.asarray(total)

    every = [bias_key, *(key_of[p.name] for p in parameters)]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(sigma.size), every, error)


def value_at(values: gtsam.Values, key: int, p: Parameter) -> Array:
    """Return a parameter among values, a rotation as its matrix."""
    return values.atRot3(key).matrix() if p.rotation else values.atVector(key)


def local_coordinates(p: Parameter, value: Array, origin: Array) -> Array:
    """Return a parameter minus an origin, in the origin's tangent space, SI."""
    if p.rotation:
        return np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(origin.T @ value)))
    return value - origin


def places(parameters: Sequence[Parameter]) -> dict[str, slice]:
    """Return the place of each parameter among the components of all."""
    out, end = {}, 0
    for p in parameters:
        out[p.name] = slice(end, end + p.mean.size)
        end += p.mean.size
    return out


def after_step(
    parameters: Sequence[Parameter], values: Mapping[str, Array], step: Array
) -> dict[str, Array]:
    """Return values after a step (P,) of some parameters in their tangent space, SI."""
    out = dict(values)
    for p, place in zip(parameters, places(parameters).values(), strict=True):
        part, value = step[place], values[p.name]
        out[p.name] = value @ exp_so3(part) if p.rotation else value + part
    return out


def prior_mean(p: Parameter) -> Array:
    """Return the mean of a prior, a rotation as its matrix."""
    return exp_so3(p.mean) if p.rotation else p.mean


def _groups(parameters: Sequence[Parameter]) -> list[list[Parameter]]:
    """Return parameters in groups with a common prior; those that are relative come last."""
    by_name = {p.name: p for p in parameters}

    def leading(p: Parameter) -> Parameter:
        return p if p.relative is None else by_name.get(p.relative.to, p)

    groups: dict[int, list[Parameter]] = {}
    for p in sorted(parameters, key=lambda p: leading(p) is not p):
        first = leading(p)
        groups.setdefault(id(first.joint or first), []).append(p)
    return list(groups.values())


def _add_prior(graph: gtsam.NonlinearFactorGraph, p: Parameter, key: int) -> None:
    sigma = np.maximum(p.sigma, _FIXED_STD)
    if p.rotation:
        # The prior is stated for the rotation vector, GTSAM's for its tangent space.
        root = inverse_right_jacobian(p.mean) / sigma[:, None]
        graph.addPriorRot3(key, gtsam.Rot3(exp_so3(p.mean)), square_root(root))
    else:
        graph.addPriorVector(key, p.mean, loose_diagonal(sigma))


def _root_of(group: Sequence[Parameter]) -> Array:
    """Return a square root of the prior covariance of parameters in their tangent space, SI."""
    relative = [p.relative for p in group if p.relative is not None]
    if relative and len(group) > 1:
        return _relative_root(group[: -len(relative)], relative)
    sigma = np.concatenate([p.sigma for p in group])
    sigma = np.where(sigma > 0.0, sigma, _FIXED_STD)
    root = np.diag(sigma)
    joint = group[0].joint
    if joint is not None:
        rows = np.concatenate(
            [np.arange(len(joint.covariance))[joint.rows(p.name)] for p in group]
        )
        std = np.sqrt(np.diag(joint.covariance))[rows]
        scale = np.where(std > 0.0, std, 1.0)
        correlation = joint.covariance[np.ix_(rows, rows)] / np.outer(scale, scale)
        correlation[np.diag_indices_from(correlation)] = 1.0
        values, vectors = np.linalg.eigh(0.5 * (correlation + correlation.T))
        root = sigma[:, None] * vectors * np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))
    to_tangent = block_diag(
        *(right_jacobian(p.mean) if p.rotation else np.eye(p.mean.size) for p in group)
    )
    return np.asarray(to_tangent @ root)


def _relative_root(others: Sequence[Parameter], relative: Sequence[Relative]) -> Array:
    """Return the square root of a group in which some are relative to others: each follows one."""
    root, place = _root_of(others), places(others)
    own = [max(each.sigma, _FIXED_STD) for each in relative]
    follows = [root[place[each.to]] for each in relative]
    below = np.hstack([np.concatenate(follows), np.diag(own)])
    return np.vstack([np.hstack([root, np.zeros((len(root), len(own)))]), below])


def square_root(root: Array) -> gtsam.noiseModel.Gaussian:
    """Return a noise model from square-root information (n, n), not squared on the way."""
    return gtsam.noiseModel.Gaussian.SqrtInformation(np.linalg.qr(root, mode="r"), False)


def loose_diagonal(sigmas: Array) -> gtsam.noiseModel.Diagonal:
    """Return a diagonal noise model that stays one.

    GTSAM's default takes a sigma below 1e-8, as of a good gyro's bias, for a constraint.
    """
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas, False)
