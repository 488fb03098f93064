"""The patent of Harbin Engineering University: angles of single beams on a turntable."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from factorgraph_dvl.analysis.beam_angles import BeamAngles, beam_angles
from factorgraph_dvl.analysis.beam_quality import calibration_of
from factorgraph_dvl.analysis.error_statistics import calibration_errors, trajectory_errors
from factorgraph_dvl.baselines import kalman
from factorgraph_dvl.baselines.navigation import motion_at, navigate
from factorgraph_dvl.geometry.rotations import log_so3, rotation_from_rph
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate
from factorgraph_dvl.reproduce.entry import Entry, Paper, Result, judged, scenario, table
from factorgraph_dvl.sensors.beam_geometry import group_velocities, groups
from factorgraph_dvl.sensors.dvl_beams import DvlBeamsSettings
from factorgraph_dvl.simulation import plan_motion, simulate
from factorgraph_dvl.solution import Solution
from factorgraph_dvl.trial import Trial

# Plain GNSS in place of RTK, m and m/s.
_PLAIN = {"position_std_m": (0.5, 0.5, 1.0), "velocity_std_m_s": (0.05, 0.05, 0.1)}
_GROUPS = ("123", "124", "134", "234")
# Chosen: what counts as zero, relative.
_ZERO = 1e-9
# Signs of x and y of beams in octants V to VIII.
_SIGNS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


@dataclass(frozen=True)
class _Run:
    trial: Trial
    solution: Solution
    angles: BeamAngles
    true_angles: Array


@lru_cache(maxsize=2)
def _run(gnss: str) -> _Run:
    given = scenario("beams-turntable")
    if gnss == "plain":
        assert given.gnss is not None
        given = msgspec.structs.replace(given, gnss=msgspec.structs.replace(given.gnss, **_PLAIN))
    trial = simulate(given, 0)
    solution = kalman(trial, "beams", rate_hz=1.0)
    angles = beam_angles(solution)
    assert angles is not None
    true = np.array(trial.calibration_truth["beam_direction_b"])
    return _Run(trial, solution, angles, _angles(true))


def _angles(directions: Array) -> Array:
    """Return alpha and theta of unit vectors in axes right, forward, up, (N, 2), deg."""
    alpha, theta = np.arcsin(np.abs(directions[:, 0])), np.arcsin(-directions[:, 2])
    return np.column_stack([alpha, theta]) / DEG


def _step_1(seeds: int) -> Result:
    given = [(20.7, 60.0), (21.0, 59.0), (20.0, 61.0), (22.0, 58.0)]
    nominal = DvlBeamsSettings(alpha_theta_deg=tuple(given)).nominal_d
    alpha, theta = np.array(given).T * DEG
    y = np.sqrt(1.0 - np.sin(alpha) ** 2 - np.sin(theta) ** 2)
    printed = np.column_stack([_SIGNS[:, 0] * np.sin(alpha), _SIGNS[:, 1] * y, -np.sin(theta)])
    apart = float(np.abs(printed - nominal).max())
    octants = bool(np.all(np.sign(nominal[:, :2]) == _SIGNS) and np.all(nominal[:, 2] < 0.0))
    return Result(
        f"beams 1 to 4 in octants V to VIII: {'yes' if octants else 'no'}; their vectors from α "
        "and θ to "
        f"{apart:.0e}",
        judged(octants and apart < _ZERO),
    )


def _step_2(seeds: int) -> Result:
    given = scenario("beams-turntable")
    motion = plan_motion(given)
    duration = motion.duration
    time = np.array([0.25, 0.75]) * duration
    bodies = rotation_from_rph(motion.at(time).rph, "RFU")
    ships = rotation_from_rph(motion.ship_at(time).rph, "RFU")
    turn = ships.transpose(0, 2, 1) @ bodies
    angle = np.degrees(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
    assert given.turntable is not None
    at = given.turntable.turns[0].at_s / duration
    return Result(
        f"IMU and DVL turned by {abs(angle[1] - angle[0]):.1f}° at {100 * at:.0f} % of "
        f"{duration:.0f} s",
        judged(bool(abs(abs(angle[1] - angle[0]) - 90.0) < 0.1 and abs(at - 0.5) < 0.05)),
    )


def _step_3(seeds: int) -> Result:
    run = _run("RTK")
    beams = run.trial.beams
    assert beams is not None
    calibrated = calibration_of(beams, run.solution)
    scale = 1.0 + np.array(run.trial.calibration_truth["beam_scale_error"])
    true = scale[:, None] * np.array(run.trial.calibration_truth["beam_direction_b"])
    exact = _random() @ true.T
    off = float(np.abs(group_velocities(true, exact) - _random()[:, None]).max())
    nominal = group_velocities(beams.nominal_b, beams.velocity)
    gain = (1.0 + calibrated.scale_error)[:, None] * calibrated.directions_b
    corrected = group_velocities(gain, beams.velocity)

    def contradict(v: Array) -> Array:
        return np.asarray(
            np.sqrt(np.nanmean((v - v.mean(axis=1, keepdims=True)) ** 2, axis=(0, 2)))
        )

    before, after = contradict(nominal), contradict(corrected)
    names = ["".join(str(i + 1) for i in g) for g in groups(beams.nominal_b)]
    rows = [
        [name, f"{1e3 * a:.1f}", f"{1e3 * b:.1f}"]
        for name, a, b in zip(names, before, after, strict=True)
    ]
    return Result(
        f"groups {', '.join(names)}, exact to {off:.0e} m/s with the true beams; they "
        "contradict their mean by "
        f"{1e3 * before.mean():.0f} mm/s with nominal beams, {1e3 * after.mean():.1f} mm/s with "
        "calibrated ones",
        judged(tuple(names) == _GROUPS and off < 1e-9),
        table(["group", "nominal beams, mm/s", "calibrated, mm/s"], rows),
    )


def _random() -> Array:
    return np.random.default_rng(0).normal(0.0, 2.0, (50, 3))


def _step_4(seeds: int) -> Result:
    v, phi = _random()[:1], np.array([1e-4, -2e-4, 3e-4])
    nRb = rotation_from_rph(np.array([0.05, -0.03, 0.7]), "RFU")
    # Velocity of a group in n' by a wrong attitude, against that with the error to first order.
    level = rotate(nRb[None], v)
    wrong = level - np.cross(phi, level)
    exact = rotate((np.eye(3) - _skew(phi)) @ nRb[None], v)
    apart = float(np.abs(wrong - exact).max())
    return Result(
        "claim 6 of the copy breaks off in the error equations; v_n' = v_n − φ × v_n holds to "
        f"{apart:.0e}, "
        "and the filter of single beams is derived from it",
        judged(False, apart < _ZERO),
    )


def _skew(v: Array) -> Array:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _step_5(seeds: int) -> Result:
    run = _run("RTK")
    trial = run.trial
    assert trial.reference is not None
    corrected = trajectory_errors(run.solution, trial.reference).attitude
    assert trial.beams is not None
    motion = motion_at(navigate(trial, np.empty(0)), run.solution.trajectory.time)
    truth_row = np.searchsorted(trial.reference.time, motion.time - 1e-6)
    truth = rotation_from_rph(trial.reference.rph[truth_row], trial.body_axes)
    before = log_so3(truth @ motion.nRb.transpose(0, 2, 1))
    rms_before = float(np.sqrt(np.mean(np.sum(before**2, axis=1)))) / DEG
    rms_after = float(np.sqrt(np.mean(np.sum(corrected.error**2, axis=1)))) / DEG
    nees = float(corrected.nees.mean())
    return Result(
        f"RMS attitude error of SINS/GNSS {1e3 * rms_before:.2f}e-3°, with φ of the filter "
        f"{1e3 * rms_after:.2f}e-3°, mean NEES {nees:.1f} (3 expected)",
        judged(rms_after < rms_before),
        (
            "SINS/GNSS is smoothed over the whole trial and knows its attitude to thousandths of "
            "a degree already; beams whose own directions are unknown add nothing to that.",
        ),
    )


def _step_6(seeds: int) -> Result:
    run = _run("RTK")
    found = np.column_stack([run.angles.alpha, run.angles.theta])
    std = np.column_stack([run.angles.alpha_std, run.angles.theta_std])
    nominal = np.column_stack([run.angles.alpha_nominal, run.angles.theta_nominal])
    error = found - run.true_angles
    rows = [
        [
            f"{i + 1}",
            *(
                f"{nominal[i, j]:.3f}, {found[i, j]:.4f} ± {std[i, j]:.4f}, "
                f"{run.true_angles[i, j]:.4f}"
                for j in range(2)
            ),
        ]
        for i in range(4)
    ]
    worst = float(np.abs(error / std).max())
    before = float(np.abs(nominal - run.true_angles).max())
    return Result(
        f"α_i, θ_i from up to {before:.2f}° off to {np.abs(error).max():.4f}°; σ at most "
        f"{std.max():.4f}°, "
        f"largest error {worst:.1f} σ",
        judged(worst < 4.5 and float(np.abs(error).max()) < 0.05),
        table(
            ["beam", "α: nominal, found ± σ, true, deg", "θ: nominal, found ± σ, true, deg"], rows
        ),
    )


def _gnss(seeds: int) -> Result:
    rtk, plain = _run("RTK"), _run("plain")
    rows, largest = [], {}
    for name, run in (("RTK", rtk), ("plain GNSS", plain)):
        errors = calibration_errors(run.solution, run.trial.calibration_truth)
        std = max(float(run.angles.alpha_std.max()), float(run.angles.theta_std.max()))
        error = np.abs(
            np.column_stack([run.angles.alpha, run.angles.theta]) - run.true_angles
        ).max()
        largest[name] = float(error)
        worst = float(np.abs(errors.error / np.sqrt(np.diag(errors.covariance)))[:12].max())
        rows.append([name, f"{std:.4f}", f"{error:.4f}", f"{worst:.1f}"])
    return Result(
        f"largest error of an angle {largest['RTK']:.4f}° with RTK, "
        f"{largest['plain GNSS']:.4f}° with plain "
        "GNSS of 0.5 m and 0.05 m/s",
        judged(largest["plain GNSS"] < 0.1),
        table(["GNSS", "largest σ, deg", "largest error, deg", "largest error / σ"], rows),
    )


def _asymmetry(seeds: int) -> Result:
    run = _run("RTK")
    truth = np.array(run.trial.calibration_truth["beam_direction_b"])
    beams = run.trial.beams
    assert beams is not None
    # The best common rotation and scale of the nominal beams.
    gain, *_ = np.linalg.lstsq(beams.nominal_b, truth, rcond=None)
    u, _, vt = np.linalg.svd(gain)
    left = beams.nominal_b @ (u @ vt) - truth
    return Result(
        "the best common rotation leaves the beams "
        f"{np.degrees(np.linalg.norm(left, axis=1).max()):.2f}° off: "
        f"{3.0 * np.linalg.norm(left, axis=1).max():.3f} m/s at 3 m/s",
        judged(bool(np.linalg.norm(left, axis=1).max() > 1e-3)),
    )


_FILTER = "`kalman --method beams`"
BEAMS = Paper(
    "beams",
    "Cao Z., Sun D., Liu B., Zhang D., Liu X. (Harbin Engineering University): A method to "
    "correct the "
    "radial beam angles of acoustic Doppler velocimetry (patent application)",
    (
        Entry("claim 2, step 1", "α_i, θ_i; octants V to VIII", "`sensors/dvl_beams`", _step_1),
        Entry(
            "claim 3, step 2",
            "turntable by 90° half-way",
            "`configs/beams-turntable.yaml`",
            _step_2,
        ),
        Entry(
            "claim 4, claim 5, step 3",
            "velocities of four groups",
            "`sensors/beam_geometry`",
            _step_3,
        ),
        Entry("claim 6, step 4", "error equations, EKF", "`baselines/beam_filter`", _step_4),
        Entry("step 5", "the filter corrects the SINS", _FILTER, _step_5),
        Entry("claim 1, step 6", "corrected α_i, θ_i", "`analysis/beam_angles`", _step_6),
        Entry("background", "beams are not symmetric", "`solve`", _asymmetry),
        Entry("step 2 (GPS)", "velocity from GPS", _FILTER, _gnss),
    ),
)
