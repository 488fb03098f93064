"""Levenberg-Marquardt over a problem, with GTSAM's elimination."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

import gtsam
import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.statistics.elimination import cholesky, eliminated, error_of_variance
from factorgraph_dvl.statistics.marginal_likelihood import every_constant
from factorgraph_dvl.statistics.square_root_information import SquareRootInformation

# A step is small when all of it together is this many standard deviations, squared and
# halved: the decrease of the cost that the linear model still promises. Chosen: 0.004 σ.
CONVERGED = 1e-5
# The same below which the next step is for QR to prove, and small if the cost falls as promised.
# Chosen: 0.014 σ.
_NEARLY = 1e-4
# Move of a constant up to which a minimum is reached where no step lowers the cost, in standard
# deviations, which nothing that is reported shows; and promised decrease, all together. Chosen.
_SAME = 0.05
_WITHIN = 0.5 * _SAME**2
_LITTLE = 0.005
# The same from which on the next step is from QR at once: it may be the last. Chosen: 0.14 σ.
_NEAR = 1e-2
# Sizes of a step that the linear model is trusted for, once it has failed: NavState
# (rad, m, m/s), and SI units in other variables. Chosen: where attitudes are nearly linear.
_TRUSTED_STATE = np.repeat([0.05, 5.0, 0.5], 3)
# Damping that a failed step begins with, and at which the search ends. Chosen: from hardly any
# to no step at all.
_FIRST_DAMPING = 1e-4
# Share of the promised decrease above which a step is damped less next time, and below which more
# (Marquardt's usual choice). In between the damping is right: along a direction that is hardly
# observable, each step with less damping goes too far.
_GOOD_GAIN = 0.75
_POOR_GAIN = 0.25
_MAX_DAMPING = 1e12
# Shares of a step at which its curvature is taken, and the largest bend relative to the step.
# Chosen after Transtrum and Sethna; measured: near a minimum the third order counts, which the
# whole step sees.
_PROBES = (0.1, 1.0)
_LARGEST_BEND = 0.375
# Earlier steps that show the curvature along them. Chosen: two clocks and a lever arm make up for
# each other.
_MEMORY = 3
# Share of what a step promises that is hardly any, and share of the step along which a cost whose
# slope jumps rises. Chosen: far below and above rounding.
_HARDLY, _AT_ONCE = 0.01, 0.01
# Standard deviation of a clock that stays where it is, s. Chosen: no clock is known as well.
_STAYS = 1e-8
# Relative error of a variance from which on its digits are from QR. Chosen: no σ shows 0.05 %.
_EXACT = 1e-3
# Relative error of a cost that sums up 1e5 squares. Chosen: above that of double precision.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Minimum:
    """Where the minimisation ended.

    Parameters
    ----------
    evaluation : Evaluation
        Evaluation at the last values.
    square_root : SquareRootInformation or None
        Square-root information from QR there, up to the last step, which was small if
        `converged`; None if no proof was asked for.
    converged : bool
        Whether the linear model promises no more.
    iterations : int
        Accepted and refused steps.
    kept : dict, optional
        What was worked out there, by name: it need not be worked out again.
    """

    evaluation: Evaluation
    square_root: SquareRootInformation | None
    converged: bool
    iterations: int
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def information(self) -> SquareRootInformation:
        """Square-root information there, of a minimum that was proven."""
        assert self.square_root is not None
        return self.square_root


def minimise(
    problem: Problem,
    values: gtsam.Values,
    *,
    stage: str,
    progress: Progress | None = None,
    max_iterations: int = 50,
    tolerance: float = CONVERGED,
    proven: bool = True,
    enough: float = 0.0,
    weighed: bool = False,
) -> Minimum:
    """Minimise a problem's cost.

    Starts as Gauss-Newton; a step that does not lower the cost brings in Levenberg's
    damping. Damping from the start, in proportion to the diagonal of the information
    matrix, would stall: the diagonal is that of relative attitudes known to 1e-7 rad, and
    damps the common rotation of the whole trajectory as well.

    Steps come from Cholesky's factorisation, which is fast but squares the condition of the
    problem. When one fails, and before a minimum is accepted, QR takes over.

    Parameters
    ----------
    problem : Problem
        What to minimise.
    values : gtsam.Values
        Where to start.
    stage : str
        Name, for the progress.
    progress : callable, optional
        Called with stage, iteration and cost.
    max_iterations : int, default 50
        Steps after which to give up.
    tolerance : float, optional
        Promised decrease of the cost below which the minimum is reached.
    proven : bool, default True
        Whether QR must confirm the minimum.
    enough : float, default 0
        Mean square of a whitened residual below which no minimum is needed.
    weighed : bool, default False
        Whether measurements keep the weights that they have; by default, they are weighed at the
        start.

    Raises
    ------
    SolveError
        If the cost at the start is not finite.
    """
    evaluation = problem.evaluate(values)
    if not weighed:
        evaluation = problem.weighed(evaluation)
    if not np.isfinite(evaluation.cost):
        raise SolveError(
            "the cost at the start is not finite",
            where=stage,
            hint="Inspect the trial: a unit or a column may be wrong",
        )
    if enough:
        enough *= 0.5 * problem.used_count
    search = _Search(
        problem=problem,
        evaluation=evaluation,
        gaussian=problem.linearize(evaluation),
        ordering=problem.ordering(),
        sizes=values.dims(),
        tolerance=tolerance,
        proven=proven,
        enough=enough,
    )
    if progress:
        progress(stage, 0, evaluation.cost)
    end = None
    while end is None and search.iteration < max_iterations:
        end = search.advance()
        if progress:
            progress(stage, search.iteration, search.evaluation.cost)
    return search.minimum(end)


class _End(Enum):
    """Why a minimisation ends: at a minimum, low enough, with fixed clocks, or without a step."""

    MINIMUM = auto()
    ENOUGH = auto()
    FIXED = auto()
    STUCK = auto()


@dataclass
class _Search:
    """A minimisation on its way.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    evaluation : Evaluation
        The lowest so far.
    gaussian : gtsam.GaussianFactorGraph
        The linear model there.
    ordering : gtsam.Ordering
        Ordering of the quick elimination.
    sizes : dict of int to int
        Dimensions of the variables.
    tolerance : float
        Promised decrease of the cost below which the minimum is reached.
    proven : bool
        Whether QR must confirm the minimum.
    enough : float
        Cost below which no minimum is needed.
    iteration : int
        Accepted and refused steps.
    damping : float
        Damping of the next step.
    failed : float
        Greatest damping with which a step failed since the cost last fell.
    careful : bool
        Whether steps are from QR, because one may have been bad for want of digits.
    fixed : bool
        Whether clocks stay where they are.
    promised, before : float
        What the linear model says that the last step and the one before take off the cost.
    root : SquareRootInformation or None
        Information from QR at the last step; None if that was from Cholesky.
    past : list of tuple of gtsam.Values and gtsam.VectorValues
        Where the last steps began, and what these were by the linear model there.
    """

    problem: Problem
    evaluation: Evaluation
    gaussian: gtsam.GaussianFactorGraph
    ordering: gtsam.Ordering
    sizes: dict[int, int]
    tolerance: float
    proven: bool
    enough: float
    iteration: int = 0
    damping: float = 0.0
    failed: float = -1.0
    careful: bool = False
    fixed: bool = False
    promised: float = np.inf
    before: float = np.inf
    root: SquareRootInformation | None = None
    past: list[tuple[gtsam.Values, gtsam.VectorValues]] = field(default_factory=list)

    def advance(self) -> _End | None:
        """Try a step; return why it was the last one, None if it was not."""
        self.iteration += 1
        self.root = None
        delta = self._step()
        trial = self._trial(delta)
        if trial is None:
            return None
        lower = trial.cost <= self.evaluation.cost * (1.0 + _ROUNDING)
        if np.isfinite(trial.cost) and (lower or self.promised < self.tolerance):
            return self._accepted(trial, lower=lower)
        return self._refused(delta)

    def minimum(self, end: _End | None) -> Minimum:
        """Return where it ended."""
        if end is _End.MINIMUM:
            return Minimum(self.evaluation, self.root, True, self.iteration)
        if end is _End.ENOUGH:
            return Minimum(self.evaluation, None, False, self.iteration)
        delta = self._from_qr(self.gaussian)
        settled = end is _End.FIXED or self._is_within(delta)
        return Minimum(self.evaluation, self.root, settled, self.iteration)

    def _step(self) -> gtsam.VectorValues:
        """Return the step of the linear model, damped, and with fixed clocks, as it is to be."""
        graph = self.gaussian
        if self.damping > 0.0:
            graph = _damped(graph, self.evaluation.values, self.damping)
        if self.fixed:
            graph = _held(graph, self.problem.clock_keys)
        last = self.proven and self.damping == 0.0 and self.promised < _NEAR
        delta = None if self.careful or last else quick_step(graph, self.ordering)
        if delta is not None:
            self.promised = self._promise(delta)
        if delta is None or (self.proven and not self._is_large):
            delta = self._from_qr(graph)
        self.past = [*self.past[-_MEMORY:], (self.evaluation.values, delta)]
        if self.damping > 0.0:
            self.past = []
        return delta

    def _from_qr(self, graph: gtsam.GaussianFactorGraph) -> gtsam.VectorValues:
        """Return the step from QR, and keep the information."""
        self.root = eliminated(graph, self.problem.ordering(), self.sizes)
        delta = self.root.solution()
        self.promised = self._promise(delta)
        return delta

    def _promise(self, delta: gtsam.VectorValues) -> float:
        """Return by how much the linear model says that the cost falls."""
        beside = 0.0 if self.problem.tilt is None else self.problem.tilt.constant
        return float(self.evaluation.cost + beside - self.gaussian.error(delta))

    @property
    def _is_large(self) -> bool:
        """Whether a step promises so much that it is not the last one."""
        return self.promised > max(self.tolerance, _NEARLY)

    def _trial(self, delta: gtsam.VectorValues) -> Evaluation | None:
        """Return where a step leads to; None if clocks are fixed first."""
        problem, evaluation, promised = self.problem, self.evaluation, self.promised
        if self._is_large:
            changed = self.past if promised > _POOR_GAIN * self.before else self.past[-1:]
            trial = _tried(problem, evaluation, delta, promised, changed)
        else:
            trial = problem.evaluate(evaluation.values.retract(delta))
        self.before = promised
        fallen = evaluation.cost - trial.cost
        if promised > _WITHIN and fallen < _POOR_GAIN * promised and self.damping == 0.0:
            little = not self.fixed and fallen < _HARDLY * promised
            if little and _at_jump(problem, evaluation, delta):
                self.fixed, self.past = True, []
                return None
            bent = _bent(problem, evaluation, delta, self.ordering)
            trial = trial if bent is evaluation else min(trial, bent, key=lambda each: each.cost)
            self.gaussian = problem.linearize(evaluation)
        return trial

    def _accepted(self, trial: Evaluation, *, lower: bool) -> _End | None:
        """Take a step that lowers the cost, or promises nothing, and say if it is the last one."""
        promised, decrease = self.promised, self.evaluation.cost - trial.cost
        small = promised < self.tolerance
        gain = decrease / promised if promised > 0.0 else 1.0
        # A model that was right about this step promises no more after it.
        right = abs(promised - decrease) < self.tolerance
        ended = small or (right and (promised < _NEARLY or not self.proven))
        if trial.cost < self.evaluation.cost * (1.0 - _ROUNDING):
            self.failed = -1.0
        if lower:
            self.evaluation = trial
        if ended and self.damping == 0.0 and self._is_proven and not self.fixed:
            return _End.MINIMUM
        fixed = ended and self.damping == 0.0 and self.fixed
        if not fixed and self.evaluation.cost < self.enough:
            return _End.ENOUGH
        self.gaussian = self.problem.linearize(self.evaluation)
        if fixed:
            return _End.FIXED
        if small or gain > _GOOD_GAIN:
            self.damping = self.damping / 10.0 if self.damping > _FIRST_DAMPING else 0.0
        elif gain < _POOR_GAIN:
            self.damping *= 10.0
        # Steps that small gain nothing, and larger ones fail: so it would go on.
        return _End.STUCK if self.damping <= self.failed else None

    def _refused(self, delta: gtsam.VectorValues) -> _End | None:
        """Damp the next step, or say that none lowers the cost."""
        if self.damping == 0.0 and self.fixed and self.promised < _WITHIN:
            return _End.FIXED
        if self.damping == 0.0 and self._is_proven and self._is_within(delta):
            # The information of fixed clocks is none.
            return _End.FIXED if self.fixed else _End.MINIMUM
        if not self.careful and self.root is None:
            # The step may have been bad for want of digits only.
            self.careful = True
            return None
        self.failed = self.damping
        self.damping = max(self.damping * 10.0, _FIRST_DAMPING)
        return _End.STUCK if self.damping > _MAX_DAMPING else None

    @property
    def _is_proven(self) -> bool:
        """Whether the last step is as certain as it has to be."""
        return self.root is not None or not self.proven

    def _is_within(self, delta: gtsam.VectorValues) -> bool:
        """Whether a step promises hardly anything, and would move no constant that is reported."""
        problem, root, promised = self.problem, self.root, self.promised
        if root is None or promised < _WITHIN or promised > _LITTLE or not problem.parameters:
            return promised < _WITHIN
        step = np.concatenate([delta.at(problem.key(name)) for name in problem.columns])
        variance = np.diag(root.covariance_of([every_constant(problem)]))
        return bool(np.all(np.abs(step) < _SAME * np.sqrt(variance)))


def _tried(
    problem: Problem,
    evaluation: Evaluation,
    delta: gtsam.VectorValues,
    promised: float,
    past: Sequence[tuple[gtsam.Values, gtsam.VectorValues]],
) -> Evaluation:
    """Return the lowest of where a step, less of it, and what the last ones lead to end.

    Parameters
    ----------
    problem, evaluation : Problem or Evaluation
        What is minimised, and where.
    delta : gtsam.VectorValues
        Step of the linear model.
    promised : float
        Predicted fall of the cost.
    past : sequence of tuple of gtsam.Values and gtsam.VectorValues
        Past steps, as for `_extrapolated`, which needs more than one.
    """
    trial = problem.evaluate(evaluation.values.retract(delta))
    if len(past) > 1 and problem.parameters:
        trial = min(trial, _extrapolated(problem, past), key=lambda each: each.cost)
    if evaluation.cost - trial.cost < _POOR_GAIN * promised:
        trial = _shorter(problem, evaluation, delta, promised, trial)
    return trial


def _at_jump(problem: Problem, evaluation: Evaluation, delta: gtsam.VectorValues) -> bool:
    """Whether the cost rises at once along a step by which the linear model says that it falls.

    Its slope then jumps, and there is a minimum at the jump. Without an IMU the acceleration jumps
    at nodes, and so does the slope by clocks that move velocities past one.
    """
    if not problem.clock_keys:
        return False
    probe = problem.evaluate(evaluation.values.retract(delta.scale(_AT_ONCE)))
    return probe.cost > evaluation.cost


def _held(
    gaussian: gtsam.GaussianFactorGraph, clocks: Collection[int]
) -> gtsam.GaussianFactorGraph:
    """Return the graph with clocks that stay where they are."""
    return _kept_near(gaussian, {key: np.full(1, 1.0 / _STAYS) for key in clocks})


def _extrapolated(
    problem: Problem, past: Sequence[tuple[gtsam.Values, gtsam.VectorValues]]
) -> Evaluation:
    """Return where the last steps of the linear model would end if they went on as they changed.

    Gauss-Newton leaves out what residuals times second derivatives add to the curvature. Where
    noise moves clocks that is much: steps go to and fro, or are short and many. How steps changed
    by what was taken before shows that curvature along these (Anderson, Iterative procedures for
    nonlinear integral equations, J. ACM 12(4), 1965; Walker and Ni, Anderson acceleration for
    fixed-point iterations, SIAM J. Numerical Analysis 49(4), 2011). States follow the constants,
    which decide by how much of each.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    past : sequence of tuple of gtsam.Values and gtsam.VectorValues
        Where two steps or more began, and the steps of the linear model there, the last one last.
    """
    keys = [problem.key(p.name) for p in problem.parameters]
    (values, step), count = past[-1], len(past) - 1
    taken = [past[i][0].localCoordinates(past[i + 1][0]) for i in range(count)]
    changes = [past[i + 1][1].subtract(past[i][1]) for i in range(count)]
    of_constants = np.column_stack([each.vector(keys) for each in (*changes, step)])
    scale = np.linalg.norm(of_constants, axis=1)
    of_constants /= np.where(scale > 0.0, scale, 1.0)[:, None]
    shares = np.linalg.lstsq(of_constants[:, :-1], of_constants[:, -1], rcond=None)[0]
    for share, move, change in zip(shares.tolist(), taken, changes, strict=True):
        step = step.subtract(move.add(change).scale(share))
    return problem.evaluate(values.retract(step))


def _shorter(
    problem: Problem,
    evaluation: Evaluation,
    delta: gtsam.VectorValues,
    promised: float,
    whole: Evaluation,
) -> Evaluation:
    """Return where the parabola through both ends of a step has its minimum, if that is lower.

    Its slope at the start is -2 times what the linear model promises. Where noise moves clocks, or
    two of them make up for each other, whole steps lead to and fro. A step that raises the cost by
    more than it promised to lower it goes beyond what a parabola describes: damping turns it, too.
    """
    fallen = evaluation.cost - whole.cost
    if not fallen > -promised:
        return whole
    share = promised / (2.0 * promised - fallen)
    found = problem.evaluate(evaluation.values.retract(delta.scale(share)))
    return min(found, whole, key=lambda each: each.cost)


def _bent(
    problem: Problem,
    evaluation: Evaluation,
    delta: gtsam.VectorValues,
    ordering: gtsam.Ordering,
) -> Evaluation:
    """Return where a step ends that bends as the valley of the cost does.

    The valley is narrow and curved where data leave a direction free: by ranges to one beacon, an
    arc around it. The Gauss-Newton step from a share h along the step differs from the rest of it
    by (h - h²/2) a, a the geodesic acceleration, of which half is added (Transtrum and Sethna,
    Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares minimization,
    arXiv:1201.5885). With h = 1 it is the next step, tried before this one is given up.
    """
    best = evaluation
    for share in _PROBES:
        probe = problem.evaluate(evaluation.values.retract(delta.scale(share)))
        there = problem.linearize(probe)
        rest = quick_step(there, ordering)
        if rest is None:
            rest = eliminated(there, ordering, evaluation.values.dims()).solution()
        bend = rest.subtract(delta.scale(1.0 - share)).scale(0.5 / (share - 0.5 * share**2))
        length = min(1.0, _LARGEST_BEND * delta.norm() / max(bend.norm(), 1e-300))
        step = delta.scale(length).add(bend.scale(length**2))
        found = problem.evaluate(evaluation.values.retract(step))
        best = min(best, found, key=lambda each: each.cost)
    return best


def factorized(
    problem: Problem, evaluation: Evaluation
) -> tuple[SquareRootInformation, gtsam.VectorValues]:
    """Return the square-root information from QR at some values, and the step to the minimum."""
    gaussian = [problem.linearize(evaluation)]
    ordering = problem.ordering()
    # Nothing else holds the factors then, so that each goes once it is eliminated.
    problem.release()
    out = eliminated(gaussian.pop(), ordering, evaluation.values.dims())
    return out, out.solution()


def quickly_factorized(
    problem: Problem, evaluation: Evaluation, *, rough: bool = False
) -> tuple[SquareRootInformation, gtsam.VectorValues]:
    """Return what `factorized` does, by Cholesky: from QR where that loses digits.

    It takes half the time. Across a gap of a record it may lose digits: for what compares
    assumptions, not for the standard deviations of a result.

    Parameters
    ----------
    problem : Problem
        Problem with weights.
    evaluation : Evaluation
        Where the graph is linear.
    rough : bool, default False
        Whether lost digits do not matter: what is made of it is estimated again.
    """
    gaussian = problem.linearize(evaluation)
    tree = cholesky(gaussian, problem.ordering())
    if tree is not None:
        out = SquareRootInformation([tree], evaluation.values.dims())
        if rough or _has_digits(problem, gaussian, out):
            del gaussian
            problem.release()
            return out, out.solution()
    del gaussian
    return factorized(problem, evaluation)


def _has_digits(
    problem: Problem, gaussian: gtsam.GaussianFactorGraph, information: SquareRootInformation
) -> bool:
    """Whether rounding leaves the variance of the sum of all constants, in σ, as it is."""
    if not problem.columns:
        return True
    every = every_constant(problem)
    sigma = np.sqrt(np.diag(information.covariance_of([every])))
    total = {key: (1.0 / sigma)[None] @ each for key, each in every.items()}
    return error_of_variance(gaussian, information, total) < _EXACT


def quick_step(
    gaussian: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> gtsam.VectorValues | None:
    """Return the step from Cholesky's factorisation, None where it has no digits left."""
    tree = cholesky(gaussian, ordering)
    return None if tree is None else tree.optimize()


def _damped(
    gaussian: gtsam.GaussianFactorGraph, values: gtsam.Values, damping: float
) -> gtsam.GaussianFactorGraph:
    """Return the graph with Levenberg's damping on every variable."""
    scales = {
        key: 1.0 / _TRUSTED_STATE if size == _TRUSTED_STATE.size else np.ones(size)
        for key, size in values.dims().items()
    }
    return _kept_near(gaussian, {key: np.sqrt(damping) * each for key, each in scales.items()})


def _kept_near(
    gaussian: gtsam.GaussianFactorGraph, weights: Mapping[int, Array]
) -> gtsam.GaussianFactorGraph:
    """Return the graph with variables kept near where they are, by weights (n,) of their steps."""
    out = gtsam.GaussianFactorGraph()
    for i in range(gaussian.size()):
        out.push_back(gaussian.at(i))
    for key, weight in weights.items():
        unit = gtsam.noiseModel.Unit.Create(weight.size)
        out.add(key, np.diag(weight), np.zeros(weight.size), unit)
    return out
