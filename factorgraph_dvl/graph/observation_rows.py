"""Some measurements of an observation, as an observation."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.geometry.records import rows_of
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.sensors.protocol import (
    ExpectedCorrelation,
    Linearization,
    Motion,
    Observation,
    ObservationByRows,
    ScaleWalk,
    SensorClock,
)


@dataclass(frozen=True)
class ObservationRows:
    """Some measurements of an observation, as an observation.

    Parameters
    ----------
    whole : Observation
        M measurements.
    index : ndarray of int, shape (K,)
        Which of them.
    """

    whole: Observation
    index: IntArray

    @property
    def label(self) -> str:
        """Name of the measurement, for people."""
        return self.whole.label

    @property
    def unit(self) -> str:
        """Unit of the residual."""
        return self.whole.unit

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the d components."""
        return self.whole.components

    @property
    def time(self) -> Array:
        """Times as in the record, (K,), s."""
        return self.whole.time[self.index]

    @property
    def averaging(self) -> str | None:
        """Name of the length of the window over which it averages."""
        return self.whole.averaging

    @property
    def averages_in_body(self) -> bool:
        """Whether its mean is that of velocities in body axes."""
        return self.whole.averages_in_body

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the calibration parameters that it depends on."""
        return self.whole.parameters

    @property
    def gate(self) -> float | None:
        """Standard deviations from which on a measurement is an echo."""
        return self.whole.gate

    @property
    def noise_groups(self) -> tuple[tuple[int, ...], ...]:
        """Components that share a factor on their stated standard deviation."""
        return self.whole.noise_groups

    @property
    def correlated(self) -> ExpectedCorrelation | None:
        """The prior of noise that persists."""
        return self.whole.correlated

    @property
    def scale_walk(self) -> ScaleWalk | None:
        """How its scale walks."""
        return self.whole.scale_walk

    @property
    def noise_by_speed(self) -> tuple[float, float] | None:
        """Standard deviation that is constant, m/s, and what grows, over the speed."""
        return self.whole.noise_by_speed

    @property
    def independent(self) -> bool:
        """Whether components are measured apart."""
        return self.whole.independent

    @property
    def clock(self) -> SensorClock | None:
        """Clock of the sensor."""
        return self.whole.clock

    def sigma(
        self, motion: Motion, values: Mapping[str, Array], factor: Array | float = 1.0
    ) -> Array:
        """Return the standard deviations, (K, d)."""
        whole = self.whole.sigma(self._embedded(motion), values, factor)
        return np.asarray(whole[self.index])

    def residual(self, motion: Motion, values: Mapping[str, Array]) -> Array:
        """Return predicted - measured, (K, d)."""
        return self.whole.residual(self._embedded(motion), values)[self.index]

    def linearize(
        self, motion: Motion, values: Mapping[str, Array], wanted: Collection[str]
    ) -> Linearization:
        """Return the residual and its Jacobians."""
        return self.whole.linearize(self._embedded(motion), values, wanted).some(self.index)

    def _embedded(self, motion: Motion) -> Motion:
        """Return a motion at all M times: what the others see does not matter."""
        source = np.zeros(self.whole.time.size, dtype=int)
        source[self.index] = np.arange(self.index.size)
        return rows_of(motion, source)


def some_of(observation: Observation, index: IntArray) -> Observation:
    """Return some measurements of an observation, (K,), taken apart where it can be."""
    if isinstance(observation, ObservationByRows):
        return observation.some(index)
    return ObservationRows(observation, index)
