"""Numerical against analytic Jacobians of an observation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.clocks import linearized, parameters_of, true_time
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Motion, Observation

STEP = 1e-6
# When the offsets of clocks hold, s; of any motion here.
ZERO = 1.5


def differentiate(function: Callable[[Array], Array], size: int, step: float = STEP) -> Array:
    """Return central differences, (..., size), of a function of a perturbation (size,)."""
    columns = []
    for i in range(size):
        h = np.zeros(size)
        h[i] = step
        columns.append((function(h) - function(-h)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def moved(motion: Motion, tau: Array) -> Motion:
    """Return a motion later by `tau` (M, 1), s, to first order."""
    return replace(
        motion,
        nRb=motion.nRb @ exp_so3(motion.omega_eb_b * tau),
        p_n=motion.p_n + motion.v_n * tau,
        v_n=motion.v_n + motion.a_n * tau,
        omega_eb_b=motion.omega_eb_b + motion.alpha_b * tau,
    )


def check_jacobians(
    observation: Observation,
    motion: Motion,
    values: dict[str, Array],
    parameters: tuple[Parameter, ...],
    *,
    tolerance: float = 1e-8,
) -> None:
    """Assert that `linearize` agrees with central differences of `residual`.

    With respect to theta in nRb Exp(theta), p_n, v_n, omega_eb_b, and every parameter that
    the observation names: additive, for a rotation delta in R Exp(delta), for a time offset
    by carrying the motion to the true time.

    Parameters
    ----------
    observation, motion, values : where to differentiate.
    parameters : those of the sensor; they tell rotations from vectors.
    tolerance : of the difference, relative to 1 or to the largest element.
    """
    names = parameters_of(observation)
    by_name = {p.name: p for p in parameters}
    # A clock is right unless the caller says otherwise.
    clock = () if observation.clock is None else observation.clock.names
    window = () if observation.averaging is None else (observation.averaging,)
    values = {name: np.zeros(1) for name in (*clock, *window)} | values
    lin = linearized(observation, motion, values, names, ZERO)
    m, d = lin.residual.shape
    np.testing.assert_allclose(lin.residual, observation.residual(motion, values), atol=1e-14)

    def of_motion(change: Callable[[Array], Motion]) -> Array:
        return differentiate(lambda h: observation.residual(change(h), values), 3)

    found = {
        "theta": of_motion(lambda h: replace(motion, nRb=motion.nRb @ exp_so3(h))),
        "p": of_motion(lambda h: replace(motion, p_n=motion.p_n + h)),
        "v": of_motion(lambda h: replace(motion, v_n=motion.v_n + h)),
        "omega": of_motion(lambda h: replace(motion, omega_eb_b=motion.omega_eb_b + h)),
    }
    stated = {"theta": lin.d_theta, "p": lin.d_p, "v": lin.d_v, "omega": lin.d_omega}
    assert set(lin.d_parameters) == set(names)
    for name in names:
        stated[name] = lin.d_parameters[name]
        found[name] = _of_parameter(observation, motion, values, name, by_name.get(name))
    for name, numerical in found.items():
        analytic = stated[name]
        if analytic is None:
            analytic = np.zeros_like(numerical)
        assert analytic.shape == (m, d, numerical.shape[-1]), name
        scale = max(1.0, float(np.abs(numerical).max()))
        worst = float(np.abs(analytic - numerical).max()) / scale
        assert worst < tolerance, f"{name}: analytic and numerical differ by {worst:.2e}"


def _of_parameter(
    observation: Observation,
    motion: Motion,
    values: dict[str, Array],
    name: str,
    parameter: Parameter | None,
) -> Array:
    def at(h: Array) -> Array:
        if parameter is not None and parameter.rotation:
            return observation.residual(motion, {**values, name: values[name] @ exp_so3(h)})
        changed = {**values, name: values[name] + h}
        shift = true_time(observation, changed, ZERO) - true_time(observation, values, ZERO)
        return observation.residual(moved(motion, shift[:, None]), changed)

    return differentiate(at, values[name].shape[-1])


def random_motion(m=5, seed=3):
    """Motion at m times that no vehicle makes."""
    rng = np.random.default_rng(seed)
    return Motion(
        nRb=exp_so3(rng.normal(0.0, 1.5, (m, 3))),
        p_n=rng.normal(0.0, 50.0, (m, 3)),
        v_n=rng.normal(0.0, 3.0, (m, 3)),
        omega_eb_b=rng.normal(0.0, 0.5, (m, 3)),
        a_n=rng.normal(0.0, 1.0, (m, 3)),
        alpha_b=rng.normal(0.0, 1.0, (m, 3)),
        omega_sigma=np.full((m, 3), 1e-4),
    )
