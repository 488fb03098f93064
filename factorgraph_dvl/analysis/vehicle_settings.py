"""A calibration as the settings of a vehicle or an instrument, in the form in which these read it.

Each function states the sign convention of who reads the settings, and from which document.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.instrument_terms import (
    ANTENNA,
    ORIGINS,
    WATER_LINKED_AXES,
    InstrumentTerms,
    instrument_of,
)
from factorgraph_dvl.analysis.mount import looks_down, mount_in_words
from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import fixed
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.quality.verdict import Grade
from factorgraph_dvl.sensors.dvl import TIME_OFFSET
from factorgraph_dvl.solution import Calibration, Solution

# Forward, starboard, down to forward, port, up.
_FLU = np.diag([1.0, -1.0, -1.0])
# Why a value must not be entered, by its grade.
_REFUSED = {
    "red": "σ is more than twice its limit: do not enter",
    "grey": "the trial did not determine it: do not enter",
}
# Yaw of a sensor in the vehicle, deg, by the number of its rotation in ArduPilot.
_ROTATIONS = {0.0: 0, 90.0: 2, 180.0: 4, -90.0: 6}
# Longest delay that ArduPilot takes, ms, and largest offset of a sensor, m.
_LONGEST_DELAY, _FARTHEST = 250.0, 5.0
_ELSEWHERE = "enter it in your navigation software"


@dataclass(frozen=True)
class Setting:
    """A line that is read by a vehicle or an instrument.

    Parameters
    ----------
    text : str
        The line.
    grades : tuple of Grade
        Grades of what it is made of: a red or grey one turns it into a comment.
    """

    text: str
    grades: tuple[Grade, ...]


# Settings, and remarks as plain text.
Lines = Iterator[Setting | str]


def settings_text(calibration: Calibration | Solution, target: str) -> str:
    """Return a calibration as the settings of a vehicle or an instrument.

    Parameters
    ----------
    calibration : Calibration or Solution
        Calibration of a DVL.
    target : str
        One of `TARGETS`.

    Raises
    ------
    ConfigError
        If there is no such target.
    DataError
        If it has no misalignment, scale error or lever arm.
    """
    if target not in TARGETS:
        raise ConfigError(f"there is no target `{target}`", expected=", ".join(TARGETS))
    write, _ = TARGETS[target]
    i = instrument_of(calibration)
    is_xml = target == "urdf"
    out = []
    for line in write(i, _delay(calibration)):
        if isinstance(line, str):
            out.append(_comment(line, is_xml=is_xml))
            continue
        why = [_REFUSED[grade] for grade in ("red", "grey") if grade in line.grades]
        out.append(_comment(f"{line.text} ({why[0]})", is_xml=is_xml) if why else line.text)
    return "\n".join(out) + "\n"


def _comment(text: str, *, is_xml: bool) -> str:
    # Two hyphens end a comment of XML.
    return f"<!-- {text.replace('--', '- -')} -->" if is_xml else f"# {text}"


def _delay(calibration: Calibration | Solution) -> tuple[float, Grade] | None:
    """Return by how much stamps of the DVL are late, s, with the grade; None if fixed."""
    for estimate in calibration.estimates:
        if estimate.name == TIME_OFFSET:
            return float(estimate.value[0]), calibration.grades[TIME_OFFSET][0]
    return None


def transform(i: InstrumentTerms) -> tuple[Array, Array]:
    """Return position (3,), m, and roll, pitch, yaw (3,), rad, of the DVL in forward, port, up.

    With these axes for both, R = Rz(yaw) Ry(pitch) Rx(roll) takes components of the DVL to those
    of the vehicle (REP 103).
    """
    angles = Rotation.from_matrix(_FLU @ i.attitude @ _FLU).as_euler("ZYX")[::-1]
    return _FLU @ i.lever_arm, angles


def _turn(yaw: float, since: float) -> float:
    """Return the shorter turn from one angle to another, deg."""
    return (yaw - since + 180.0) % 360.0 - 180.0


def _frames(i: InstrumentTerms) -> tuple[str, str]:
    parent = "gnss" if i.origin == ANTENNA else i.origin.lower()
    return f"{parent}_link", "dvl_link"


def _grades(i: InstrumentTerms) -> tuple[Grade, ...]:
    return (*i.dvl_in_body["ZYX"].grade, *i.lever_arm_grade)


def _about_frames(i: InstrumentTerms) -> Lines:
    parent, child = _frames(i)
    yield f"From {parent}, the {i.origin}, to {child}; axes forward, port, up (REP 103)."
    yield "roll, pitch, yaw about fixed axes x, y, z, rad; positive by the right hand."
    yield f"Scale error {_percent(i)} %: not part of a transform, {_ELSEWHERE}."


def _percent(i: InstrumentTerms) -> str:
    return ", ".join(fixed(100.0 * float(value), 3) for value in i.scale_error)


def _urdf(i: InstrumentTerms, delay: tuple[float, Grade] | None) -> Lines:
    """URDF, element `origin` of a joint: xyz m, rpy rad about fixed axes, parent to child."""
    yield from _about_frames(i)
    (parent, child), (arm, angles) = _frames(i), transform(i)
    xyz, rpy = (" ".join(fixed(float(x), n) for x in v) for v, n in ((arm, 4), (angles, 6)))
    yield Setting(
        f'<joint name="{child.removesuffix("_link")}_joint" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>',
        _grades(i),
    )


def _tf(i: InstrumentTerms, delay: tuple[float, Grade] | None) -> Lines:
    """tf2_ros, `static_transform_publisher`: the pose of the child in the parent."""
    yield from _about_frames(i)
    (parent, child), (arm, angles) = _frames(i), transform(i)
    named = [
        *zip(("x", "y", "z"), (fixed(float(x), 4) for x in arm), strict=True),
        *zip(("roll", "pitch", "yaw"), (fixed(float(x), 6) for x in angles), strict=True),
        *(("frame-id", parent), ("child-frame-id", child)),
    ]
    arguments = " ".join(f"--{name} {value}" for name, value in named)
    yield Setting(f"ros2 run tf2_ros static_transform_publisher {arguments}", _grades(i))


def _ardupilot(i: InstrumentTerms, delay: tuple[float, Grade] | None) -> Lines:
    """ArduPilot, parameters of the library AP_VisualOdom, by their descriptions and its source.

    VISO_POS: of the sensor from the origin of the body, forward, right, down. VISO_ORIENT: the
    rotation that takes the sensor's vectors to the body (0 forward, 2 right, 4 back, 6 left); the
    log has what was turned. VISO_SCALE: positions are multiplied by it. VISO_DELAY_MS: taken from
    the time at which a movement came in; its mean velocity then counts at that time.
    """
    roll, pitch, yaw = (float(x) for x in i.dvl_in_body["ZYX"].value)
    yield "ArduPilot. VISO_POS from the IMU of the autopilot, forward, right, down, m."
    yield from _viso_position(i)
    if not looks_down(i.attitude):
        yield f"VISO_ORIENT: none for a DVL that does not look down: {_ELSEWHERE}"
    else:
        nearest = min(_ROTATIONS, key=lambda angle: abs(_turn(yaw, angle)))
        rest = _turn(yaw, nearest)
        yield "VISO_ORIENT is valid for a trial from VISO of a .BIN only if it was 0 then: the log"
        yield "has the movements as they were turned. A .tlog has them as they were sent."
        yield Setting(f"VISO_ORIENT,{_ROTATIONS[nearest]}", (i.dvl_in_body["ZYX"].grade[2],))
        yield (
            f"VISO_ORIENT turns by 90 deg only. The rest is yaw {fixed(rest, 2)}, pitch "
            f"{fixed(pitch, 2)}, roll {fixed(roll, 2)} deg: enter it in the program that sends "
            "the messages, which turns movements before VISO_ORIENT does"
        )
    yield "VISO_SCALE multiplies positions. Movements (VISION_POSITION_DELTA) are not scaled."
    scale = 1.0 / (1.0 + float(np.mean(i.scale_error)))
    yield Setting(f"VISO_SCALE,{fixed(scale, 5)}", tuple(i.scale_grade))
    if delay is None:
        yield "VISO_DELAY_MS: the time offset was not estimated"
    elif not 0.0 <= 1e3 * delay[0] <= _LONGEST_DELAY:
        yield f"VISO_DELAY_MS is 0 to {_LONGEST_DELAY:g}: {fixed(1e3 * delay[0], 0)} is not"
    else:
        yield "If the trial was made of movements (VISO, VISION_POSITION_DELTA), add half of the"
        yield "time between two of them to VISO_DELAY_MS: import put their stamps in the middle."
        yield Setting(f"VISO_DELAY_MS,{round(1e3 * delay[0])}", (delay[1],))


def _viso_position(i: InstrumentTerms) -> Lines:
    if i.origin != ORIGINS["imu"]:
        arm = ", ".join(fixed(float(x), 3) for x in i.lever_arm)
        yield f"VISO_POS: the lever arm is {arm} m from the {i.origin}, not from the IMU."
        yield f"Enter VISO_POS_X, _Y and _Z after adding the place of the {i.origin} from the IMU."
        return
    for name, value, grade in zip("XYZ", i.lever_arm, i.lever_arm_grade, strict=True):
        far = f"VISO_POS_{name} is limited to ± {_FARTHEST:g} m"
        if abs(value) > _FARTHEST:
            yield f"{far}, and is {fixed(float(value), 3)}: {_ELSEWHERE}"
        else:
            yield Setting(f"VISO_POS_{name},{fixed(float(value), 3)}", (grade,))


def _water_linked(i: InstrumentTerms, delay: tuple[float, Grade] | None) -> Lines:
    """Water Linked, DVL protocol and page Axes: `mounting_rotation_offset`, deg.

    It is the clockwise angle about Z from the vehicle's forward axis to that of the DVL; the DVL
    turns its output back by it. For roll and pitch there is no setting.
    """
    down = looks_down(i.attitude_as(WATER_LINKED_AXES))
    left = i.after_offset if down else i.as_frd
    roll, pitch, yaw = (fixed(float(x), 2) for x in left.value)
    if not down:
        yield f"mounting_rotation_offset: none for a DVL that does not look down: {_ELSEWHERE}"
    else:
        parameters = {"mounting_rotation_offset": round(i.rotation_offset, 2)}
        command = {"command": "set_config", "parameters": parameters}
        yield "Send this line to port 16171 of the DVL. Positive: clockwise from above."
        yield "It is valid if the offset was 0 in the trial."
        yield "Software before 2.2.1 takes whole degrees."
        yield Setting(json.dumps(command), (i.dvl_in_body["ZYX"].grade[2],))
    after = "after the offset, " if down else ""
    yield from _not_set("Water Linked", i, f"{after}roll {roll}, pitch {pitch}, yaw {yaw} deg")


def _nucleus(i: InstrumentTerms, delay: tuple[float, Grade] | None) -> Lines:
    """Nortek Nucleus, whose rotations (SETINST) have no documented signs."""
    roll, pitch, yaw = (fixed(float(x), 2) for x in i.dvl_in_body["ZYX"].value)
    yield (
        "SETINST has ROTXY, ROTYZ and ROTXZ. No public document states their signs: not written."
    )
    yield from _not_set("Nucleus", i, f"roll {roll}, pitch {pitch}, yaw {yaw} deg")


def _not_set(maker: str, i: InstrumentTerms, angles: str) -> Lines:
    yield from map(text_of, mount_in_words(i.axes))
    arm = ", ".join(fixed(float(x), 3) for x in i.lever_arm)
    yield f"{maker} has no setting for what follows: {_ELSEWHERE}."
    yield f"- mounting angles: {angles} (starboard down, bow up, clockwise: positive)"
    yield f"- scale error: {_percent(i)} % (positive: it reads too much)"
    yield f"- lever arm or offset from the {i.origin}: {arm} m (forward, starboard, down)"


# By name: what writes the settings, and the usual ending of their file.
TARGETS: dict[str, tuple[Callable[[InstrumentTerms, tuple[float, Grade] | None], Lines], str]] = {
    "urdf": (_urdf, "urdf"),
    "tf": (_tf, "sh"),
    "ardupilot": (_ardupilot, "param"),
    "water-linked": (_water_linked, "txt"),
    "nucleus": (_nucleus, "txt"),
}
