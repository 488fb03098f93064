"""From a trial to where its minimisation starts: segments, states, values of the mountings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import msgspec

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.inertial_chain import InertialChain, inertial_chain
from factorgraph_dvl.graph.priors import Tilt
from factorgraph_dvl.graph.problem import Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.imu.increments import increments
from factorgraph_dvl.imu.noise import with_recorded_noise
from factorgraph_dvl.imu.preintegration import Segments, segments
from factorgraph_dvl.imu.propagation import States
from factorgraph_dvl.imu.timestamps import without_restarted_clock
from factorgraph_dvl.imu.vibration import without_vibration
from factorgraph_dvl.initialization.in_motion_alignment import initial_states
from factorgraph_dvl.initialization.mountings import mounted_aids, mountings_from_motion, strays
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.star_catalogue import star_catalogue_findings
from factorgraph_dvl.sensors.clock import on_shared_clocks
from factorgraph_dvl.sensors.imu import ImuSettings
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.sensors.protocol import Observation, observed
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.levenberg_marquardt import Minimum, minimise
from factorgraph_dvl.solvers.motion_strengths import Strengths
from factorgraph_dvl.solvers.outliers import robust_weights
from factorgraph_dvl.solvers.position_from_ranges import StartPositions, positions_from_ranges
from factorgraph_dvl.solvers.state_times import dense_epochs
from factorgraph_dvl.trial import Trial

# The stage without the DVL only finds its mounting: it ends where the cost falls by less than
# this, or after so many steps. Chosen: the next stage goes on from there.
ROUGH_TOLERANCE = 1.0
_ROUGH_ITERATIONS = 10
# Square of a residual, in the mean and in variances, at which it ends too. Chosen: what is left is
# less than the noise.
_ROUGHLY_NOISE = 1.5
# Square of a residual, in the mean and in variances, above which gross errors are searched before
# the mounting is. Measured: three jumps of 10 m for 30 s make 3, and led the mounting beside a
# MEMS IMU to a clock that is off by half a period of the sway; noise as stated makes 1.
_GROSS = 2.0


class Prepared(Protocol):
    """What every minimisation of a trial starts from, whatever its chain."""

    @property
    def trial(self) -> Trial:
        """The trial."""

    @property
    def observations(self) -> tuple[Observation, ...]:
        """Measurements of all sensors."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Calibration parameters of all sensors, fixed ones included."""

    @property
    def estimated_noise(self) -> frozenset[str]:
        """Labels of the observations whose stated noise is only where to start."""

    @property
    def noise_factors(self) -> Mapping[str, Array]:
        """By label, factors (d,) on stated noise to start from, where they are known."""

    @property
    def start_positions(self) -> StartPositions:
        """States to start from, one set for each position that the records allow."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the user must know."""

    @property
    def rejected(self) -> Mapping[str, Array]:
        """Times of measurements that are left out from the start, by label."""

    def chain(self, states: Any) -> Chain:
        """Return the nodes of some states, and what ties them."""

    def start(self, chain: Any, states: Any, report: Progress) -> MountedStart:
        """Return where the minimisation with all sensors starts."""

    def stated_processes(
        self, chain: Any, states: Any, values: Mapping[str, Array]
    ) -> tuple[Process, ...]:
        """Return the processes that are in the problem from the start."""

    def first_tilt(self, values: Mapping[str, Array]) -> Tilt | None:
        """Return the gradient of the states' volume by the constants to start from."""

    def strengths(self, problem: Problem, minimum: Minimum) -> Strengths | None:
        """Return the strengths of the motion's prior, None where the chain has none."""


@dataclass(frozen=True)
class Preparation:
    """What every minimisation of a trial starts from.

    Parameters
    ----------
    trial : Trial
        The trial, without rows of impossible times, reference and truth.
    frame : LocalFrame
        Tangent frame n.
    segments : Segments
        Increments of the IMU between the nodes.
    observations : tuple of Observation
        Measurements of all sensors.
    parameters : tuple of Parameter
        Calibration parameters of all sensors, fixed ones included.
    estimated_noise : frozenset of str
        Labels of the observations whose stated noise is only where to start.
    start_positions : StartPositions
        States to start from, one set for each position that the ranges allow.
    mountings : dict of str to ndarray
        Mountings of attitude sensors found by the gyros, by parameter name.
    stated_imu : ImuSettings
        Settings of the IMU as the trial states them.
    findings : tuple of Finding
        What the user must know.
    """

    trial: Trial
    frame: LocalFrame
    segments: Segments
    observations: tuple[Observation, ...]
    parameters: tuple[Parameter, ...]
    estimated_noise: frozenset[str]
    start_positions: StartPositions
    mountings: dict[str, Array]
    stated_imu: ImuSettings
    findings: tuple[Finding, ...]

    @property
    def rejected(self) -> Mapping[str, Array]:
        """Times of measurements that are left out from the start, by label."""
        return self.start_positions.rejected

    @property
    def noise_factors(self) -> Mapping[str, Array]:
        """Return none: noise starts as stated."""
        return {}

    def start(self, chain: InertialChain, states: States, report: Progress) -> MountedStart:
        """Return where the minimisation with all sensors starts."""
        return mounted_start(self, chain, states, report)

    def stated_processes(
        self, chain: InertialChain, states: States, values: Mapping[str, Array]
    ) -> tuple[Process, ...]:
        """Return none: noise is white until residuals show another one."""
        return ()

    def first_tilt(self, values: Mapping[str, Array]) -> None:
        """Return None: the volume of the states hardly depends on the constants."""

    def strengths(self, problem: Problem, minimum: Minimum) -> None:
        """Return None: the IMU ties the nodes."""

    def chain(self, states: States) -> InertialChain:
        """Return the inertial part of the graph, with gravity along the track of states."""
        return inertial_chain(self.trial, self.frame, self.segments, states)

    def with_imu(self, **keys: float) -> Preparation:
        """Return it with keys of the IMU as if they were stated."""
        imu = self.trial.inertial
        settings = msgspec.structs.replace(imu.settings, **keys)
        return replace(self, trial=replace(self.trial, imu=replace(imu, settings=settings)))

    def mountings_at(self, chain: InertialChain, states: States) -> list[dict[str, Array]]:
        """Return values of the mountings that fit the motion of states, the best first."""
        return mountings_from_motion(
            self.trial, self.frame, self.segments, chain.gravity_n, states
        )


def prepare(trial: Trial, state_interval_s: float, report: Progress) -> Preparation:
    """Return segments, start states and measurements of a trial.

    Parameters
    ----------
    trial : Trial
        The trial as it was recorded.
    state_interval_s : float
        Time between the states of the graph, s.
    report : callable
        Called with stage, iteration and cost.

    Raises
    ------
    DataError
        If the records do not determine where and how the trial starts.
    """
    # What the result is compared with has no part in it.
    trial = replace(without_restarted_clock(trial), reference=None, calibration_truth={})
    imu = trial.inertial
    if trial.estimates_noise(imu):
        imu = with_recorded_noise(imu)
    stated, trial = trial.inertial.settings, replace(trial, imu=without_vibration(imu))
    frame = trial.frame()
    report("increments", 0, None)
    inc, gaps = increments(trial.inertial)
    seg = segments(inc, state_interval_s, dense_epochs(trial, frame, state_interval_s))
    report("alignment", 0, None)
    # A USBL is a position like any other to start from.
    on_one_clock = trial.on_one_clock().with_fixes()
    start = initial_states(on_one_clock, frame, seg)
    if trial.beacons is not None:
        report("ranges", 0, None)
    start_positions = positions_from_ranges(on_one_clock, frame, seg, start.states)
    by_aid = [(aid, *observed([aid], frame, trial.body_axes)) for aid in trial.aids]
    return Preparation(
        trial=trial,
        frame=frame,
        segments=seg,
        observations=tuple(o for _, observations, _ in by_aid for o in observations),
        parameters=(
            *on_shared_clocks((p for _, _, own in by_aid for p in own), trial.aids),
            *trial.inertial.error_parameters(),
        ),
        estimated_noise=frozenset(
            o.label
            for aid, observations, _ in by_aid
            if trial.estimates_noise(aid)
            for o in observations
        ),
        start_positions=start_positions,
        mountings=start.mountings,
        stated_imu=stated,
        findings=(
            *trial.notes,
            *gaps,
            *start.findings,
            *star_catalogue_findings(trial.aids),
            *start_positions.findings,
        ),
    )


@dataclass(frozen=True)
class MountedStart:
    """Where the minimisation with all sensors starts.

    Parameters
    ----------
    states : object
        Motion of the nodes, as their chain has it.
    values : dict of str to ndarray
        Parameters that fit it.
    robust_weights : dict of str to ndarray
        Weights of measurements that are gross errors there, 0 or 1, by label.
    iterations : int
        Iterations that it took.
    """

    states: Any
    values: dict[str, Array]
    robust_weights: dict[str, Array]
    iterations: int


def mounted_start(
    prepared: Preparation, chain: InertialChain, states: States, report: Progress
) -> MountedStart:
    """Return states, and values of the parameters that fit them.

    GNSS and IMU alone smooth the motion first, unless the DVL is calibrated: such a one does
    no harm from the start. Fixes that the states were made without have no part in it: they would
    lead to where no other fix is. Afterwards all count, for the search for gross errors.
    """
    iterations = 0
    values = prepared.mountings
    gross = strays(prepared.trial)
    aids = mounted_aids(prepared.trial, prepared.mountings)
    if aids is not None:
        observations, parameters = observed(aids, prepared.frame, prepared.trial.body_axes)
        # In sway, errors of the IMU's axes look like a late clock.
        parameters = (*parameters, *prepared.trial.inertial.error_parameters())
        problem = Problem(chain, observations, parameters, start=prepared.mountings)
        problem.robust_weights = gross
        coarse = minimise(
            problem,
            problem.values(states, problem.prior_values() | prepared.mountings),
            stage="inertial and GNSS",
            progress=report,
            max_iterations=_ROUGH_ITERATIONS,
            tolerance=ROUGH_TOLERANCE,
            proven=False,
            enough=_ROUGHLY_NOISE,
        )
        gross = problem.robust_weights = {}
        evaluation, iterations = problem.weighed(coarse.evaluation), coarse.iterations
        if 2.0 * evaluation.cost > _GROSS * problem.used_count:
            gross, evaluation = robust_weights(problem, evaluation) or (gross, evaluation)
        states = evaluation.states
        assert prepared.trial.positioning is not None
        found = evaluation.parameters
        values = values | {p.name: found[p.name] for p in prepared.trial.positioning.parameters()}
    report("mounting", 0, None)
    (best, *_) = prepared.mountings_at(chain, states)
    return MountedStart(states, values | best, gross, iterations)
