"""From a planar trial to where its minimisation starts: every track that the ranges allow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.planar_chain import PlanarChain, PlanarStates
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Observation
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.hypotheses import follow, reported, schedule
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum
from factorgraph_dvl.solvers.planar_setup import PlanarSetup, Track, planar_setup
from factorgraph_dvl.solvers.position_from_ranges import StartPositions
from factorgraph_dvl.solvers.preparation import MountedStart
from factorgraph_dvl.trial import Trial


@dataclass(frozen=True)
class PlanarStart(PlanarStates):
    """States of a track, with the constants that go with it.

    Parameters
    ----------
    constants : dict of str to ndarray
        Values by name.
    """

    constants: dict[str, Array]


@dataclass(frozen=True)
class PlanarPreparation:
    """What every minimisation of a planar trial starts from.

    Parameters
    ----------
    setup : PlanarSetup
        Chain and measurements.
    start_positions : StartPositions
        States to start from, one set for each track that the ranges allow.
    """

    setup: PlanarSetup
    start_positions: StartPositions

    @property
    def trial(self) -> Trial:
        """The trial."""
        return self.setup.trial

    @property
    def observations(self) -> tuple[Observation, ...]:
        """Of log and beacons."""
        return self.setup.observations

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Constants of all sensors, fixed ones included."""
        return self.setup.parameters

    @property
    def estimated_noise(self) -> frozenset[str]:
        """None: the noise is as stated."""
        return frozenset()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the user must know."""
        return self.trial.notes

    @property
    def rejected(self) -> Mapping[str, Array]:
        """Times of echoes, by label."""
        return self.start_positions.rejected

    def chain(self, states: PlanarStates) -> PlanarChain:
        """Return the chain of the whole trial."""
        return self.setup.chain

    def start(self, chain: PlanarChain, states: PlanarStart, report: Progress) -> MountedStart:
        """Return the states, and the constants of their track."""
        return MountedStart(states, states.constants, {}, 0)

    def stated_processes(
        self, chain: PlanarChain, states: PlanarStates, values: Mapping[str, Array]
    ) -> tuple[Process, ...]:
        """Return none: the current is constant."""
        return ()

    @property
    def noise_factors(self) -> Mapping[str, Array]:
        """Return none: noise starts as stated."""
        return {}

    def first_tilt(self, values: Mapping[str, Array]) -> None:
        """Return None: the volume of the states does not depend on the constants."""

    def strengths(self, problem: Problem, minimum: Minimum) -> None:
        """Return None: how smooth the motion is, its records say."""


def prepare_planar(trial: Trial, report: Progress) -> PlanarPreparation:
    """Return the problem of a planar trial and all tracks that its ranges allow.

    Parameters
    ----------
    trial : Trial
        Trial with compass, log, depth and beacons.
    report : callable
        Called with stage, iteration and cost.

    Raises
    ------
    ConfigError, DataError
        If the trial cannot be solved as it is.
    SolveError
        If there are too few ranges to find a position.
    """
    report("dead reckoning", 0, None)
    setup = planar_setup(replace(trial, reference=None, calibration_truth={}), trial.frame())
    updates, searches = schedule(setup)
    found = follow(
        setup,
        updates,
        searches,
        lambda nodes, living: report(
            f"hypotheses {len(living)}",
            nodes,
            living[0].fit.evaluation.cost if living else None,
        ),
    )
    living = [h for h in found if h.died is None]
    if not living:
        count = int(np.isfinite(setup.rows.range).sum())
        raise SolveError(
            f"{count} {'range is' if count == 1 else 'ranges are'} too few to find a position",
            where=setup.track.beacons.source,
            hint="Give `initial.position` in trial.yaml, or a longer record",
        )
    start = StartPositions(
        tuple(_started(h.fit) for h in living),
        tuple(map(reported, found)) if len(found) > 1 else (),
        living[0].fit.problem.rejected,
    )
    return PlanarPreparation(setup, start)


def _started(found: Track) -> PlanarStart:
    states = found.evaluation.states
    return PlanarStart(
        states.time, states.x, states.nRb, states.p_n, states.v_n, dict(found.values)
    )
