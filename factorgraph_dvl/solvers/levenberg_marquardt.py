"""Levenberg-Marquardt over a problem, with GTSAM's elimination."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factorgraph_dvl.errors import SolveError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.graph.problem import Evaluation, Problem
from factorgraph_dvl.solution import Progress
from factorgraph_dvl.statistics.marginal_likelihood import every_constant
from factorgraph_dvl.statistics.square_root_information import (
    SquareRootInformation,
    cholesky,
    eliminated,
    error_of_variance,
)

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
    """

    evaluation: Evaluation
    square_root: SquareRootInformation | None
    converged: bool
    iterations: int

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
    gaussian = problem.linearize(evaluation)
    ordering, sizes = problem.ordering(), values.dims()
    if enough:
        enough *= 0.5 * sum(np.count_nonzero(weights) for weights in problem.weights)
    root: SquareRootInformation | None = None
    damping = 0.0
    # Greatest damping with which a step failed since the cost last fell.
    failed = -1.0
    careful = held = settled = False
    promised = before = np.inf
    # Where the last steps began, and what these were by the linear model there.
    past: list[tuple[gtsam.Values, gtsam.VectorValues]] = []
    iteration = 0
    if progress:
        progress(stage, 0, evaluation.cost)
    while iteration < max_iterations:
        iteration += 1
        damped = _damped(gaussian, evaluation.values, damping) if damping > 0.0 else gaussian
        if held:
            damped = _held(damped, problem.clock_keys)
        last = proven and damping == 0.0 and promised < _NEAR
        delta = None if careful or last else quick_step(damped, ordering)
        promised = (
            _promised(problem, evaluation, gaussian, delta) if delta is not None else -np.inf
        )
        if delta is None or (proven and not promised > max(tolerance, _NEARLY)):
            root = eliminated(damped, problem.ordering(branches=False), sizes)
            delta = root.solution()
            promised = _promised(problem, evaluation, gaussian, delta)
        assert delta is not None
        past = [*past[-_MEMORY:], (evaluation.values, delta)] if damping == 0.0 else []
        if promised > max(tolerance, _NEARLY):
            changed = past if promised > _POOR_GAIN * before else past[-1:]
            trial = _tried(problem, evaluation, delta, promised, changed)
        else:
            trial = problem.evaluate(evaluation.values.retract(delta))
        before = promised
        fallen = evaluation.cost - trial.cost
        if promised > _WITHIN and fallen < _POOR_GAIN * promised and damping == 0.0:
            if not held and fallen < _HARDLY * promised and _at_jump(problem, evaluation, delta):
                held, past, root = True, [], None
                continue
            bent = _bent(problem, evaluation, delta, ordering)
            trial = trial if bent is evaluation else min(trial, bent, key=lambda each: each.cost)
            gaussian = problem.linearize(evaluation)
        lower = trial.cost <= evaluation.cost * (1.0 + _ROUNDING)
        small = promised < tolerance
        if np.isfinite(trial.cost) and (lower or small):
            decrease = evaluation.cost - trial.cost
            gain = decrease / promised if promised > 0.0 else 1.0
            # A model that was right about this step promises no more after it.
            right = abs(promised - decrease) < tolerance
            ended = small or (right and (promised < _NEARLY or not proven))
            if trial.cost < evaluation.cost * (1.0 - _ROUNDING):
                failed = -1.0
            if lower:
                evaluation = trial
            if progress:
                progress(stage, iteration, evaluation.cost)
            if ended and damping == 0.0 and held:
                settled, gaussian = True, problem.linearize(evaluation)
                break
            if ended and damping == 0.0 and (root is not None or not proven):
                return Minimum(evaluation, root, True, iteration)
            if evaluation.cost < enough:
                return Minimum(evaluation, None, False, iteration)
            if small or gain > _GOOD_GAIN:
                damping = damping / 10.0 if damping > _FIRST_DAMPING else 0.0
            elif gain < _POOR_GAIN:
                damping *= 10.0
            gaussian = problem.linearize(evaluation)
            if damping <= failed:
                # Steps that small gain nothing, and larger ones fail: so it would go on.
                break
        elif promised < _WITHIN and damping == 0.0 and held:
            settled = True
            break
        elif (
            damping == 0.0
            and (root is not None or not proven)
            and _within(problem, promised, root, delta)
        ):
            return Minimum(evaluation, root, True, iteration)
        elif not careful and root is None:
            # The step may have been bad for want of digits only.
            careful = True
        else:
            failed = damping
            damping = max(damping * 10.0, _FIRST_DAMPING)
            if damping > _MAX_DAMPING:
                break
        root = None
    root = eliminated(gaussian, problem.ordering(branches=False), sizes)
    delta = root.solution()
    promised = _promised(problem, evaluation, gaussian, delta)
    settled = settled or _within(problem, promised, root, delta)
    return Minimum(evaluation, root, settled, iteration)


def _within(
    problem: Problem,
    promised: float,
    root: SquareRootInformation | None,
    delta: gtsam.VectorValues,
) -> bool:
    """Whether a step promises hardly anything, and would move no constant that is reported."""
    if root is None or promised < _WITHIN or promised > _LITTLE or not problem.parameters:
        return promised < _WITHIN
    step = np.concatenate([delta.at(problem.key(name)) for name in problem.columns])
    variance = np.diag(root.covariance_of([every_constant(problem)]))
    return bool(np.all(np.abs(step) < _SAME * np.sqrt(variance)))


def _promised(
    problem: Problem,
    evaluation: Evaluation,
    gaussian: gtsam.GaussianFactorGraph,
    delta: gtsam.VectorValues,
) -> float:
    """Return by how much the linear model says that the cost falls."""
    beside = 0.0 if problem.tilt is None else problem.tilt.constant
    return float(evaluation.cost + beside - gaussian.error(delta))


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
    ordering = problem.ordering(branches=False)
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
