"""The first position of a trial from the ranges to beacons.

Alignment leaves a dead-reckoned track without a position. Solved with the ranges as a planar
problem, it gives all tracks that they allow and the ranges that are outliers. Where the position
is known, only the latter are of use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorgraph_dvl.estimates import Hypothesis
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.planar_chain import PlanarChain
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.ranging.dead_reckoning import as_planar
from factorgraph_dvl.solvers.hypotheses import follow, reported, schedule
from factorgraph_dvl.solvers.planar_setup import PlanarSetup, Track, planar_setup
from factorgraph_dvl.trial import InitialPosition, Trial

# Share of rejected ranges from which on the track is followed. Chosen: so many are no echoes.
_MANY = 1.0 / 3.0
# Chosen: standard deviation of a first fix of GNSS, m, that of a single fix without corrections.
_FIX = 10.0


@dataclass(frozen=True)
class StartPositions:
    """Possible first positions of a trial.

    Parameters
    ----------
    states : tuple of object
        Motion of the nodes, as their chain has it, of each living hypothesis, most probable first;
        at least one.
    hypotheses : tuple of Hypothesis, optional
        The living ones, in the same order, then the dead; empty if a position is known.
    rejected : mapping of str to ndarray, optional
        Times of the outliers, by label.
    findings : tuple of Finding, optional
        What the user must know.
    """

    states: tuple[Any, ...]
    hypotheses: tuple[Hypothesis, ...] = ()
    rejected: Mapping[str, Array] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


def positions_from_ranges(
    trial: Trial, frame: LocalFrame, seg: Segments, states: States
) -> StartPositions:
    """Return states that fit the ranges.

    Parameters
    ----------
    trial : Trial
        Trial with a record of ranges, or with a known position.
    frame : LocalFrame
        Tangent frame of the trial.
    seg : Segments
        Preintegrated segments of the IMU.
    states : States
        States from alignment; without a known position, from an arbitrary one.

    Raises
    ------
    DataError
        If there is no range while the IMU runs, and nothing else to begin with.
    """
    beacons = trial.beacons
    if beacons is None:
        return StartPositions((states,))
    # A first fix or a stated position is where the track already starts.
    first = trial.initial_position
    if first is None and trial.gnss is not None:
        geodetic = np.array(frame.geodetic(states.p_n[0]))
        first = InitialPosition(geodetic, np.full(3, _FIX))
    heard = beacons.time[~beacons.missing]
    if first is not None and not np.any(
        (heard >= seg.node_time[0]) & (heard <= seg.node_time[-1])
    ):
        return StartPositions((states,))
    reckoned = as_planar(trial, frame, seg.node_time, states.nRb, states.p_n, states.v_n, first)
    setup = planar_setup(reckoned, frame)
    updates, searches = schedule(setup)
    if trial.gnss is not None:
        return StartPositions((states,), rejected=_outliers(setup, updates))
    found = follow(setup, updates, searches)
    living = [h for h in found if h.died is None]
    if not living:
        few = Finding(Code.FEW_RANGES, message("few_ranges.too_few"))
        return StartPositions((states,), findings=(few,))
    return StartPositions(
        tuple(_moved(setup, h.fit, states, seg.node_time) for h in living),
        tuple(map(reported, found)),
        living[0].fit.problem.rejected,
    )


def _outliers(setup: PlanarSetup, updates: Sequence[int]) -> Mapping[str, Array]:
    """Return times of outliers, by label, on the only track that starts where GNSS says."""
    # Where dead reckoning is good, one fit of all data finds them; else the track is followed.
    for steps in (updates[-1:], updates):
        found = follow(setup, steps, ())[0].fit
        rejected = found.problem.rejected
        count = sum(o.time.size for o in setup.observations if o.gate is not None)
        if found.converged and sum(t.size for t in rejected.values()) < _MANY * count:
            break
    return rejected


def _moved(setup: PlanarSetup, found: Track, states: States, time: Array) -> States:
    """Return states on a track, turned by its error of the heading."""
    chain = found.problem.chain
    assert isinstance(chain, PlanarChain)
    motion = chain.motion(chain.attach(time), found.evaluation.states)
    turn = exp_so3(np.array([0.0, 0.0, found.values[setup.track.heading_bias][0]]))
    v_n = motion.v_n.copy()
    v_n[:, 2] = states.v_n[:, 2]
    return States(turn @ states.nRb, motion.p_n, v_n, states.gyro_bias, states.accel_bias)
