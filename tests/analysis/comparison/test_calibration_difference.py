from __future__ import annotations

import numpy as np
import pytest
from comparisons import estimate, one, result, scale

from factorgraph_dvl.analysis.comparison.crosscheck import crosscheck
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.solution import Solution


def test_upper_bound_by_hand() -> None:
    c = one(crosscheck(scale(10.0, 3.0), scale(-2.0, 4.0)))
    assert (c.difference, c.std_upper, c.std, c.kind) == (12.0, 5.0, 5.0, "upper bound")
    assert c.in_sigmas == 2.4
    assert np.isnan(c.std_hausman)
    assert c.verdict == "agree"
    assert one(crosscheck(scale(13.1, 3.0), scale(-2.0, 4.0))).verdict == "differ"


def test_hausman_by_hand() -> None:
    a, b = scale(13.0, 5.0), scale(0.0, 4.0)
    c = one(crosscheck(a, b, efficient="B"))
    assert (c.std_hausman, c.std, c.kind) == (3.0, 3.0, "Hausman")
    assert c.std_upper == pytest.approx(np.sqrt(41.0))
    assert c.verdict == "differ"
    assert one(crosscheck(a, b)).verdict == "agree"
    # The same, seen from the other side.
    assert one(crosscheck(b, a, efficient="A")).std == 3.0


@pytest.mark.parametrize("std", [4.0, 4.1])
def test_no_hausman_without_digits_or_against_the_order(std: float) -> None:
    c = one(crosscheck(scale(1.0, 4.0), scale(0.0, std), efficient="A"))
    assert c.kind == "upper bound"
    assert np.isnan(c.std_hausman)


def test_variances_of_an_efficient_and_an_inefficient_estimator() -> None:
    """Weighted and plain mean of the same data: the textbook pair."""
    rng = np.random.default_rng(5)
    sigma = np.array([0.5, 1.0, 2.0, 4.0])
    data = rng.normal(0.0, sigma, (20_000, 4))
    weights = sigma**-2 / np.sum(sigma**-2)
    plain, efficient = data.mean(axis=1), data @ weights
    std_a = float(np.sqrt(np.sum(sigma**2)) / 4.0)
    std_b = float(np.sum(sigma**-2) ** -0.5)
    c = one(crosscheck(scale(0.0, std_a), scale(0.0, std_b), efficient="B"))
    spread = (plain - efficient).std()
    assert spread == pytest.approx(c.std_hausman, rel=0.02)
    assert spread < c.std_upper
    share = np.mean(np.abs(plain - efficient) <= 2.0 * c.std_hausman)
    assert share == pytest.approx(0.954, abs=0.005)
    # The joint test by the upper bound rejects no more often than it says.
    assert np.mean(np.abs(plain - efficient) > 3.0 * c.std_upper) <= 0.0027


def test_upper_bound_covers_whatever_the_positive_correlation() -> None:
    rng = np.random.default_rng(6)
    for rho in (0.0, 0.5, 0.95):
        common, own_a, own_b = rng.normal(size=(3, 20_000))
        a = 2.0 * (np.sqrt(rho) * common + np.sqrt(1.0 - rho) * own_a)
        b = 1.0 * (np.sqrt(rho) * common + np.sqrt(1.0 - rho) * own_b)
        upper = one(crosscheck(scale(0.0, 2.0), scale(0.0, 1.0))).std_upper
        assert np.mean(np.abs(a - b) <= 2.0 * upper) >= 0.95
        assert (a - b).std() <= 1.01 * upper


@pytest.mark.parametrize(
    ("a", "b", "reason"),
    [
        (result(), scale(1.0, 1.0), "only in B"),
        (scale(1.0, 1.0), result(), "only in A"),
        (
            scale(0.1, 0.1),
            scale([0.1, 0.2, 0.3], [0.1] * 3),
            "different parametrisation: 1 in A, 3",
        ),
        (scale(1.0, 0.0), scale(1.0, 1.0), "fixed in A"),
        (scale(1.0, 0.0), scale(1.0, 0.0), "fixed in A and B"),
        (scale(np.nan, 1.0), scale(1.0, 1.0), "no value in A"),
        (scale(1.0, np.nan), scale(1.0, np.nan), "neither states a σ"),
        (scale(9.0, 1.0), scale(1.0, np.nan), "beyond 3σ of A alone, but B states no σ"),
        (
            result(estimate("scale_error", 1.0, 1.0, False)),
            scale(1.0, 1.0),
            "not observable in A",
        ),
        (
            result(estimate("lever_arm_m", [1.0, 2.0, 3.0], [1.0] * 3)),
            result(estimate("lever_arm_m", [1.0, 2.0, 3.0], [1.0] * 3), body_axes="FRD"),
            "different body axes",
        ),
    ],
)
def test_what_is_not_comparable(a: Solution, b: Solution, reason: str) -> None:
    check = crosscheck(a, b)
    assert one(check).verdict == "not comparable"
    assert one(check).reason.startswith(reason)
    assert check.joint is None


def test_one_sigma_is_enough_to_agree() -> None:
    c = one(crosscheck(scale(2.0, np.nan), scale(1.0, 0.5)))
    assert (c.verdict, c.kind, c.in_sigmas) == ("agree", "B alone", 2.0)


def test_axes_do_not_matter_to_a_scale() -> None:
    assert one(crosscheck(scale(1.0, 1.0), scale(1.0, 1.0, body_axes="FRD"))).verdict == "agree"


def test_joint_test_by_hand() -> None:
    p_a = np.array([[2.0, 1.0], [1.0, 3.0]])
    p_b = np.array([[2.0, 0.0], [0.0, 0.0]])
    p_b[1, 1] = 1.0
    a = result(
        estimate("current_m_s", [2.0, 2.0], np.sqrt(np.diag(p_a))),
        covariance=p_a,
    )
    b = result(estimate("current_m_s", [0.0, 0.0], np.sqrt(np.diag(p_b))), covariance=p_b)
    joint = crosscheck(a, b).joint
    assert joint is not None
    # [[4, 1], [1, 4]]^-1 = [[4, -1], [-1, 4]] / 15; d = [2, 2]: (16 - 8 + 16) / 15.
    assert joint.statistic == pytest.approx(24.0 / 15.0)
    assert joint.probability == pytest.approx(np.exp(-0.5 * 24.0 / 15.0))
    assert joint.limit == pytest.approx(-2.0 * np.log(0.0027))
    assert joint.verdict == "agree"
    assert not joint.correlations


def test_rotation_vectors_on_both_sides_of_180_degrees() -> None:
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    near, far = 179.0 * axis, -179.5 * axis
    std = np.array([0.1, 0.2, 0.3])
    a = result(estimate("misalignment_deg", near, [0.5] * 3))
    b = result(estimate("misalignment_deg", far, std))
    check = crosscheck(a, b)
    np.testing.assert_allclose([c.b for c in check.components], 180.5 * axis)
    np.testing.assert_allclose([c.difference for c in check.components], -1.5 * axis)
    assert check.angles["misalignment_deg"] == pytest.approx(1.5)
    # The covariance that came along against samples that were taken along.
    rng = np.random.default_rng(1)
    samples = far + 0.01 * std * rng.normal(size=(4000, 3))
    moved = np.array([phi * (1.0 - 360.0 / np.linalg.norm(phi)) for phi in samples])
    expected = 100.0 * moved.std(axis=0)
    np.testing.assert_allclose([c.std_b for c in check.components], expected, rtol=0.04)


def test_angle_between_rotations() -> None:
    turn = exp_so3(np.array([0.0, 0.0, 3.0]) * DEG)
    first = np.array([10.0, 20.0, 30.0])
    second = log_so3(turn @ exp_so3(first * DEG)) / DEG
    a, b = (result(estimate("misalignment_deg", v, [1.0] * 3)) for v in (first, second))
    assert crosscheck(a, b).angles["misalignment_deg"] == pytest.approx(3.0)


def test_angles_on_both_sides_of_half_a_turn() -> None:
    a = result(estimate("heading_bias_deg", 179.9, 0.1))
    b = result(estimate("heading_bias_deg", -179.9, 0.1))
    assert one(crosscheck(a, b)).difference == pytest.approx(-0.2)
    assert crosscheck(a, b, truth={"heading_bias_deg": -180.0}).truth_a.calibration.error == (
        pytest.approx([-0.1])
    )
