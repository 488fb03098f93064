"""What is typed into instruments gives the misalignment back, with the signs it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from builders import build_solution
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.instrument_terms import ORDERS, instrument_of, transceiver_of
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.geometry.rotations import exp_so3, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.report.files.instrument import instrument_text

STD = np.array([0.02, 0.03, 0.04])


def rotation_of(angles, order, body_axes):
    """Return the rotation, in body axes, of roll, pitch and yaw, deg."""
    given = angles[::-1] if order == "ZYX" else angles
    frd = frd_from_body(body_axes)
    return frd.T @ Rotation.from_euler(order, given, degrees=True).as_matrix() @ frd


def calibrated(alpha_deg, body_axes="RFU"):
    def estimate(name, value, std):
        n = np.size(value)
        names = tuple(f"{name}_{i}" for i in range(n))
        value, std = np.atleast_1d(value).astype(float), np.atleast_1d(std).astype(float)
        return Estimate(name, names, value, std, value, std, np.ones(n, dtype=bool))

    estimates = (
        estimate("misalignment_deg", alpha_deg, STD),
        estimate("scale_error", 0.0177, 1e-5),
        estimate("lever_arm_m", [-0.93, 1.12, -0.34], [0.01, 0.02, 0.03]),
    )
    std = np.concatenate([e.std for e in estimates])
    return replace(
        build_solution(), body_axes=body_axes, estimates=estimates, covariance=np.diag(std**2)
    )


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
@pytest.mark.parametrize("alpha", [[1.68, 2.10, 16.45], [-20.0, 35.0, 140.0], [0.0, 0.0, -90.0]])
def test_angles_give_the_misalignment_back(alpha, body_axes):
    dRb = exp_so3(np.array(alpha) * DEG)
    found = instrument_of(calibrated(alpha, body_axes))
    for order in ORDERS:
        np.testing.assert_allclose(
            rotation_of(found.body_to_dvl[order].value, order, body_axes), dRb, atol=1e-12
        )
        np.testing.assert_allclose(
            rotation_of(found.dvl_in_body[order].value, order, body_axes), dRb.T, atol=1e-12
        )


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_what_to_enter_in_a_usbl_is_the_attitude_of_its_transceiver(body_axes):
    """Bow up by 2 deg, then roll: in the text with the angles by which it is mounted."""
    roll, pitch, heading = 1.0, 2.0, -3.0
    attitude = rotation_of(np.array([roll, pitch, heading]), "ZYX", body_axes)
    alpha = Rotation.from_matrix(attitude.T).as_rotvec(degrees=True)
    dvl = calibrated([0.0, 0.0, 0.0], body_axes)
    names = ("usbl_misalignment_deg", "usbl_sound_speed_error")
    added = tuple(
        replace(e, name=name, value=value)
        for name, e, value in zip(names, dvl.estimates, (alpha, np.array([-0.002])), strict=False)
    )
    std = np.concatenate([e.std for e in (*dvl.estimates, *added)])
    both = replace(dvl, estimates=(*dvl.estimates, *added), covariance=np.diag(np.square(std)))
    assert transceiver_of(dvl) is None
    terms = transceiver_of(both)
    np.testing.assert_allclose(terms.attitude.value, [roll, pitch, heading], atol=1e-9)
    assert 0.019 < terms.attitude.std.min() < terms.attitude.std.max() < 0.041
    entered = yaml.safe_load(instrument_text(both))["enter_in_usbl"]
    assert entered == {
        "roll_deg": 1.0, "pitch_deg": 2.0, "heading_deg": -3.0, "range_error_percent": -0.2,
    }  # fmt: skip
    assert "enter_in_usbl" not in yaml.safe_load(instrument_text(dvl))


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_trdi_commands_take_ship_to_instrument_coordinates(body_axes):
    # Mounted as TRDI says: beam 3 turned 30 deg to starboard; level when the ship rolls 2 deg
    # and pitches -1 deg. Written with elementary rotations, in starboard, forward, mast.
    clockwise, roll, pitch = 30.0, 2.0, -1.0
    about = {"starboard": "x", "forward": "y", "mast": "z"}

    def turn(axis, angle):
        return Rotation.from_euler(about[axis], angle, degrees=True).as_matrix()

    # Heading of the ship seen from the instrument: 30 deg to port, mathematically positive.
    ship_in_level = turn("mast", clockwise) @ turn("starboard", pitch) @ turn("forward", roll)
    sRb = frd_from_body("RFU").T @ frd_from_body(body_axes)
    alpha = Rotation.from_matrix(ship_in_level @ sRb).as_rotvec(degrees=True)
    found = instrument_of(calibrated(alpha, body_axes))
    np.testing.assert_allclose(found.alignment, [30.0, 2.0, -1.0], atol=1e-9)


def test_signs_by_hand():
    # A DVL that is turned to starboard sees a ship that moves ahead go to port.
    found = instrument_of(calibrated([0.0, 0.0, 10.0]))
    ahead_d = exp_so3(np.array([0.0, 0.0, 10.0]) * DEG) @ [0.0, 1.0, 0.0]
    assert ahead_d[0] < 0.0
    assert found.dvl_in_body["ZYX"].value == pytest.approx([0.0, 0.0, 10.0])
    assert found.alignment == pytest.approx([10.0, 0.0, 0.0])
    np.testing.assert_allclose(found.lever_arm, [1.12, -0.93, 0.34])


@pytest.mark.slow
def test_standard_deviations_are_those_of_the_angles():
    alpha = np.array([10.0, -25.0, 60.0])
    found = instrument_of(calibrated(alpha))
    rng = np.random.default_rng(0)
    draws = [
        instrument_of(calibrated(alpha + STD * rng.standard_normal(3))) for _ in range(400)
    ]  # fmt: skip
    for spread, std in (
        (np.std([d.alignment for d in draws], axis=0), found.alignment_std),
        (
            np.std([d.dvl_in_body["XYZ"].value for d in draws], axis=0),
            found.dvl_in_body["XYZ"].std,
        ),
    ):
        # 400 draws: chance is 3.5 %.
        np.testing.assert_allclose(spread, std, rtol=0.15)


def test_text_is_yaml_and_states_the_commands():
    text = instrument_text(calibrated([0.0, 0.0, 16.45]))
    data = yaml.safe_load(text)
    assert data["trdi"] == {"EA": 1645, "EI": 0, "EJ": 0}
    assert "EA+01645" in text
    assert "#EI+00000" in text
    assert data["scale_error_percent"] == [1.77]
    assert data["scale_error_ppm"] == [17700]
    assert data["scale_factor"] == pytest.approx([1.0 / 1.0177], abs=1e-6)


@pytest.mark.parametrize(
    ("maker", "recorded", "body_axes"),
    [
        ("trdi", "FRD", "FRD"),
        *(("trdi", "RFU", body_axes) for body_axes in ("RFU", "FRD", "FLU")),
        *(
            (maker, recorded, body_axes)
            for maker in ("nortek", "water_linked")
            for recorded in ("RFU", "FRD", "FLU")
            for body_axes in ("RFU", "FRD", "FLU")
            if recorded in ("FRD", body_axes)
        ),
    ],
)
def test_recorded_axes_are_those_of_the_maker_or_of_the_body(maker, recorded, body_axes):
    # Turned by 30 deg to starboard, and recorded with axes of these names.
    dRb = Rotation.from_euler("z", -30.0, degrees=True).as_matrix()
    turned = frd_from_body(recorded).T @ dRb @ frd_from_body(body_axes)
    alpha = Rotation.from_matrix(turned).as_rotvec(degrees=True)
    text = instrument_text(calibrated(alpha.tolist(), body_axes))
    (own_part,) = (part for part in text.split("\n\n") if f"\n{maker}:\n" in part)
    assert "DO NOT TYPE IN" not in own_part
    assert (
        yaml.safe_load(text)[maker]
        == {
            "trdi": {"EA": 3000, "EI": 0, "EJ": 0},
            "nortek": {"roll_pitch_yaw_deg": [0.0, 0.0, 30.0]},
            "water_linked": {
                "mounting_rotation_offset": 30.0,
                "roll_pitch_yaw_after_offset_deg": [0.0, 0.0, 0.0],
            },
        }[maker]
    )


def test_a_dvl_that_looks_up_gets_no_numbers():
    text = instrument_text(calibrated([0.0, 180.0, 0.0]))
    (trdi,) = (part for part in text.split("\n\n") if "\ntrdi:\n" in part)
    assert "DO NOT TYPE IN" in trdi


def test_half_a_turn_is_within_the_range_of_the_command():
    text = instrument_text(calibrated([0.0, 0.0, -180.0]))
    assert yaml.safe_load(text)["trdi"]["EA"] == 18000


def test_a_calibration_without_a_dvl_is_refused():
    with pytest.raises(DataError, match="no lever_arm_m"):
        instrument_of(build_solution())


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_each_maker_s_numbers_give_the_mounting_back_by_its_rule(body_axes):
    """A velocity of the ship goes through the mounting, and comes back by the typed numbers."""
    alpha = frd_from_body(body_axes).T @ np.array([1.2, -2.3, 31.0])
    text = instrument_text(calibrated(alpha.tolist(), body_axes))
    data = yaml.safe_load(text)
    frd = frd_from_body(body_axes)
    C_db = frd @ exp_so3(alpha * DEG).T @ frd.T  # d to b, forward, starboard, down

    def rotation(axis: int, angle: float) -> np.ndarray:
        return exp_so3(np.eye(3)[axis] * angle * DEG)

    roll, pitch, yaw = data["nortek"]["roll_pitch_yaw_deg"]
    found = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
    np.testing.assert_allclose(found, C_db, atol=0.01 * DEG)

    heading, pitch, roll = data["delph"]["heading_pitch_roll_deg"]
    flu = np.diag([1.0, -1.0, -1.0])
    # Clockwise from above is against the right hand about X3, which points up.
    found = rotation(2, -heading) @ rotation(1, pitch) @ rotation(0, roll)
    np.testing.assert_allclose(flu @ found @ flu, C_db, atol=1e-4 * DEG)

    offset = data["water_linked"]["mounting_rotation_offset"]
    forward = C_db[:, 0]
    assert np.arctan2(forward[1], forward[0]) / DEG % 360.0 == pytest.approx(offset, abs=0.005)
    assert 0.0 <= offset < 360.0
    roll, pitch, yaw = data["water_linked"]["roll_pitch_yaw_after_offset_deg"]
    left = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
    np.testing.assert_allclose(left @ rotation(2, offset), C_db, atol=0.01 * DEG)
    assert text.count("NOT VERIFIED") == 2


def test_trdi_s_commands_of_the_text_turn_a_ship_s_velocity_into_the_instrument_s():
    alpha = np.array([1.2, -2.3, 31.0])
    # The instrument's axes: X to starboard, Y (beam 3) ahead, Z up, as RFU.
    text = instrument_text(calibrated(alpha.tolist(), "RFU"))
    EA, EI, EJ = (0.01 * yaml.safe_load(text)["trdi"][name] * DEG for name in ("EA", "EI", "EJ"))
    ship = np.array([0.3, 2.0, 0.1])
    # By the commands' rule, in forward, starboard, down.
    matrix = exp_so3([0.0, 0.0, -EA]) @ exp_so3([0.0, EJ, 0.0]) @ exp_so3([EI, 0.0, 0.0])
    rfu = frd_from_body("RFU")
    measured = exp_so3(alpha * DEG) @ ship
    np.testing.assert_allclose(rfu.T @ matrix @ rfu @ ship, measured, atol=2.0 * 0.01 * DEG)
