"""What the page says to enter is right: a DVL that is configured so has nothing left to calibrate.

Each maker's rule is written out here from what its numbers mean, and shares nothing with the
package but the numbers that are printed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from truth import scenario

from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.report.entries import entries_table
from factorgraph_dvl.report.table import plain
from factorgraph_dvl.simulation import simulate
from factorgraph_dvl.solvers.batch import solve
from factorgraph_dvl.trial import Trial

# Axes x, y, z of a record, a row each, in forward, starboard, down.
AXES = {
    "FRD": np.eye(3),
    "RFU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "FLU": np.diag([1.0, -1.0, -1.0]),
}
TILTED = {"misalignment_deg": [2.0, -1.5, 30.0], "lever_arm_m": [1.2, 0.7, -1.4]}
TURNED = {"misalignment_deg": [0.0, 0.0, -45.0], "lever_arm_m": [-2.0, 0.3, 1.1]}


def trdi(typed: dict[str, float], velocity: np.ndarray) -> np.ndarray:
    """Return ship velocities, starboard, forward, up, from X, Y, Z of a Pathfinder.

    TRDI's transformation by heading, pitch and roll (ADCP Coordinate Transformation, eq. 18)
    takes axes X to starboard, Y ahead, Z up of a tilted body to level ones. EI and EJ are the roll
    and pitch of the ship where the instrument is level, and EA is the heading of the instrument
    less that of the ship.
    """
    H, P, R = (np.radians(0.01 * typed[f"TRDI {name}"]) for name in ("EA", "EJ", "EI"))
    H = -H
    CH, SH, CP, SP, CR, SR = (f(a) for a in (H, P, R) for f in (np.cos, np.sin))
    ship_to_instrument = np.array([
        [CH * CR + SH * SP * SR, SH * CP, CH * SR - SH * SP * CR],
        [-SH * CR + CH * SP * SR, CH * CP, -SH * SR - CH * SP * CR],
        [-CP * SR, SP, CP * CR],
    ])  # fmt: skip
    return velocity @ ship_to_instrument


def nortek(typed: dict[str, float], velocity: np.ndarray) -> np.ndarray:
    """Return velocities forward, starboard, down: the vehicle yaws, pitches, rolls to the DVL."""
    angles = [typed[f"Nortek {name}"] for name in ("yaw", "pitch", "roll")]
    return Rotation.from_euler("ZYX", angles, degrees=True).apply(velocity)


def water_linked(typed: dict[str, float], velocity: np.ndarray) -> np.ndarray:
    """Return velocities forward, starboard, down: the DVL's x axis is clockwise of the bow.

    The DVL turns what it sends about its own z axis; the navigation software turns that by the
    angles that are left.
    """
    angle = np.radians(typed["Water Linked mounting rotation offset"])
    x, y, z = velocity.T
    forward = x * np.cos(angle) - y * np.sin(angle)
    sent = np.stack([forward, x * np.sin(angle) + y * np.cos(angle), z], axis=1)
    left = [typed[f"after the offset: {name}"] for name in ("yaw", "pitch", "roll")]
    return Rotation.from_euler("ZYX", left, degrees=True).apply(sent)


def delph(typed: dict[str, float], velocity: np.ndarray) -> np.ndarray:
    """Return velocities along XV1 forward, XV2 port, XV3 up.

    Heading is clockwise from above, against XV3; pitch is bow down, about XV2; roll is port side
    up, about XV1.
    """
    heading, pitch, roll = (typed[f"Delph {name}"] for name in ("heading", "pitch", "roll"))
    return Rotation.from_euler("ZYX", [-heading, pitch, roll], degrees=True).apply(velocity)


def lever_arm(typed: dict[str, float]) -> np.ndarray:
    """Return the lever arm forward, starboard, down, m: the INS has its own names for it."""
    if "Delph XV1" in typed:
        return np.array([typed["Delph XV1"], -typed["Delph XV2"], -typed["Delph XV3"]])
    return np.array([typed[f"lever arm {name}"] for name in ("forward", "starboard", "down")])


def turn_rate(trial: Trial, time: np.ndarray) -> np.ndarray:
    """Return turn rates (M, 3), rad/s, forward, starboard, down, from the true attitude."""
    step = 1e-3
    rph = CubicSpline(trial.reference.time, np.unwrap(trial.reference.rph, axis=0))
    time = np.clip(time, trial.reference.time[0] + step, trial.reference.time[-1] - step)
    before, after = (
        Rotation.from_matrix(rotation_from_rph(rph(time + s), trial.body_axes))
        for s in (-step, step)
    )
    return (before.inv() * after).as_rotvec() / (2.0 * step) @ AXES[trial.body_axes]


def printed(solution, maker: str) -> dict[str, float]:
    """Return the numbers that the page prints, by the names that it gives them."""
    rows = entries_table(instrument_of(solution), maker).rows
    return {plain(row[0]): float(plain(row[1]).partition(" ±")[0]) for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maker", "axes", "recorded", "mount", "configured"),
    [
        ("Teledyne RDI Pathfinder", "RFU", "RFU", TILTED, trdi),
        ("Teledyne RDI Pathfinder", "RFU", "RFU", TURNED, trdi),
        ("Nortek DVL1000", "FRD", "FRD", TILTED, nortek),
        ("Nortek DVL1000", "FRD", "FRD", TURNED, nortek),
        ("Water Linked A50", "FRD", "FRD", TILTED, water_linked),
        ("Water Linked A50", "FRD", "FRD", TURNED, water_linked),
        ("Exail Delph INS", "FLU", "FLU", TILTED, delph),
        ("Exail Delph INS", "FLU", "FLU", TURNED, delph),
        # The DVL measures in its maker's axes, and the IMU in others.
        ("Teledyne RDI Pathfinder", "FRD", "RFU", TILTED, trdi),
        ("Nortek DVL1000", "RFU", "FRD", TILTED, nortek),
        ("Water Linked A50", "FLU", "FRD", TILTED, water_linked),
    ],
)
def test_a_dvl_configured_as_printed_has_no_misalignment_and_no_lever_arm(
    maker, axes, recorded, mount, configured
):
    trial = simulate(scenario(body_axes=axes, dvl=mount | {"scale_error": 0.01}), 0)
    to_recorded = AXES[axes] @ AXES[recorded].T
    velocity = trial.dvl.velocity @ to_recorded
    solution = solve(replace(trial, dvl=replace(trial.dvl, velocity=velocity)))
    typed = printed(solution, maker)
    # What the DVL reports then, and what the INS makes of it, in axes of the body.
    velocity = configured(typed, velocity) @ to_recorded.T / (1.0 + 0.01 * typed["scale error"])
    arm = np.cross(turn_rate(trial, trial.dvl.time), lever_arm(typed)) @ AXES[axes].T
    again = solve(replace(trial, dvl=replace(trial.dvl, velocity=velocity - arm)))
    limits = {
        "misalignment_deg": (1.0, 0.02),
        "lever_arm_m": (0.5, 0.01),
        "scale_error": (5e-3, 1e-3),
    }
    for name, (before, after) in limits.items():
        assert np.abs(solution.estimate(name).value).max() > before
        assert np.abs(again.estimate(name).value).max() < after, name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maker", "axes", "prefix"),
    [("Teledyne RDI Pathfinder", "RFU", "TRDI "), ("Water Linked A50", "FRD", "Water Linked ")],
)
def test_no_maker_is_given_numbers_that_would_make_its_dvl_look_up(maker, axes, prefix):
    """Turned by 180 deg about the axis that points ahead, the DVL is upside down."""
    ahead = [0.0, 180.0, 0.0] if axes == "RFU" else [180.0, 0.0, 0.0]
    level = {"lever_arm_m": [1.0, 0.5, 0.2]}
    upright, turned = (
        printed(solve(simulate(scenario(body_axes=axes, dvl=level | mount), 0)), maker)
        for mount in ({"misalignment_deg": [1.0, 1.0, 1.0]}, {"misalignment_deg": ahead})
    )
    assert any(name.startswith(prefix) for name in upright)
    assert not any(name.startswith(prefix) for name in turned)
