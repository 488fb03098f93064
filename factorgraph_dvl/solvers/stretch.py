"""A stretch of a long trial without IMU, solved first: where the minimisation of all of it starts.

Densities, noise and constants take five estimates from nothing, and two from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.graph.smooth_chain import SmoothChain
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.phases import STAYS, each_phase
from factorgraph_dvl.solvers.preparation_without_imu import (
    PreparationWithoutImu,
    prepare_without_imu,
)
from factorgraph_dvl.solvers.rounds import settle

# Length of the stretch, s, and how many of them a trial must have. Measured: an hour takes half
# the time so, and the stretch a quarter of that.
_LENGTH = 1200.0
_WORTH_IT = 2.5
# Gain of a strength from which on the stretch asks for another estimate: all of the trial follows.
_ROUGHLY = 3.0


def started_from_stretch(
    prepared: PreparationWithoutImu, report: Progress
) -> PreparationWithoutImu:
    """Return what starts from the solution of the stretch with the most turns; as it was if short.

    Parameters
    ----------
    prepared : PreparationWithoutImu
        Preparation of the whole trial.
    report : callable
        Called with stage, iteration and cost.
    """
    time = prepared.first_chain.node_time
    if time[-1] - time[0] < _WORTH_IT * _LENGTH:
        return prepared
    turns = np.concatenate([[0], np.cumsum(np.any(prepared.phase != STAYS, axis=1))])
    last = np.searchsorted(time, time + _LENGTH)
    inside = np.flatnonzero(last < time.size)
    first = int(inside[np.argmax(turns[last[inside]] - turns[inside])])
    trial = prepared.trial.until(time[last[first]], since=time[first])
    try:
        part = replace(prepare_without_imu(trial), least_gain=_ROUGHLY)
    except (ConfigError, DataError):
        # A sensor may be silent there.
        return prepared
    settled = settle(part, part.states, report, roughly=True)
    if not settled.settled or {p.name for p in part.parameters} != {
        p.name for p in prepared.parameters
    }:
        return prepared
    chain, found = prepared.first_chain, settled.problem
    assert isinstance(found.chain, SmoothChain)
    density = chain.density.copy()
    for kind, i, where in each_phase(part.phase):
        density[prepared.phase[:, i] == kind, i] = found.chain.density[where, i][0]
    values = settled.minimum.evaluation.parameters
    # Chains that are laid otherwise have objectives that do not compare: it is laid once.
    own = prepared.values | {p.name: values[p.name] for p in prepared.parameters}
    chain, states = prepared.laid_by(own, replace(chain, density=density), prepared.states)
    strengths = {process.name: process.sigma for process in found.processes}
    longer = (time[-1] - time[0]) / (time[last[first]] - time[first])
    tilt = found.tilt
    if tilt is not None:
        # The stretch may estimate others: what its length does not show.
        tilt = tilt.of(found.parameters, [p for p in prepared.parameters if p.estimated])
        tilt = replace(tilt, gradient=longer * tilt.gradient, origin=values, hold=None)
    return replace(
        prepared,
        first_chain=chain,
        states=states,
        values=own,
        processes=tuple(
            replace(p, sigma=strengths.get(p.name, p.sigma)) for p in prepared.processes
        ),
        tilt=tilt,
        noise_factors={
            label: factors
            for label, factors in found.noise_factors.items()
            if label in prepared.estimated_noise
        },
    )
