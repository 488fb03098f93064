"""What is assumed of a trial, its minimum, and the objective by which assumptions compare."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.chain import Chain
from factorgraph_dvl.graph.priors import ConstantsPrior, Tilt, local_coordinates
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.graph.processes import Process
from factorgraph_dvl.sensors.parameters import Parameter
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.solvers.levenberg_marquardt import (
    CONVERGED,
    Minimum,
    factorized,
    minimise,
    quickly_factorized,
)
from factorgraph_dvl.solvers.preparation import Prepared
from factorgraph_dvl.statistics.marginal_likelihood import constants_of, restricted_objective
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# Root mean square change of the positions, m, from which on gravity is taken anew. Chosen: 1 m
# turns it by 0.16 micro-g.
_SAME_GRAVITY = 2.0
# Promised fall of the cost that ends a minimisation after which the model changes anyway.
_ROUGHLY = 1e-2
# Times that gravity and weights are taken anew before a minimum is believed. Measured: one.
_REFERENCES = 4


@dataclass(frozen=True)
class Model:
    """What is assumed of a trial: what a step of the solver may change.

    Parameters
    ----------
    prepared : Prepared
        Chain, measurements and parameters that all models of the trial start from.
    chain : Chain
        Nodes, and what ties them.
    parameters : tuple of Parameter
        Calibration parameters, known ones included.
    reference : tuple of (object, dict of str to ndarray)
        States and parameters at which the weights of measurements are taken.
    track : ndarray, shape (K, 3), m
        Positions of the nodes in n at which gravity is taken.
    processes, stated_processes : tuple of Process
        Correlated errors, and those that the trial states.
    noise_factors : mapping of str to ndarray
        Factors (d,) of each label on stated standard deviations.
    noise_growth : mapping of str to ndarray
        Factors (2,) of each label on what of its noise is constant, and on what grows with speed.
    long_run : mapping of str to ndarray
        Factors (d,) of each label for noise that persists for some measurements.
    gain : float, default 0
        Fall of -2 log likelihood by that noise, against white noise.
    robust_weights : mapping of str to ndarray
        Weights of each label: 0 where a measurement is a gross error.
    rejected : mapping of str to ndarray
        Times of the measurements of each label beyond the gate of their sensor.
    tilt : Tilt, optional
        Gradient of the objective by the parameters that no residual has.
    constants_prior : ConstantsPrior, optional
        Joint prior of biases and parameters, in place of their own.
    clock_zero : float, optional
        Reference time of the clock offsets, s.
    """

    prepared: Prepared
    chain: Chain
    parameters: tuple[Parameter, ...]
    reference: tuple[Any, dict[str, Array]]
    track: Array
    processes: tuple[Process, ...] = ()
    stated_processes: tuple[Process, ...] = ()
    noise_factors: Mapping[str, Array] = field(default_factory=dict)
    noise_growth: Mapping[str, Array] = field(default_factory=dict)
    long_run: Mapping[str, Array] = field(default_factory=dict)
    gain: float = 0.0
    robust_weights: Mapping[str, Array] = field(default_factory=dict)
    rejected: Mapping[str, Array] = field(default_factory=dict)
    tilt: Tilt | None = None
    constants_prior: ConstantsPrior | None = None
    clock_zero: float | None = None

    def as_stated(self) -> Model:
        """Return it with nothing found of noise and gross errors."""
        return replace(
            self,
            processes=self.stated_processes,
            noise_factors={label: np.ones(f.size) for label, f in self.noise_factors.items()},
            noise_growth={},
            long_run={},
            gain=0.0,
            robust_weights={},
        )

    def is_laid_out_as(self, other: Model) -> bool:
        """Whether one problem serves both: they differ in weights and strengths of processes."""
        nodes, others = (
            [(p.label, p.index, p.walk, p.parameter, p.time.tobytes()) for p in each.processes]
            for each in (self, other)
        )
        return (
            self.chain is other.chain
            and self.parameters is other.parameters
            and self.rejected is other.rejected
            and self.tilt is other.tilt
            and nodes == others
        )

    def applied(self, problem: Problem) -> None:
        """Make a problem that is laid out as this model have its weights."""
        problem.processes = self.processes
        problem.noise_factors, problem.noise_growth = self.noise_factors, self.noise_growth
        problem.long_run, problem.gain = self.long_run, self.gain
        problem.robust_weights = self.robust_weights
        states, values = self.reference
        at = problem.values(states, problem.prior_values() | values)
        problem.weigh(problem.evaluate(at))

    def is_applied(self, problem: Problem) -> bool:
        """Whether a problem has the weights of this model."""
        return (
            problem.processes is self.processes
            and problem.noise_factors is self.noise_factors
            and problem.noise_growth is self.noise_growth
            and problem.long_run is self.long_run
            and problem.robust_weights is self.robust_weights
        )

    def problem(self, values: dict[str, Array]) -> Problem:
        """Return its problem, near some values of the parameters."""
        out = Problem(
            self.chain,
            self.prepared.observations,
            self.parameters,
            start=values,
            constants_prior=self.constants_prior,
            clock_zero=self.clock_zero,
            processes=self.processes,
            tilt=self.tilt,
        )
        out.reject(self.rejected)
        self.applied(out)
        return out


@dataclass(frozen=True)
class Estimated:
    """A model at its minimum.

    Parameters
    ----------
    model : Model
        What is assumed.
    problem : Problem
        Its problem.
    minimum : Minimum
        Where the minimisation ended; its square-root information is that of the objective.
    objective : float
        -2 log of the restricted likelihood there.
    rough : bool
        Whether the minimisation ended early, as another one follows.
    """

    model: Model
    problem: Problem
    minimum: Minimum
    objective: float
    rough: bool = False

    @property
    def states(self) -> Any:
        """Of the nodes."""
        return self.minimum.evaluation.states

    @property
    def values(self) -> dict[str, Array]:
        """Of all parameters, by name."""
        return self.minimum.evaluation.parameters

    def moved_from(self, before: Estimated) -> float:
        """Return the largest move of a component that both estimate, in standard deviations."""
        known = {p.name for p in before.problem.parameters}
        own = [p for p in self.problem.parameters if p.name in known]
        if not own:
            return 0.0
        moved = np.concatenate(
            [local_coordinates(p, self.values[p.name], before.values[p.name]) for p in own]
        )
        return float(np.abs(moved / self._sigma([p.name for p in own])).max())

    def _sigma(self, names: Sequence[str]) -> Array:
        """Return the standard deviations of some parameters, side by side, SI."""
        sizes = [p.mean.size for name in names for p in self.problem.parameters if p.name == name]
        columns = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
        wanted = {self.problem.key(n): own for n, own in zip(names, columns, strict=True)}
        return np.sqrt(np.diag(self.minimum.information.covariance_of([wanted])))


def minimised(
    model: Model,
    states: Any,
    values: dict[str, Array],
    report: Progress,
    *,
    before: Estimated | None = None,
    rough: bool = False,
) -> tuple[Model, Problem, Minimum]:
    """Return a model at its minimum, its problem and the minimum.

    Gravity and weights are those of the model, so that the objective compares with that of others;
    where the minimum is far from where they were taken, they are taken there, if it is one.

    Parameters
    ----------
    model : Model
        What is assumed.
    states : object
        Where to start, as the chain has it.
    values : dict of str to ndarray
        Parameters to start from.
    report : callable
        Called with stage, iteration and cost.
    before : Estimated, optional
        Another model's, whose problem serves this one where it is laid out alike.
    rough : bool, default False
        Whether the minimisation may end early, as another one follows.
    """
    problem = None
    if before is not None and model.is_laid_out_as(before.model):
        problem = before.problem
        model.applied(problem)
    elif before is not None:
        # Its factors take as much memory as those of the next one.
        before.problem.release()
    iterations = 0
    for _ in range(_REFERENCES):
        problem = problem or model.problem(values)
        minimum = minimise(
            problem,
            problem.values(states, problem.prior_values() | values),
            stage="all sensors",
            progress=report,
            weighed=True,
            proven=not (rough or model.chain.interpolates),
            tolerance=_ROUGHLY if rough else CONVERGED,
        )
        iterations += minimum.iterations
        states, values = minimum.evaluation.states, minimum.evaluation.parameters
        moved = float(np.sqrt(np.mean((states.p_n - model.track) ** 2)))
        heavier = not model.chain.interpolates and moved > _SAME_GRAVITY
        lighter = problem.needs_reweighting(minimum.evaluation)
        if not (minimum.converged and (heavier or lighter)):
            break
        last, problem = problem, None
        if heavier:
            model = replace(model, chain=model.prepared.chain(states), track=states.p_n)
        model = replace(model, reference=(states, values))
    return model, problem or last, replace(minimum, iterations=iterations)


def estimated(
    model: Model,
    states: Any,
    values: dict[str, Array],
    report: Progress,
    *,
    before: Estimated | None = None,
    rough: bool = False,
) -> Estimated:
    """Return a model at its minimum, with its objective; arguments are those of `minimised`."""
    found = minimised(model, states, values, report, before=before, rough=rough)
    return with_objective(*found, rough=rough)


def with_objective(
    model: Model, problem: Problem, minimum: Minimum, *, rough: bool = False
) -> Estimated:
    """Return a minimum with its objective, and the square-root information that this is from.

    Parameters
    ----------
    model : Model
        What is assumed.
    problem : Problem
        Its problem.
    minimum : Minimum
        Where the minimisation ended.
    rough : bool, default False
        Whether it ended early, as another one follows.
    """
    evaluation, information = minimum.evaluation, minimum.square_root
    if problem.chain.interpolates:
        # Where constants are at a maximum of their likelihood, the cost has none.
        evaluation = problem.weighed(problem.without_tilt(evaluation))
        factorize = partial(quickly_factorized, rough=rough)
        information = _without_tilt(problem, evaluation, factorize)
        model = replace(model, reference=(evaluation.states, evaluation.parameters))
    elif information is None:
        information = factorized(problem, evaluation)[0]
    objective = restricted_objective(problem, evaluation, information)
    if not minimum.converged:
        # What the linear model promises is not there yet.
        objective += 2.0 * information.given(constants_of(problem)).decrease
    minimum = replace(minimum, square_root=information)
    return Estimated(model, problem, minimum, objective, rough)


def least_objective(model: Model, states: Any, values: dict[str, Array]) -> float:
    """Return what the objective of a model would be if measurements left no residual.

    No minimum of it is lower, but for what the volume of the states changes on the way there.

    Parameters
    ----------
    model : Model
        What is assumed.
    states, values : object and dict of str to ndarray
        Where its minimisation would start.
    """
    problem, start = _at_start(model, states, values)
    there = Minimum(problem.weighed(start), None, converged=True, iterations=0)
    at = with_objective(model, problem, there, rough=True)
    problem.release()
    decrease = at.minimum.information.given(constants_of(problem)).decrease
    return at.objective - 2.0 * (at.minimum.evaluation.cost - decrease)


def linear_objective(model: Model, states: Any, values: dict[str, Array]) -> float:
    """Return the objective at the minimum of the linear model where a minimisation would start.

    Parameters are those of `least_objective`.
    """
    problem, there = _at_start(model, states, values)
    information, _ = quickly_factorized(problem, there, rough=True)
    problem.release()
    of_constants = information.decrease - information.given(constants_of(problem)).decrease
    return restricted_objective(problem, there, information) - 2.0 * of_constants


def _at_start(model: Model, states: Any, values: dict[str, Array]) -> tuple[Problem, Evaluation]:
    """Return the problem of a model, and its evaluation where its minimisation would start."""
    problem = model.problem(values)
    return problem, problem.evaluate(problem.values(states, problem.prior_values() | values))


def with_all_digits(at: Estimated) -> Minimum:
    """Return the minimum with square-root information from QR, for its standard deviations."""
    minimum = at.minimum
    if not at.problem.chain.interpolates:
        return minimum
    return replace(minimum, square_root=_without_tilt(at.problem, minimum.evaluation, factorized))


def _without_tilt(
    problem: Problem,
    evaluation: Evaluation,
    factorize: Callable[[Problem, Evaluation], tuple[SquareRootInformation, gtsam.VectorValues]],
) -> SquareRootInformation:
    """Return the square-root information of the residuals alone."""
    tilt, problem.tilt = problem.tilt, None
    information = factorize(problem, evaluation)[0]
    problem.tilt = tilt
    return information
