from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import build_solution, build_trial, edit, write_trial

from factorgraph_dvl.analysis.comparison.calibration_difference import Component
from factorgraph_dvl.analysis.comparison.crosscheck import CrossCheck, crosscheck
from factorgraph_dvl.analysis.comparison.motion_difference import compare_motions
from factorgraph_dvl.cli import main
from factorgraph_dvl.errors import DataError, FactorgraphDvlError
from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.io.external_results import load_results, load_truth, read_truth
from factorgraph_dvl.io.motion_table import motion_columns
from factorgraph_dvl.io.solution_folder import load_solution, save_solution
from factorgraph_dvl.io.tables import write_table
from factorgraph_dvl.solution import Estimate, Solution, Trajectory
from factorgraph_dvl.trial import Reference

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "crosscheck"


def estimate(name: str, value: Any, std: Any, observable: Any = True) -> Estimate:
    value, std = (np.atleast_1d(np.array(x, dtype=float)) for x in (value, std))
    n = value.size
    names = tuple(f"{name}_{i}" for i in range(n)) if n > 1 else (name,)
    seen = np.broadcast_to(np.array(observable), n).copy()
    return Estimate(name, names, value, std, np.zeros(n), np.full(n, 1e3), seen)


def result(*estimates: Estimate, **changes: Any) -> Solution:
    std = np.concatenate([np.zeros(0), *(e.std for e in estimates)])
    fields = {"warnings": (), "body_axes": "RFU", "covariance": np.diag(std**2)} | changes
    return build_solution(estimates=estimates, **fields)


def one(check: CrossCheck, i: int = 0) -> Component:
    return check.components[i]


def scale(value: Any, std: Any, **changes: Any) -> Solution:
    return result(estimate("scale_error", value, std), **changes)


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


def moved(trajectory: Trajectory, metres: float) -> Trajectory:
    geodetic = trajectory.geodetic.copy()
    geodetic[:, 2] += metres
    return replace(trajectory, geodetic=geodetic, rph=trajectory.rph + np.array([0.0, 0.0, 0.001]))


def test_trajectories_by_hand() -> None:
    a = build_solution().trajectory
    b = replace(moved(a, -0.5), position_cov=9.0 / 16.0 * a.position_cov)
    motion = compare_motions(a, b, "B")
    assert motion is not None
    up, heading = motion.spreads[2], motion.spreads[8]
    assert up.rms == pytest.approx(0.5)
    assert heading.largest == pytest.approx(0.001 / DEG)
    assert motion.difference[0, 8] == pytest.approx(-0.001 / DEG)
    # √(0.1² - 0.075²) for the position, √2 · 0.001 rad for the attitude.
    assert motion.kinds == ("Hausman",) * 3 + ("upper bound",) * 6
    assert up.rms_sigmas == pytest.approx(0.5 / (0.1 * np.sqrt(7.0) / 4.0))
    assert heading.rms_sigmas == pytest.approx(np.sqrt(0.5))
    assert (up.within_2_sigma, heading.within_2_sigma) == (0.0, 1.0)


def dense(seconds: float, rate: float, start: float = 0.0) -> Trajectory:
    time = start + np.arange(round(seconds * rate)) / rate
    geodetic = np.stack([0.6 + 1e-7 * time, 2.0 + 1e-7 * time, np.sin(time)], axis=1)
    rph = np.stack([0.1 * np.sin(time), 0.0 * time, 0.01 * time], axis=1)
    cov = np.tile(np.eye(3), (time.size, 1, 1)) * (1.0 + time[:, None, None])
    return Trajectory(time, geodetic, np.cos(rph), rph, cov, cov, cov)


@pytest.mark.parametrize("swap", [False, True])
def test_the_denser_trajectory_is_interpolated(swap: bool) -> None:
    fine, coarse = dense(10.0, 50.0), moved(dense(8.0, 1.0, 0.507), 1.0)
    motion = compare_motions(fine, coarse) if not swap else compare_motions(coarse, fine)
    assert motion is not None
    np.testing.assert_array_equal(motion.time, coarse.time)
    sign = -1.0 if swap else 1.0
    np.testing.assert_allclose(motion.difference[:, 2], -sign, atol=1e-7)
    np.testing.assert_allclose(motion.difference[:, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(motion.std[:, 0] ** 2, 2.0 * (1.0 + motion.time), atol=0.02)


def test_no_common_epochs_are_said() -> None:
    a = scale(1.0, 1.0, trajectory=dense(4.0, 10.0))
    b = scale(1.0, 1.0, trajectory=dense(4.0, 10.0, 0.05))
    check = crosscheck(a, b)
    assert check.motion is None
    assert "no epochs in common" in check.notes[0]


def test_errors_against_truth() -> None:
    trajectory = dense(10.0, 50.0)
    reference = Reference(
        trajectory.time, trajectory.geodetic, trajectory.velocity, trajectory.rph
    )
    a = scale(1.3, 0.1, trajectory=trajectory)
    b = scale(0.9, 0.1, trajectory=moved(trajectory, 2.0))
    check = crosscheck(a, b, truth={"scale_error": 1.0}, reference=reference)
    assert check.has_truth
    truth_a, truth_b = check.truth_a.calibration, check.truth_b.calibration
    assert truth_a is not None
    assert truth_b is not None
    assert truth_a.nees == pytest.approx(9.0)
    assert truth_b.nees == pytest.approx(1.0)
    assert check.truth_b.trajectory is not None
    np.testing.assert_allclose(check.truth_b.trajectory.position.error[:, 2], 2.0, atol=1e-6)


def lever_arm(value: Any, std: Any = 0.01) -> Estimate:
    return estimate("lever_arm_m", value, np.broadcast_to(std, 3))


def test_explanations_come_from_the_results() -> None:
    a = result(estimate("scale_error", 1.0, 0.1), lever_arm([1.0, 0.0, 0.0]))

    def told(b: Solution, **options: Any) -> str:
        return "\n".join(crosscheck(a, b, **options).explanation)

    off = estimate("scale_error", 9.0, 0.05)
    assert told(result(estimate("scale_error", 1.0, 0.1))) == ""
    assert "Nothing in the two results explains" in told(result(off, lever_arm([1.0, 0.0, 0.0])))
    assert "B did not converge" in told(result(off, converged=False))
    white = told(result(off, solver="kalman-point-set"))
    assert "B (kalman-point-set) models the error of its inertial velocity as white" in white
    assert "its σ are 0.5 times those of the other" in white
    neglected = told(result(off, solver="kalman-wahba"))
    assert (
        "B (kalman-wahba) does not estimate the lever arm; the one it uses differs by 1 m"
        in neglected
    )
    assert "B does not estimate the lever arm" in told(result(off, lever_arm([0, 0, 0], 0.0)))
    sure = estimate("scale_error", 1.0, 0.05)
    assert "B states a smaller σ than A" in "".join(
        crosscheck(a, result(sure), efficient="A").notes
    )
    assert "B has the warning: residuals too large." in told(
        result(off, warnings=("residuals too large",))
    )
    bias = estimate("dvl_bias_m_s", [0.1, 0.0, 0.0], [0.01] * 3)
    assert "A does not estimate dvl_bias_m_s, which the other estimates" in told(result(off, bias))


def test_a_neglected_lever_arm_is_given_as_a_velocity() -> None:
    time = np.arange(100) / 10.0
    rph = np.stack([0.0 * time, 0.0 * time, 0.2 * time], axis=1)
    cov = np.tile(np.eye(3), (100, 1, 1))
    velocity = np.tile([4.0, 0.0, 0.0], (100, 1))
    turning = Trajectory(time, 0.1 * np.ones((100, 3)), velocity, rph, cov, cov, cov)
    a = result(estimate("scale_error", 1.0, 0.1), lever_arm([3.0, 4.0, 7.0]), trajectory=turning)
    b = result(estimate("scale_error", 9.0, 0.1), trajectory=turning)
    (text,) = crosscheck(a, b).explanation
    # 0.2 rad/s about the vertical, 5 m from it.
    assert "a velocity error of 1 m/s RMS, 25 % of the speed" in text


def test_other_trials_are_not_the_same_data() -> None:
    check = crosscheck(scale(1.0, 1.0), scale(1.0, 2.0, trial="another"), efficient="A")
    assert check.efficient is None
    assert one(check).kind == "upper bound"
    assert "A is from trial by hand, B from another" in check.notes[0]


def test_nothing_in_common_is_an_error() -> None:
    bare = replace(dense(1.0, 1.0), time=np.array([1e6]))
    with pytest.raises(DataError, match="nothing in common"):
        crosscheck(result(trajectory=bare), scale(1.0, 1.0))


FOREIGN = """
solver: vendor
misalignment_deg: [1.0, 2.0, 3.0]
scale_error: {value: 0.005, std: 1e-4}
lever_arm_m: {value: [1, 2, null], std: [0.1, null, null], observable: [true, false, true]}
"""


def foreign(tmp_path: Path, text: str, name: str = "b.yaml") -> Solution:
    save_solution(build_solution(), tmp_path / "a", force=True)
    (tmp_path / name).write_text(text)
    return load_results(tmp_path / "a", tmp_path / name)[1]


def test_calibration_from_elsewhere(tmp_path: Path) -> None:
    b = foreign(tmp_path, FOREIGN)
    assert b.solver == "vendor"
    assert b.body_axes == "FRD"
    assert b.trajectory.time.size == 0
    assert np.isnan(b.estimate("misalignment_deg").std).all()
    assert b.estimate("scale_error").std == [1e-4]
    np.testing.assert_array_equal(b.estimate("lever_arm_m").value, [1.0, 2.0, np.nan])
    np.testing.assert_array_equal(b.estimate("lever_arm_m").observable, [True, False, False])
    assert b.order[:4] == build_solution().order
    assert b.covariance[3, 3] == pytest.approx(1e-8)


def test_json_and_nested_parameters(tmp_path: Path) -> None:
    text = '{\t"parameters": {"scale_error": {"value": [1e-3, 2E-3, 0.003]}}, "body_axes": "RFU"}'
    b = foreign(tmp_path, text, "b.json")
    np.testing.assert_array_equal(b.estimate("scale_error").value, [1e-3, 2e-3, 3e-3])
    assert b.order == ("scale_error_x", "scale_error_y", "scale_error_z")
    assert b.body_axes == "RFU"


def test_trajectory_from_elsewhere(tmp_path: Path) -> None:
    trajectory = build_solution().trajectory
    columns = motion_columns(trajectory)
    write_table(tmp_path / "b.csv", columns)
    save_solution(build_solution(), tmp_path / "a")
    a, b = load_results(tmp_path / "a" / "calibration.json", tmp_path / "b.csv")
    assert b.estimates == ()
    check = crosscheck(a, b)
    assert check.motion is not None
    assert set(check.motion.kinds) == {"none"}
    for name in ("std_e_m", "std_n_m", "std_u_m"):
        columns[name] = np.full(4, 0.3)
    write_table(tmp_path / "b.csv", columns)
    (tmp_path / "b.yml").write_text("trajectory: b.csv\nscale_error: 0.005\n")
    motion = crosscheck(*load_results(tmp_path / "a", tmp_path / "b.yml")).motion
    assert motion is not None
    assert motion.kinds == ("upper bound",) * 3 + ("none",) * 6
    np.testing.assert_allclose(motion.std[:, 0], np.hypot(0.1, 0.3))


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("misalignment: [1, 2, 3]", "b.yaml", "b.yaml line 1: unknown key `misalignment`"),
        ("misalignment: [1, 2, 3]", "b.yaml", "Did you mean `misalignment_deg`"),
        ("solver: x\nlever_arm_m: [1, 2]", "b.yaml", "b.yaml line 2: lever_arm_m: "),
        ("lever_arm_m: [1, 2]", "b.yaml", "must have 3 numbers, not 2"),
        ("scale_error: [1, 2]", "b.yaml", "must have 1 or 3 numbers, not 2"),
        ("scale_error: {value: 1, std: [1, 2]}", "b.yaml", "as many numbers in `std` as in"),
        ("scale_error: {value: 1, std: -1}", "b.yaml", "`std` must be 0 or more"),
        ("scale_error: {value: 1, observable: [true, true]}", "b.yaml", "1 entries"),
        ("scale_error: .nan", "b.yaml", "must be finite"),
        ("scale_error: large", "b.yaml", "scale_error is 'large'; expected a number or"),
        ("scale_error: {valu: 1}", "b.yaml", "unknown key `scale_error.valu`"),
        ("scale_error: 1\nparameters: {scale_error: 1}", "b.yaml", "all values in `parameters`"),
        ("solver: vendor", "b.yaml", "there are no calibration values"),
        ("trajectory: none.csv\nscale_error: 1", "b.yaml", "none.csv: the file does not exist"),
        ('{"scale_error": 1,\n}', "b.json", "b.json line 2: not valid JSON"),
        ("time_s,lat_deg\n1,2\n", "b.csv", "b.csv line 1: missing column"),
        ("scale_error: 1", "b.txt", "the suffix `.txt` says nothing; expected .csv"),
        ("scale_error: 1", "b", "has no suffix"),
    ],
)
def test_bad_results_from_elsewhere(tmp_path: Path, text: str, name: str, expected: str) -> None:
    with pytest.raises(FactorgraphDvlError) as caught:
        foreign(tmp_path, text, name)
    assert caught.value.exit_code == 2
    assert expected in str(caught.value)


def test_every_parameter_of_a_sensor_may_come_from_elsewhere(tmp_path: Path) -> None:
    text = """star_mounting_deg: [1, 2, 3]
sound_speed_error: 0.002
heading_bias_deg: 0.5
log_scale_error: 0.01
beacon_B1_offset_m: {value: [1, 2, 3], std: [0.1, 0.2, 0.3]}
beam_scale_error: [0.001, 0.002, 0.003, 0.004]
"""
    b = foreign(tmp_path, text)
    assert b.estimate("beacon_B1_offset_m").component_names == (
        "beacon_B1_offset_e_m",
        "beacon_B1_offset_n_m",
        "beacon_B1_offset_u_m",
    )
    assert {f"beam_scale_error_{i}" for i in range(1, 5)} < set(b.order)
    nested = {"parameters": {e.name: {"value": e.value.tolist()} for e in b.estimates}}
    (tmp_path / "truth.json").write_text(json.dumps(nested))
    truth = read_truth(tmp_path / "truth.json")
    assert truth.keys() == {e.name for e in b.estimates}
    for text, expected in (
        ("beacon_B1_offset_m: [1, 2]", "must have 3 numbers, not 2"),
        ("beacon_offset_m: [1, 2, 3]", "unknown key `beacon_offset_m`"),
    ):
        with pytest.raises(FactorgraphDvlError, match=expected):
            foreign(tmp_path, text)


def test_bad_sigmas_of_a_trajectory(tmp_path: Path) -> None:
    columns = motion_columns(build_solution().trajectory)
    for name in ("std_e_m", "std_n_m", "std_u_m"):
        columns[name] = np.array([0.1, 0.1, 0.0, 0.1])
    write_table(tmp_path / "b.csv", columns)
    with pytest.raises(DataError, match=r"b\.csv line 4: std_e_m = 0 is out of range"):
        load_results(tmp_path / "b.csv", tmp_path / "b.csv")


def test_folders_that_are_no_results(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    with pytest.raises(DataError, match="is a trial folder; expected a solution folder"):
        load_results(trial, trial)
    with pytest.raises(DataError, match="the result does not exist"):
        load_results(tmp_path / "none", trial)


def test_truth(tmp_path: Path) -> None:
    trial = write_trial(tmp_path)
    (tmp_path / "truth.yaml").write_text("scale_error: 0.007\nlever_arm_m: [1, 2, 3]\n")
    motion, values = load_truth(trial, tmp_path / "truth.yaml")
    assert motion is not None
    assert motion.time.size == 60
    assert {k: v.tolist() for k, v in values.items()} == {
        "misalignment_deg": [1.0, 2.0, 3.0],
        "scale_error": [0.007],
        "lever_arm_m": [1.0, 2.0, 3.0],
    }
    assert load_truth(None, None) == (None, {})
    motion, values = load_truth(trial / "reference.csv", None)
    assert motion is not None
    assert values == {}
    with pytest.raises(DataError, match="is not a file of calibration values"):
        read_truth(trial / "imu.csv")
    bare = replace(build_trial(), reference=None, calibration_truth={})
    (tmp_path / "bare").mkdir()
    with pytest.raises(DataError, match="the trial has no truth"):
        load_truth(write_trial(tmp_path / "bare", bare), None)


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*args: str | Path) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            main(["crosscheck", *map(str, args)])
        assert isinstance(caught.value.code, int)
        text = capsys.readouterr()
        return caught.value.code, " ".join(text.out.split()), text.err

    return call


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    a = build_solution()
    misalignment, scale_error = a.estimates
    b = replace(
        a,
        solver="kalman-point-set",
        estimates=(misalignment, replace(scale_error, value=scale_error.value + 1e-3)),
        trajectory=moved(a.trajectory, 0.2),
    )
    save_solution(a, tmp_path / "a")
    save_solution(b, tmp_path / "b")
    return tmp_path / "a", tmp_path / "b"


def reject(text: str) -> float:
    raise ValueError(f"{text} is not JSON")


# A division by zero or a nan on its way to a figure warns, and fails here.
@pytest.mark.filterwarnings("error")
def test_command(tmp_path: Path, run: Run, folders: tuple[Path, Path]) -> None:
    trial, out = write_trial(tmp_path), tmp_path / "out"
    code, text, err = run(*folders, "--reference", trial, "--efficient", "a", "--out", out)
    assert code == 0, err
    names = {p.name for p in out.iterdir()}
    files = {"crosscheck.json", "crosscheck.csv", "differences.csv"}
    assert names == files | {"parameters.png", "differences.png", "errors.png"}
    for shown in ("upper bound", "Hausman 1978", "2 agree, 1 differ"):
        assert shown in text
    assert "models the error of its inertial velocity as white noise" in text
    found = json.loads((out / "crosscheck.json").read_text(), parse_constant=reject)
    assert found["b"] == {
        "file": str(folders[1]),
        "trial": "by hand",
        "solver": "kalman-point-set",
        "converged": True,
    }
    verdicts = {c["name"]: c["verdict"] for c in found["components"]}
    assert verdicts["misalignment_x_deg"] == "agree"
    assert verdicts["misalignment_z_deg"] == "not comparable"
    assert verdicts["scale_error"] == "differ"
    assert found["efficient"] == "A"
    assert found["joint"]["verdict"] == "differ"
    assert found["trajectory"]["components"]["u_m"]["rms"] == pytest.approx(0.2)
    assert found["truth"]["a"]["calibration"]["error"][0] == pytest.approx(1.0 / 3.0)
    with (out / "crosscheck.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["verdict"] for row in rows] == list(verdicts.values())
    assert rows[0]["std_hausman"] == ""
    assert float(rows[3]["difference"]) == pytest.approx(-1e-3)
    with (out / "differences.csv").open() as file:
        header, first = list(csv.reader(file))[:2]
    assert header[:2] == ["time_s", "diff_e_m"]
    assert float(first[header.index("diff_u_m")]) == pytest.approx(-0.2)


def test_command_options_and_bad_input(
    tmp_path: Path, run: Run, folders: tuple[Path, Path]
) -> None:
    out = tmp_path / "out"
    assert run(*folders, "--out", out, "--no-figures")[0] == 0
    assert not list(out.glob("*.png"))
    (out / "mine.txt").write_text("kept")
    code, _, err = run(*folders, "--out", out)
    assert code == 2
    assert "is not empty" in err
    line = edit(folders[1] / "trajectory.csv", "lat_deg", "latitude")
    before = (out / "crosscheck.json").read_bytes()
    code, _, err = run(*folders, "--out", out, "--force")
    assert code == 2
    assert f"trajectory.csv line {line}: missing column lat_deg" in err
    assert (out / "crosscheck.json").read_bytes() == before
    edit(folders[1] / "trajectory.csv", "latitude", "lat_deg")
    assert run(*folders, "--out", out, "--force")[0] == 0
    assert (out / "mine.txt").exists()
    assert (out / "parameters.png").stat().st_size > 1000
    code, _, err = run(*folders, "--out", tmp_path / "new", "--efficient", "C")
    assert code == 2
    assert not (tmp_path / "new").exists()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["luo-2024.yaml", "survey.json", "survey-trajectory.csv"])
def test_examples(tmp_path: Path, run: Run, name: str) -> None:
    """Each file of the documentation against another result of that trial."""
    luo, survey = EXAMPLES / "luo-2024.yaml", EXAMPLES / "survey.json"
    other = survey if name == "luo-2024.yaml" else luo
    if name == "survey-trajectory.csv":
        other = survey
    shipped = EXAMPLES.parent.parent / "data" / "seed-a-phase-90"
    out = tmp_path / "out"
    code, text, err = run(EXAMPLES / name, other, "--reference", shipped, "--out", out)
    assert code == 0, err
    assert "Wrote" in text
    found = json.loads((out / "crosscheck.json").read_text(), parse_constant=reject)
    assert found["a"]["file"].endswith(name)
    assert found["truth"] is not None


def test_documentation_s_calibration_is_read(tmp_path: Path) -> None:
    text = (EXAMPLES.parent.parent / "docs" / "crosscheck.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", text, flags=re.DOTALL)
    b = foreign(tmp_path, block)
    assert [e.name for e in b.estimates] == ["misalignment_deg", "scale_error", "lever_arm_m"]


def test_saved_solutions_agree_with_themselves(folders: tuple[Path, Path]) -> None:
    a = load_solution(folders[0])
    check = crosscheck(a, a, efficient="A")
    assert {c.verdict for c in check.components} == {"agree", "not comparable"}
    assert check.explanation == ()
    assert check.joint is not None
    assert check.joint.statistic == 0.0
