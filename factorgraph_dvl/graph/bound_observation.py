"""Measurements tied to a chain: their motion, their residuals, and derivatives by all variables.

A sensor states its residual in terms of the motion at the time of measurement, the chain carries
the motion there, and the chain rule takes the derivatives to the nodes.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.clocks import linearized, parameters_of, time_on_chain
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.observation_rows import some_of
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.imu.window_means import by_motion_in_the_middle
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import (
    Linearization,
    Motion,
    Observation,
    Window,
)

# Unit of the residuals of attitudes.
_ANGLE = "rad"


@dataclass(frozen=True)
class Processes:
    """Processes that an observation depends on.

    Parameters
    ----------
    added : Process, optional
        Adds to its residual.
    varying : tuple of Process
        Each adds to a parameter.
    """

    added: Process | None
    varying: tuple[Process, ...]

    @property
    def all(self) -> tuple[Process, ...]:
        """All of them."""
        return self.varying if self.added is None else (self.added, *self.varying)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all."""
        return tuple(p.name for p in self.all)


def processes_of(observation: Observation, processes: Sequence[Process]) -> Processes:
    """Return the processes that an observation depends on."""
    added = [p for p in processes if p.label == observation.label]
    varying = tuple(p for p in processes if p.parameter in parameters_of(observation))
    return Processes(added[0] if added else None, varying)


def covers_windows(
    chain: Chain, observation: Observation, time: Array, parameters: Mapping[str, Array]
) -> BoolArray:
    """Return whether a chain covers the windows about times (M,) over which a sensor averages."""
    name = observation.averaging
    if name is None or not parameters[name].any():
        return np.ones(time.size, dtype=bool)
    half = 0.5 * abs(float(parameters[name][0]))
    return np.asarray(chain.covers(time - half) & chain.covers(time + half))


@dataclass(eq=False)
class BoundObservation:
    """An observation tied to a chain.

    Parameters
    ----------
    observation : Observation
        M measurements of d components.
    chain : Chain
        What carries the motion.
    attachment : Attached
        Where the measurements are attached to it.
    usable : ndarray of bool, shape (M,)
        Whether they may be used: the motion was known there when they were bound.
    weight : ndarray, shape (M, d)
        Inverse standard deviations; 0 = not used.
    clock_zero : float, s
        Reference time of the clock offsets.
    errors : ImuErrors, optional
        Errors of the IMU that are estimated.
    averages : bool, default False
        Whether the length of the window over which it averages is estimated.
    """

    observation: Observation
    chain: Chain
    attachment: Any
    usable: BoolArray
    weight: Array
    clock_zero: float
    errors: ImuErrors | None = None
    averages: bool = False

    def __post_init__(self) -> None:
        # Until it is known that it does not.
        self._sees_motion = True
        self._recorded: Linearization | None = None

    def single(self, i: int) -> BoundObservation:
        """Return a measurement by itself, as if the nodes around it were the first two."""
        index = np.array([i])
        chain = self.chain.from_node(self.chain.nodes_at(self.attachment)[i])
        errors = self.errors
        return replace(
            self,
            observation=some_of(self.observation, index),
            chain=chain,
            attachment=None,
            usable=self.usable[index],
            weight=self.weight[index],
            errors=None if errors is None else chain.errors(errors.parameters, errors.key_of),
        )

    def parameters(self, every: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Return those of all estimated parameters that it depends on."""
        own = self.names
        return tuple(p for p in every if p.name in own)

    @property
    def clocks(self) -> set[str | None]:
        """Names of the parameters that move it in time."""
        clock = self.observation.clock
        of_chain = (self.chain.clock, self.chain.attitude_clock)
        return {*of_chain, *(() if clock is None else clock.names)}

    @property
    def names(self) -> set[str | None]:
        """Names of the parameters that it may depend on."""
        of_chain = (self.chain.clock, self.chain.attitude_clock)
        return {*parameters_of(self.observation), *ERRORS, *of_chain}

    def times(self, parameters: Mapping[str, Array]) -> Array:
        """Return when measurements were made by clocks as they are, (M,), s, by that of nodes."""
        return time_on_chain(self.observation, parameters, self.clock_zero, self.chain.clock)

    def attached(self, parameters: Mapping[str, Array]) -> Any:
        """Return where measurements are attached to the chain by clocks as they are."""
        shift = self.chain.shift(parameters)
        return self.chain.attach(
            self.times(parameters),
            shift,
            self.window(parameters),
            of_attitude=self.of_attitude,
        )

    @property
    def of_attitude(self) -> bool:
        """Whether it measures attitude alone, and attitudes of the chain are by themselves."""
        return self.chain.attitude_clock is not None and self.observation.unit == _ANGLE

    def window(self, parameters: Mapping[str, Array]) -> Window | None:
        """Return the window that measurements are means over; None = of none."""
        name = self.observation.averaging
        if name is None or not (self.averages or parameters[name].any()):
            return None
        return Window(float(parameters[name][0]), self.observation.averages_in_body)

    def attach(self, parameters: Mapping[str, Array]) -> None:
        """Attach measurements to the chain by clocks as they are."""
        self.attachment = self.attached(parameters)

    def motion(self, at: Any, states: Any, parameters: Mapping[str, Array]) -> Motion:
        """Return the motion where measurements are attached to the chain."""
        return self.chain.motion(self._corrected(at, parameters), states)

    def _corrected(self, at: Any, parameters: Mapping[str, Array]) -> Any:
        """Return an attachment without errors of the IMU."""
        if self.errors is None:
            return at
        by = self.errors.sensitivity(at)
        return self.errors.without(at, by, self.errors.vector(parameters))

    def missing(
        self, at: Any, motion: Motion, parameters: Mapping[str, Array], processes: Processes
    ) -> Array | None:
        """Return what the motion between nodes adds to the variance of measurements, (M, d).

        None where that is nothing.
        """
        if not self._sees_motion:
            return None
        missing = self.chain.missing(at, self.by_motion(motion, parameters, processes))
        self._sees_motion = missing is not None
        return missing

    def averaged_noise(self, at: Any, lin: Linearization, length: float, weight: Array) -> float:
        """Return by how much squares of residuals fall, on average, as a mean averages IMU noise.

        Parameters
        ----------
        at : object
            Where measurements are attached to the chain.
        lin : Linearization
            Their derivatives by the motion there.
        length : float, s
            Length of the window.
        weight : ndarray, shape (M, d)
            What they are weighed by; 0 = not used.
        """
        saved = self.chain.averaged(at, lin, length)
        if saved is None:
            return 0.0
        return float(np.sum(np.where(weight > 0.0, weight**2 * saved, 0.0)))

    def by_motion(
        self, motion: Motion, parameters: Mapping[str, Array], processes: Processes
    ) -> Linearization:
        """Return the derivatives by the motion; those by one that is recorded do not change."""
        lin = self._recorded
        if lin is None:
            lin = self.linearized(motion, parameters, (), processes)
            self._recorded = None if self.chain.interpolates else lin
        return lin

    def values(self, parameters: Mapping[str, Array], processes: Processes) -> Mapping[str, Array]:
        """Return the parameters that measurements see: what varies has a value for each."""
        if not processes.varying:
            return parameters
        out = dict(parameters)
        time = self.observation.time
        for process in processes.varying:
            assert process.parameter is not None
            nodes = parameters[process.name]
            out[process.parameter] = out[process.parameter] + process.error(nodes, time)
        return out

    def residual(
        self, motion: Motion, parameters: Mapping[str, Array], processes: Processes
    ) -> Array:
        """Return predicted - measured, (M, d), correlated errors included in what is predicted."""
        values = self.values(parameters, processes)
        out = self.observation.residual(motion, values)
        if processes.added is not None:
            nodes = parameters[processes.added.name]
            out = processes.added.with_error(out, nodes, self.observation.time)
        return out

    def linearized(
        self,
        motion: Motion,
        parameters: Mapping[str, Array],
        wanted: Sequence[str],
        processes: Processes,
    ) -> Linearization:
        """Return the observation linearised by motion and parameters, without its processes."""
        names = {*wanted, *(p.parameter for p in processes.varying if p.parameter)}
        values = self.values(parameters, processes)
        return linearized(
            self.observation,
            motion,
            values,
            names,
            self.clock_zero,
            self.chain.clock,
            self.chain.attitude_clock,
        )

    def jacobian(
        self,
        lin: Linearization,
        some: slice | IntArray,
        motion: Motion,
        states: Any,
        parameters: Mapping[str, Array],
        wanted: Sequence[str],
        processes: Processes,
        transitions: dict[Hashable, Any],
    ) -> tuple[Array, Array]:
        """Return the whitened Jacobian (M, d, n) and residual (M, d) of some measurements.

        Columns: variables of the chain, nodes of processes before and after, parameters.

        Parameters
        ----------
        lin : Linearization
            Linearisation of all measurements.
        some : slice or ndarray of int
            Which of them.
        motion, states, parameters : Motion or object or mapping of str to ndarray
            Where it was linearised.
        wanted : sequence of str
            Names of the parameters.
        processes : Processes
            Processes that the observation depends on.
        transitions : dict
            Transitions to times of a motion, by its identity and which times they are. They are
            kept for other observations.
        """
        lin, when = lin.some(some), self.observation.time[some]
        if motion.mean is not None:
            lin = by_motion_in_the_middle(lin, rows_of(motion.mean, some))
        at, errors = rows_of(self.attachment, some), self.errors
        by = None if errors is None else rows_of(errors.sensitivity(self.attachment), some)
        here = (
            id(motion),
            some.tobytes() if isinstance(some, np.ndarray) else (some.start, some.stop),
        )
        if here not in transitions:
            if errors is not None and by is not None:
                at = errors.without(at, by, errors.vector(parameters))
            transitions[here] = self.chain.transition(at, states, rows_of(motion, some))
        transition = transitions[here]
        found = dict(lin.d_parameters)
        if errors is not None and by is not None:
            found |= errors.columns(lin, transition, by, errors.vector(parameters))
        by_chain = self.chain.node_jacobian(lin, transition)
        others = [found[name] for name in wanted]
        by_nodes = [
            each
            for process in processes.varying
            for each in process.through(found[process.parameter or ""], when)
        ]
        residual = lin.residual
        if processes.added is not None:
            process = processes.added
            nodes = parameters[process.name]
            gain = process.gain(nodes, when)[..., None]
            own = process.jacobians(residual, when)
            by_chain, others = gain * by_chain, [gain * each for each in others]
            by_nodes = [*own, *(gain * each for each in by_nodes)]
            residual = process.with_error(residual, nodes, when)
        full = np.concatenate([by_chain, *by_nodes, *others], axis=2)
        weight = self.weight[some]
        full *= weight[:, :, None]
        return full, weight * residual

    def nodes(self, processes: Processes) -> IntArray:
        """Return the nodes of each measurement: of the chain, and before in each process."""
        before = [p.place(self.observation.time)[0] for p in processes.all]
        return np.column_stack([self.chain.nodes_at(self.attachment), *before])

    def keys_at(self, nodes: IntArray, processes: Processes, shared: Sequence[int]) -> IntArray:
        """Return the variables of measurements at nodes as of `nodes`, `shared` ones last."""
        of_chain = nodes.shape[1] - len(processes.all)
        out = [*self.chain.variables(nodes[:, :of_chain])]
        for process, before in zip(processes.all, nodes.T[of_chain:], strict=True):
            out += [process.key(0) + before, process.key(0) + before + 1]
        out += [np.full(len(nodes), key) for key in shared]
        return np.column_stack(out)

    def sizes(self, processes: Processes, parameters: Sequence[Parameter]) -> list[int]:
        """Return the dimensions of these variables."""
        of_processes = [p.size for p in processes.all for _ in range(2)]
        return [*self.chain.sizes, *of_processes, *(p.mean.size for p in parameters)]


def bound_to(
    chain: Chain,
    observation: Observation,
    parameters: Mapping[str, Array],
    clock_zero: float,
    usable: BoolArray | None,
    *,
    averages: bool,
) -> BoundObservation:
    """Return an observation tied to a chain, of which what the chain covers may be used.

    Parameters
    ----------
    chain, observation : Chain or Observation
        Both.
    parameters : mapping of str to ndarray
        Values at which it is tied.
    clock_zero : float, s
        Reference time of the clock offsets.
    usable : ndarray of bool, shape (M,), optional
        Which measurements may be used; by default all.
    averages : bool
        Whether the length of the window over which it averages is estimated.
    """
    time = time_on_chain(observation, parameters, clock_zero, chain.clock)
    covered = chain.covers(time) & covers_windows(chain, observation, time, parameters)
    if usable is not None:
        covered = covered & usable
    weight = np.repeat(covered.astype(float)[:, None], len(observation.components), axis=1)
    return BoundObservation(
        observation, chain, None, covered, weight, clock_zero, averages=averages
    )
