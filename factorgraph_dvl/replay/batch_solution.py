"""Batch solution of the records so far, and what a replay without IMU takes from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.estimates import Noise
from factorgraph_dvl.geometry.vectors import Array, IntArray
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.imu.attitude_record import AttitudeRecord
from factorgraph_dvl.sensors.attitude import Attitude, AttitudeAngles
from factorgraph_dvl.sensors.carried_point import PointPosition, PointVelocity
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Aid, Observation
from factorgraph_dvl.solvers.correlated_noise import noise_of
from factorgraph_dvl.solvers.preparation_without_imu import (
    PreparationWithoutImu,
    lasting_observations,
    node_clock,
    phases,
)
from factorgraph_dvl.trial import Trial

# Density of acceleration in turns, m²/s³, until the first one; chosen: that of ships.
_FIRST_TURNS = 1e-3
# What sensors measure whose noise is that of their record.
_Measured = AttitudeAngles | PointPosition | PointVelocity


@dataclass(frozen=True)
class BatchSolution:
    """What windows take from a batch solution of the records up to a time.

    Parameters
    ----------
    trial : Trial
        Records up to then.
    chain : SmoothChain
        Its nodes.
    parameters : tuple of Parameter
        All of them, those that are not estimated included.
    clock_zero : float, s
        When the offsets of clocks hold.
    noise_factors, long_run : mapping of str to ndarray
        As of the problem.
    noise : tuple of Noise
        The same, as it is reported.
    late : float, s
        Stamps of the attitude less times of the nodes where it started: phases of turns are by
        these.
    pings_late : float, s
        Stamps of pings less times of the nodes; zero where nodes have the clock of the pings.
    densities : ndarray, shape (3, 6)
        Densities of acceleration, by what the heading does: it stays, turns, or begins or ends to.
    tilt : ndarray, shape (P,), 1/s
        Gradient of the states' volume that every second adds.
    std : dict of str to ndarray
        By label, standard deviations (d,) of noise that sensors take from the whole record.
    labels : dict of str to set of str
        Labels of the measurements of each sensor, by its section.
    """

    trial: Trial
    chain: SmoothChain
    parameters: tuple[Parameter, ...]
    clock_zero: float
    noise_factors: Mapping[str, Array]
    long_run: Mapping[str, Array]
    noise: tuple[Noise, ...]
    late: float
    pings_late: float
    densities: Array
    tilt: Array
    std: dict[str, Array]
    labels: dict[str, set[str]]

    @classmethod
    def of(
        cls, prepared: PreparationWithoutImu, problem: Problem, duration: float
    ) -> BatchSolution:
        """Return what windows take from a minimum of records of some duration, s."""
        trial, chain = prepared.trial, problem.chain
        assert isinstance(chain, SmoothChain)
        assert trial.attitude is not None
        tilt = np.zeros(sum(p.mean.size for p in problem.parameters))
        if problem.tilt is not None:
            tilt = problem.tilt.gradient / duration
        start = problem.prior_values() | prepared.values
        lag = float(start[node_clock(trial, chain.frame)][0])
        late = float(start[trial.attitude.clock.offset.name][0])
        by_aid = [
            (aid, lasting_observations(aid, chain.frame, trial.body_axes, trial))
            for aid in trial.aids
        ]
        return cls(
            trial=trial,
            chain=chain,
            parameters=problem.all_parameters,
            clock_zero=problem.clock_zero,
            noise_factors=problem.noise_factors,
            long_run=problem.long_run,
            noise=noise_of(problem),
            late=late if chain.clock is None else late - lag,
            pings_late=lag if chain.clock is None else 0.0,
            densities=_densities(chain.density, prepared.phase),
            tilt=tilt,
            std={
                o.label: _typical(o.std)
                for aid, every in by_aid
                if isinstance(aid, Attitude | Ins)
                for o in every
                if isinstance(o, _Measured)
            },
            labels={aid.section: {o.label for o in every} for aid, every in by_aid},
        )

    def density(self, record: AttitudeRecord, time: Array) -> Array:
        """Return the densities of acceleration at times (M,) by the nodes' clock, (M, 6)."""
        return np.asarray(self.densities[phases(record, time + self.late)])

    def observations(self, aid: Aid) -> list[Observation]:
        """Return what some rows of a sensor measured, with the noise of the whole record."""
        out: list[Observation] = []
        axes = self.trial.body_axes
        for o in lasting_observations(aid, self.chain.frame, axes, self.trial):
            if not o.time.size:
                continue
            if isinstance(o, _Measured) and o.label in self.std:
                o = replace(o, std=o.std * (self.std[o.label] / _typical(o.std)))
            out.append(o)
        return out


def _densities(density: Array, phase: IntArray) -> Array:
    """Return the density (3, 6) of each phase from those of steps, (K - 1, 6) and (K - 1,).

    Where the vessel has not turned yet, another strength is assumed for that.
    """
    out: list[Array] = []
    for kind in range(3):
        own = density[phase == kind]
        if own.size:
            out.append(own[0])
        elif out:
            out.append(np.maximum(out[-1], np.repeat([0.0, _FIRST_TURNS], 3)))
        else:
            # It has turned from the beginning.
            out.append(density[np.argmin(phase)])
    return np.array(out)


def _typical(std: Array) -> Array:
    """Return the median standard deviation of each component of measurements (M, d)."""
    return np.array([np.median(own[np.isfinite(own)]) for own in std.T])
