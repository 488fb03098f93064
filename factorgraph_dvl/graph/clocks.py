"""Time offsets and rates of clocks, applied to measurements: a late stamp saw the motion before.

A residual depends on time only through the motion, so the chain rule gives the derivative
with respect to a clock for every sensor alike.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.protocol import Linearization, Motion, Observation


def parameters_of(observation: Observation) -> tuple[str, ...]:
    """Return the names of all parameters of a measurement, those of its clock included."""
    clock = observation.clock
    return observation.parameters if clock is None else (*observation.parameters, *clock.names)


def true_time(observation: Observation, values: Mapping[str, Array], zero: float) -> Array:
    """Return the times at which measurements were true, (M,), s.

    Parameters
    ----------
    observation : Observation
        M measurements.
    values : mapping of str to ndarray
        Values of the parameters, SI.
    zero : float, s
        Time at which the offsets of clocks hold.
    """
    clock = observation.clock
    if clock is None:
        return observation.time
    return observation.time - clock.lag(observation.time, values, zero)


def linearized(
    observation: Observation,
    motion: Motion,
    values: Mapping[str, Array],
    wanted: Collection[str],
    zero: float,
) -> Linearization:
    """Return residual and Jacobians of measurements, those of their clock included.

    With the lag o + r (t - t0) of the stamps,

        dρ/do = -(dρ/dθ ω_eb + dρ/dp v + dρ/dv a + dρ/dω α),    dρ/dr = (t - t0) dρ/do.

    Parameters
    ----------
    observation : Observation
        M measurements.
    motion : Motion
        At the true times.
    values : mapping of str to ndarray
        Values of the parameters, SI.
    wanted : collection of str
        Parameters whose Jacobians are needed.
    zero : float, s
        Time t0 at which the offsets of clocks hold.
    """
    lin = observation.linearize(motion, values, wanted)
    if observation.clock is None:
        return lin
    offset, rate = observation.clock.names
    if offset not in wanted and rate not in wanted:
        return lin
    by_time = np.zeros((*lin.residual.shape, 1))
    for jacobian, change in (
        (lin.d_theta, motion.omega_eb_b),
        (lin.d_p, motion.v_n),
        (lin.d_v, motion.a_n),
        (lin.d_omega, motion.alpha_b),
    ):
        if jacobian is not None:
            by_time += jacobian @ change[:, :, None]
    found = dict(lin.d_parameters)
    if offset in wanted:
        found[offset] = -by_time
    if rate in wanted:
        found[rate] = -by_time * (observation.time - zero)[:, None, None]
    return replace(lin, d_parameters=found)
