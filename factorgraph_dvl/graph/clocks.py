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
    """Return the names of all parameters of a measurement, those of clock and window included."""
    clock, averaging = observation.clock, observation.averaging
    own = () if clock is None else clock.names
    return (*observation.parameters, *own, *(() if averaging is None else (averaging,)))


def true_time(observation: Observation, values: Mapping[str, Array], zero: float) -> Array:
    """Return the times at which measurements were true, (M,), s.

    Parameters
    ----------
    observation : Observation
        M measurements.
    values : mapping of str to ndarray
        Values of the parameters, SI.
    zero : float, s
        Reference time of the clock offsets.
    """
    clock = observation.clock
    if clock is None:
        return observation.time
    return observation.time - clock.lag(observation.time, values, zero)


def time_on_chain(
    observation: Observation, values: Mapping[str, Array], zero: float, clock: str | None
) -> Array:
    """Return the times of measurements by the clock of the nodes, (M,), s.

    Parameters
    ----------
    observation : Observation
        M measurements.
    values : mapping of str to ndarray
        Values of the parameters, SI.
    zero : float, s
        Reference time of the clock offsets.
    clock : str, optional
        Name of the offset of the clock that the nodes have; None = they are at true times.
    """
    time = true_time(observation, values, zero)
    return time if clock is None else time + values[clock][0]


def linearized(
    observation: Observation,
    motion: Motion,
    values: Mapping[str, Array],
    wanted: Collection[str],
    zero: float,
    clock: str | None = None,
    attitude_clock: str | None = None,
) -> Linearization:
    """Return residual and Jacobians of measurements, those of clock and window included.

    With the lag l of the stamps, which is o + r (t - t0) and more,

        dρ/do = -(dρ/dθ ω_eb + dρ/dp v + dρ/dv a + dρ/dω α),    dρ/dr = (t - t0) dρ/do,

    and of any other parameter of the clock, dl/dc dρ/do.

    Nodes that move with a clock of lag n have dρ/dn = -dρ/do, for all measurements; where their
    attitudes have a clock of their own, each of both takes its terms.

    Parameters
    ----------
    observation : Observation
        M measurements.
    motion : Motion
        Motion at the true times.
    values : mapping of str to ndarray
        Values of the parameters, SI.
    wanted : collection of str
        Parameters whose Jacobians are needed.
    zero : float, s
        Reference time t0 of the clock offsets.
    clock : str, optional
        Name of the offset of the clock that the nodes have; None = they are at true times.
    attitude_clock : str, optional
        The same of their attitudes and rates; None = that of the nodes.
    """
    lin = observation.linearize(motion, values, wanted)
    averaging = observation.averaging
    own = () if observation.clock is None else observation.clock.names
    if not {*own, averaging, clock, attitude_clock} & {*wanted}:
        return lin

    def by_change(*of: tuple[Array | None, Array]) -> Array:
        out = np.zeros((*lin.residual.shape, 1))
        for jacobian, change in of:
            if jacobian is not None:
                out += jacobian @ change[:, :, None]
        return out

    turn, move = motion.changes
    turning = by_change((lin.d_theta, turn), (lin.d_omega, motion.alpha_b))
    moving = by_change((lin.d_p, move), (lin.d_v, motion.a_n))
    by_time = turning + moving
    found = dict(lin.d_parameters)
    if averaging is not None and averaging in wanted:
        mean = motion.mean
        found[averaging] = (
            np.zeros_like(by_time)
            if mean is None
            else by_change((lin.d_v, mean.v_by_length), (lin.d_omega, mean.omega_by_length))
        )
    if observation.clock is not None and not set(own).isdisjoint(wanted):
        by_name = observation.clock.by_parameters(observation.time, values, zero)
        for name in set(own) & {*wanted}:
            # A measurement from another vessel knows itself how that one moves.
            found[name] = found.get(name, 0.0) - by_time * by_name[name][:, None, None]
    for of_chain, by in ((clock, moving), (attitude_clock or clock, turning)):
        if of_chain is not None and of_chain in wanted:
            found[of_chain] = found.get(of_chain, 0.0) + by
    return replace(lin, d_parameters=found)
