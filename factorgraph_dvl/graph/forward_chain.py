"""The chain of an IMU where measurements are attached to the nodes before them alone.

The node after may be yet to come, or be no variable of a graph. What the noise of the IMU adds
since the node is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.imu_errors import ImuErrors
from factorgraph_dvl.graph.inertial_chain import InertialChain
from factorgraph_dvl.graph.node_jacobian import node_jacobian
from factorgraph_dvl.imu.propagation import (
    Attachment,
    States,
    Transition,
    attach_smoothly,
    later,
    motion_at,
)
from factorgraph_dvl.imu.sensitivity import Sensitivity, at_errors, by_errors, corrected
from factorgraph_dvl.sensors.imu import ERRORS
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Linearization, Motion


@dataclass(frozen=True)
class ForwardChain(InertialChain):
    """An inertial chain that carries the motion forward only."""

    @classmethod
    def of(cls, chain: InertialChain) -> ForwardChain:
        """Return a chain with the nodes and factors of another."""
        return cls(**{each.name: getattr(chain, each.name) for each in fields(chain)})

    @property
    def sizes(self) -> list[int]:
        """Dimensions of the variables of a measurement."""
        return super().sizes[:2]

    def attach(
        self,
        time: Array,
        shift: float = 0.0,
        window: float | None = None,
        *,
        of_attitude: bool = False,
    ) -> Any:
        """Return where times (M,) are attached; beyond the chain, to first order from its edge."""
        rate = self.frame.earth_rate
        at, beyond = attach_smoothly(self.segments, time, rate)
        return later(at, beyond, rate) if beyond.any() else at

    def missing(self, at: Any, lin: Linearization) -> None:
        """Return None: the noise since the node is left out."""
        return

    def motion(self, at: Any, states: States) -> Motion:
        """Return the motion at M attached times, carried from the nodes before."""
        return motion_at(at, states, self.gravity_n, self.frame.earth_rate)

    def transition(self, at: Any, states: States, motion: Motion) -> Any:
        """Return the derivatives of the motion at attached times by the nodes before."""
        return Transition(at, states, motion, self.frame.earth_rate)

    def node_jacobian(self, lin: Linearization, transition: Any) -> Array:
        """Return the derivative of residuals by state and bias at the nodes, (M, d, 15)."""
        return node_jacobian(lin, transition)

    def variables(self, nodes: IntArray) -> list[IntArray]:
        """Return the keys of the variables of measurements after nodes (M, 1), (M,) each."""
        return super().variables(nodes)[:2]

    def errors(
        self, parameters: Sequence[Parameter], key_of: Mapping[str, int]
    ) -> ForwardErrors | None:
        """Return the errors of the IMU among parameters; None if none is estimated."""
        own = [p for p in parameters if p.name in ERRORS]
        return ForwardErrors(self.segments, own, [key_of[p.name] for p in own]) if own else None


class ForwardErrors(ImuErrors):
    """Errors of the IMU where measurements are attached to the nodes before them alone."""

    def forward(self, at: Any) -> Attachment:
        """Return where times are attached to the nodes before."""
        return at

    def without(self, at: Any, by: Sensitivity, errors: Array) -> Any:
        """Return an attachment without the errors (n,), which move it by its sensitivity."""
        return corrected(at, by, self._elements, errors)

    def _every(self, lin: Linearization, transition: Any, by: Sensitivity, errors: Array) -> Array:
        return by_errors(lin, transition, at_errors(by, errors), self._elements)
