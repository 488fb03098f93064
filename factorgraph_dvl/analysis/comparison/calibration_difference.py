"""Two calibrations of the same data against each other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from factorgraph_dvl.analysis.error_statistics import (
    VectorErrors,
    nearest_angle,
    nearest_rotation_vector,
)
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.unit_vectors import turns_to
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Calibration, Solution

_Result = TypeVar("_Result", Solution, Calibration)
Side = Literal["A", "B"]
Verdict = Literal["agree", "differ", "not comparable"]
Kind = Literal["upper bound", "Hausman", "A alone", "B alone", "none"]

# Chosen: three standard deviations, as in all figures; 0.27 % of a normal distribution is beyond.
AGREE_SIGMAS = 3.0
AGREE_PROBABILITY = 0.0027
# Chosen: reported σ are accurate to some percent; below this ratio the difference of two
# variances would be their error.
HAUSMAN_RATIO = 1.05


@dataclass(frozen=True)
class Component:
    """A calibration component in two results, in its reported unit.

    Parameters
    ----------
    parameter, name : str
        Parameter and name as in calibration.json, and in its `covariance.order`.
    a, b : float
        The two values; nan where a result has none.
    std_a, std_b : float
        Their standard deviations; nan where unknown, 0 where fixed.
    std_upper : float
        √(σ_A² + σ_B²), at least the standard deviation of a - b if the errors are not negatively
        correlated; nan where unknown.
    std_hausman : float
        √(σ² of the other - σ² of the efficient one); nan where unknown or not requested.
    std, kind : float or Kind
        Standard deviation of a - b that is shown, and its kind.
    verdict, reason : Verdict or str
        Whether a and b agree given `std`, and why they are not comparable if they are not.
    """

    parameter: str
    name: str
    a: float
    b: float
    std_a: float
    std_b: float
    std_upper: float
    std_hausman: float
    std: float
    kind: Kind
    verdict: Verdict
    reason: str

    @property
    def difference(self) -> float:
        """Value of A - value of B."""
        return self.a - self.b

    @property
    def in_sigmas(self) -> float:
        """Difference over its standard deviation; nan where unknown."""
        return self.difference / self.std if self.std > 0.0 else float("nan")


@dataclass(frozen=True)
class Joint:
    """Joint test of all comparable components by the upper-bound covariance.

    Parameters
    ----------
    names : tuple of str
        Names of the n components.
    statistic : float
        The test statistic, d' (P_A + P_B)^-1 d with d = A - B.
    limit : float
        Value that chi² with n degrees of freedom exceeds with `AGREE_PROBABILITY`.
    probability : float
        Probability that chi² with n degrees of freedom exceeds the statistic; a lower bound for
        results that agree.
    correlations : bool
        Whether both results state correlations; otherwise zero is assumed.
    """

    names: tuple[str, ...]
    statistic: float
    limit: float
    probability: float
    correlations: bool

    @property
    def verdict(self) -> Verdict:
        """Whether the results agree as a whole."""
        return "agree" if self.statistic <= self.limit else "differ"


def compare_calibrations(
    a: Solution, b: Solution, efficient: Side | None = None
) -> tuple[Component, ...]:
    """Return every calibration component of either result.

    var(A - B) = σ_A² + σ_B² - 2 cov(A, B). Both used the same data, so the covariance
    is unknown but not negative, and without it an upper bound remains. If one of them
    is efficient its error is uncorrelated with A - B, and var(A - B) is the difference
    of the variances: Hausman, Specification Tests in Econometrics, Econometrica 46(6),
    1978, 1251-1271, lemma 2.1.

    Of the two rotation vectors of B's rotation, the one nearer to A's is compared.

    Parameters
    ----------
    a, b : Solution
        The results.
    efficient : Side, optional
        The result that uses all data with a correct model.
    """
    of_a = {e.name: e for e in a.estimates}
    of_b = {e.name: e for e in same_branch(b, a).estimates}
    out: list[Component] = []
    for name in dict.fromkeys((*of_a, *of_b)):
        frame = (of_a.get(name) or of_b[name]).spec.frame
        same_axes = a.body_axes == b.body_axes or frame != "b"
        out += _compare(of_a.get(name), of_b.get(name), same_axes, efficient)
    return tuple(out)


def rotation_angles(a: Solution, b: Solution) -> dict[str, float]:
    """Return the angles between the rotations of A and B, deg, by parameter."""
    out = {}
    for name in (e.name for e in a.estimates if e.spec.kind == "rotation"):
        found = [e.value for s in (a, b) for e in s.estimates if e.name == name]
        if len(found) == 2 and a.body_axes == b.body_axes and np.isfinite(found).all():
            relative = exp_so3(found[0] * DEG) @ exp_so3(found[1] * DEG).T
            out[name] = float(np.linalg.norm(log_so3(relative))) / DEG
    return out


def joint_test(a: Solution, b: Solution, components: tuple[Component, ...]) -> Joint | None:
    """Return the joint test of the comparable components; None if there are none.

    Parameters
    ----------
    a, b : Solution
        The results, for their covariances.
    components : tuple of Component
        Result of `compare_calibrations`.
    """
    tested = [
        c
        for c in components
        if c.verdict != "not comparable" and np.isfinite(c.std_upper) and c.std_upper > 0.0
    ]
    if not tested:
        return None
    names = tuple(c.name for c in tested)
    p_a, p_b = _block(a, names), _block(same_branch(b, a), names)
    difference = np.array([c.difference for c in tested])
    statistic = float(VectorErrors(difference[None], (p_a + p_b)[None]).nees[0])
    dof = float(len(names))
    return Joint(
        names,
        statistic,
        float(chdtri(dof, AGREE_PROBABILITY)),
        float(chdtrc(dof, statistic)),
        len(names) == 1 or (_correlated(p_a) and _correlated(p_b)),
    )


def same_branch(solution: _Result, other: Solution | Calibration) -> _Result:
    """Return a solution with its rotation vectors on the same branch as another's.

    Beam directions become turns of the other's nominal directions.

    φ' = φ (1 - 2π / |φ|) is the same rotation; J = (1 - 2π / |φ|) I + 2π φ φᵀ / |φ|³
    transforms its covariance.
    """
    estimates = list(solution.estimates)
    covariance = np.array(solution.covariance, dtype=float)
    near = {e.name: e.value for e in other.estimates}
    row = 0
    for i, estimate in enumerate(estimates):
        rows = slice(row, row + estimate.value.size)
        row = rows.stop
        if estimate.nominal is not None:
            estimates[i] = _about_the_same(estimate, other)
        if estimate.spec.kind == "angle" and estimate.name in near:
            value = nearest_angle(estimate.value, near[estimate.name])
            estimates[i] = estimate = replace(estimate, value=value)
        if estimate.spec.kind != "rotation" or estimate.name not in near:
            continue
        phi = estimate.value
        if not np.isfinite([phi, near[estimate.name]]).all():
            continue
        moved = nearest_rotation_vector(phi, near[estimate.name])
        if np.array_equal(moved, phi):
            continue
        angle = float(np.linalg.norm(phi))
        jacobian = (1.0 - 360.0 / angle) * np.eye(3) + 360.0 * np.outer(phi, phi) / angle**3
        covariance[rows] = jacobian @ covariance[rows]
        covariance[:, rows] = covariance[:, rows] @ jacobian.T
        std = np.sqrt(np.diagonal(covariance)[rows])
        estimates[i] = replace(estimate, value=moved, std=std)
    return replace(solution, estimates=tuple(estimates), covariance=covariance)


def _about_the_same(estimate: Estimate, other: Solution | Calibration) -> Estimate:
    """Return directions as turns of the other's nominal ones, to first order."""
    theirs = next((e for e in other.estimates if e.name == estimate.name), None)
    if theirs is None or theirs.nominal is None or theirs.value.size != estimate.value.size:
        return estimate
    turns = turns_to(theirs.nominal, estimate.directions).ravel() / DEG
    return replace(estimate, value=turns, nominal=theirs.nominal)


def std_of_difference(
    std_a: Array, std_b: Array, efficient: Side | None
) -> tuple[Array, NDArray[np.float64]]:
    """Return √(σ_A² + σ_B²), and the Hausman value where it is significant, otherwise nan.

    Parameters
    ----------
    std_a, std_b : ndarray, shape (...)
        Standard deviations.
    efficient : Side or None
        The efficient result; None = neither.
    """
    upper = np.hypot(std_a, std_b)
    hausman = np.full(np.shape(upper), np.nan)
    if efficient is not None:
        best, other = (std_a, std_b) if efficient == "A" else (std_b, std_a)
        significant = (other > HAUSMAN_RATIO * best) & (best > 0.0)
        np.sqrt(other**2 - best**2, out=hausman, where=significant)
    return upper, hausman


def _compare(
    a: Estimate | None, b: Estimate | None, same_axes: bool, efficient: Side | None
) -> list[Component]:
    some = a if b is None or (a is not None and a.value.size >= b.value.size) else b
    assert some is not None
    n = some.value.size
    obstacle = _obstacle(a, b, same_axes)
    value_a, std_a, observable_a = _columns(a, n)
    value_b, std_b, observable_b = _columns(b, n)
    upper, hausman = std_of_difference(std_a, std_b, efficient)
    out = []
    for i, name in enumerate(some.component_names):
        std, kind = _shown(std_a[i], std_b[i], upper[i], hausman[i])
        reason = obstacle or _component_obstacle(
            (value_a[i], std_a[i], observable_a[i]), (value_b[i], std_b[i], observable_b[i])
        )
        if obstacle or not np.isfinite(value_a[i] - value_b[i]):
            std, kind = float("nan"), "none"
        verdict, reason = _judge(float(value_a[i] - value_b[i]), std, kind, reason)
        out.append(
            Component(
                parameter=some.name,
                name=name,
                a=float(value_a[i]),
                b=float(value_b[i]),
                std_a=float(std_a[i]),
                std_b=float(std_b[i]),
                std_upper=float(upper[i]),
                std_hausman=float(hausman[i]),
                std=std,
                kind=kind,
                verdict=verdict,
                reason=reason,
            )
        )
    return out


def _columns(estimate: Estimate | None, n: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return values, standard deviations and observability, (n,); one number is repeated."""
    unknown = np.full(n, np.nan)
    if estimate is None or estimate.value.size not in (1, n):
        return unknown, unknown, np.ones(n, dtype=bool)
    return (
        np.broadcast_to(estimate.value, (n,)),
        np.broadcast_to(estimate.std, (n,)),
        np.broadcast_to(np.asarray(estimate.observable, dtype=bool), (n,)),
    )


def _obstacle(a: Estimate | None, b: Estimate | None, same_axes: bool) -> str:
    if a is None or b is None:
        return f"only in {'A' if b is None else 'B'}"
    if a.value.size != b.value.size:
        return f"different parametrisation: {a.value.size} in A, {b.value.size} in B"
    return "" if same_axes else "different body axes"


def _component_obstacle(a: tuple[float, float, np.bool_], b: tuple[float, float, np.bool_]) -> str:
    for why, blocked in (
        ("no value", [not np.isfinite(value) for value, _, _ in (a, b)]),
        ("fixed", [std == 0.0 for _, std, _ in (a, b)]),
        ("not observable", [not observable for _, _, observable in (a, b)]),
    ):
        if any(blocked):
            return f"{why} in {' and '.join(s for s, x in zip('AB', blocked, strict=True) if x)}"
    return ""


def _shown(std_a: float, std_b: float, upper: float, hausman: float) -> tuple[float, Kind]:
    if np.isfinite(hausman):
        return float(hausman), "Hausman"
    if np.isfinite(upper):
        return float(upper), "upper bound"
    if np.isfinite(std_a):
        return float(std_a), "A alone"
    if np.isfinite(std_b):
        return float(std_b), "B alone"
    return float("nan"), "none"


def _judge(difference: float, std: float, kind: Kind, reason: str) -> tuple[Verdict, str]:
    if reason:
        return "not comparable", reason
    if kind == "none":
        return "not comparable", "neither states a σ"
    if abs(difference) <= AGREE_SIGMAS * std:
        return "agree", ""
    if kind in ("A alone", "B alone"):
        other = "B" if kind == "A alone" else "A"
        return "not comparable", f"beyond {AGREE_SIGMAS:g}σ of {kind}, but {other} states no σ"
    return "differ", ""


def _block(solution: Solution, names: tuple[str, ...]) -> Array:
    order = list(solution.order)
    rows = [order.index(name) for name in names]
    return np.asarray(solution.covariance)[np.ix_(rows, rows)]


def _correlated(covariance: Array) -> bool:
    return bool(np.any(covariance[~np.eye(len(covariance), dtype=bool)] != 0.0))
