"""Arcs of the IMU's record seen from their start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array, IntArray, rotate
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import Attachment, attach


@dataclass(frozen=True)
class DeadReckonedSpan:
    """An arc seen from its start: body axes there, and n at that moment, kept in space.

    `turn`, `speed`, `place` are rotation, velocity and displacement by the specific force
    alone, at the nodes; `gravity1`, `gravity2` the first and second integral of gravity;
    `gravity` its value in space along the segments.
    """

    segments: Segments
    earth_rate: Array
    nodes: IntArray
    since: Array
    turn: Array
    speed: Array
    place: Array
    gravity: Array
    gravity1: Array
    gravity2: Array

    @property
    def start(self) -> float:
        """Time of the start, s."""
        return float(self.segments.node_time[self.nodes[0]])

    def covers(self, time: Array) -> np.ndarray:
        """Return whether times (M,) lie within the arc."""
        inside = (time >= self.start) & (time <= self.start + self.since[-1])
        return inside & self.segments.increments.locate(time)[2]

    def carry(self, time: Array) -> tuple[Attachment, Array, Array, Array]:
        """Return attachment, and rotation, velocity, displacement in the start's body axes."""
        at = attach(self.segments, time, self.earth_rate)
        k = at.node - self.nodes[0]
        velocity = self.speed[k] + rotate(self.turn[k], at.dV)
        displacement = (
            self.place[k] + self.speed[k] * at.tau[:, None] + rotate(self.turn[k], at.dP)
        )
        return at, self.turn[k] @ at.dR, velocity, displacement

    def gravity_integrals(self, at: Attachment) -> tuple[Array, Array]:
        """Return the first and second integral of gravity, in space."""
        k = at.node - self.nodes[0]
        tau = at.tau[:, None]
        g = self.gravity[k]
        return (
            self.gravity1[k] + g * tau,
            self.gravity2[k] + self.gravity1[k] * tau + g * (tau**2 / 2.0),
        )

    def to_space(self, time: Array) -> Array:
        """Return the rotations from n to n at the start, kept in space."""
        return exp_so3((time - self.start)[:, None] * self.earth_rate)


def arc_from_start(seg: Segments, a: int, frame: LocalFrame, p_n: Array) -> DeadReckonedSpan:
    """Return arc `a`, with gravity at rough positions p_n (K, 3) of the nodes."""
    first, last = seg.arc_nodes[a]
    nodes = np.arange(first, last + 1)
    mine = np.flatnonzero((seg.origin >= first) & (seg.origin < last))
    dR, dV, dP = (x[mine] for x in seg.totals())
    step = seg.duration[mine]
    since = seg.node_time[nodes] - seg.node_time[first]
    rate = frame.earth_rate
    middle = 0.5 * (p_n[nodes[:-1]] + p_n[nodes[1:]])
    halfway = since[:-1] + step / 2.0
    gravity = rotate(exp_so3(halfway[:, None] * rate), frame.gravity_without_rotation(middle))
    m = nodes.size
    turn = np.tile(np.eye(3), (m, 1, 1))
    speed, place, gravity1, gravity2 = (np.zeros((m, 3)) for _ in range(4))
    for j in range(m - 1):
        turn[j + 1] = turn[j] @ dR[j]
        place[j + 1] = place[j] + speed[j] * step[j] + turn[j] @ dP[j]
        speed[j + 1] = speed[j] + turn[j] @ dV[j]
        gravity2[j + 1] = gravity2[j] + gravity1[j] * step[j] + gravity[j] * step[j] ** 2 / 2.0
        gravity1[j + 1] = gravity1[j] + gravity[j] * step[j]
    gravity = np.concatenate([gravity, gravity[-1:]])
    return DeadReckonedSpan(
        seg, rate, nodes, since, turn, speed, place, gravity, gravity1, gravity2
    )
