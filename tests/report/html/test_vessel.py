"""The drawing of the vessel shows instruments and axes where they are."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrations import calibration
from reports import build_result

from factorgraph_dvl.analysis.instrument_terms import instrument_of
from factorgraph_dvl.report.html.vessel import vessel_drawing
from factorgraph_dvl.report.vessel import label_places
from factorgraph_dvl.solution import Solution

# Right, forward, up: the antenna is 6 m above the IMU and 1 m astern.
SETTINGS = {"gnss": {"lever_arm_m": [0.0, -1.0, 6.0]}}


def drawing(alpha: list[float]) -> list[str]:
    """Return the two views of a calibration; its DVL is 2 m ahead, 1 m to starboard, 3 m below."""
    found = calibration(alpha=np.array(alpha))
    arm = next(e for e in found.estimates if e.name == "lever_arm_m")
    moved = replace(arm, value=np.array([1.0, 2.0, -3.0]))
    estimates = tuple(moved if e.name == arm.name else e for e in found.estimates)
    own: Solution = replace(
        build_result().solution,
        estimates=estimates,
        covariance=found.covariance,
        body_axes="RFU",
    )
    text = vessel_drawing(instrument_of(own), own, SETTINGS).text
    return re.findall(r"<svg.*?</svg>", text)


def points(view: str) -> np.ndarray:
    found = re.findall(r'<circle class="point" cx="([\d.]+)" cy="([\d.]+)"', view)
    return np.array(found, dtype=float)


def axis(view: str, k: int) -> np.ndarray | None:
    """Return the direction of an axis as drawn, to the right and downward."""
    found = re.search(rf'class="axis{k}" d="M([\d.,]+) L([\d.,]+) M', view)
    if found is None:
        return None
    start, end = (np.array(text.split(","), dtype=float) for text in found.groups())
    return (end - start) / 54.0


def test_places_are_to_scale() -> None:
    above, side = drawing([0.0, 0.0, 0.0])
    # Right and downward on the drawing, m, from the IMU: antenna, DVL.
    for view, expected in (
        (above, [[0.0, 1.0], [1.0, -2.0]]),
        (side, [[-1.0, -6.0], [2.0, 3.0]]),
    ):
        at = points(view)
        ruler, length = re.search(r'd="M14,[\d.]+ V346 H([\d.]+) .*>([\d.]+) m<', view).groups()
        scale = (float(ruler) - 14.0) / float(length)
        np.testing.assert_allclose((at[1:] - at[0]) / scale, expected, atol=0.02)
        assert 'class="sigma"' in view


@pytest.mark.parametrize(
    ("alpha", "above", "side"),
    [
        # Rotation vectors of C_b^d in right, forward, up. Aligned: forward is the bow's way.
        ([0.0, 0.0, 0.0], ([0, -1], [1, 0], None), ([1, 0], None, [0, 1])),
        # Turned to starboard by a right angle: its forward axis points to starboard.
        ([0.0, 0.0, 90.0], ([1, 0], [0, 1], None), (None, [-1, 0], [0, 1])),
        # Rolled over: it looks up.
        ([0.0, 180.0, 0.0], ([0, -1], [-1, 0], None), ([1, 0], None, [0, -1])),
        # Bow of the DVL up by 30 deg.
        ([-30.0, 0.0, 0.0], ([0, -0.866], [1, 0], [0, -0.5]), ([0.866, -0.5], None, [0.5, 0.866])),
    ],
)
def test_axes_are_turned_as_found(alpha: list[float], above: tuple, side: tuple) -> None:
    for view, expected in zip(drawing(alpha), (above, side), strict=True):
        for k, direction in enumerate(expected):
            found = axis(view, k)
            if direction is None:
                assert found is None
            else:
                np.testing.assert_allclose(found, direction, atol=0.01)


@pytest.mark.parametrize("off", [0.0, 0.3, -0.3])
def test_names_are_not_on_each_other_where_instruments_are_close(off: float) -> None:
    """On one mast, IMU, antenna and DVL are nearly at one place seen from above."""
    at = np.array([[0.0, 0.0], [16.0 * off, 4.0 * off], [20.0 * off, 0.0]])
    widths, height = [26.0, 104.0, 26.0], 16.0
    boxes = []
    sides = np.stack([*(at[:-1] - at.mean(axis=0)), np.array([-1.0, 1.0])])
    for (x, y), width, (right, below, far) in zip(
        at, widths, label_places(at, sides, widths, height), strict=True
    ):
        left = x + (8.0 if right else -8.0 - width)
        top = y + (far if below else -far - height)
        boxes.append((left, top, left + width, top + height))
    for k, a in enumerate(boxes):
        for b in boxes[:k]:
            assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


def test_beams_are_on_the_side_on_which_the_dvl_looks() -> None:
    for alpha, down in (([0.0, 0.0, 0.0], 1.0), ([0.0, 180.0, 0.0], -1.0)):
        _, side = drawing(alpha)
        beams = re.findall(r'class="beam" d="M[\d.]+,([\d.]+) L[\d.]+,([\d.]+)"', side)
        assert len(beams) == 4
        for start, end in beams:
            assert float(end) - float(start) == pytest.approx(down * 76.0 * 0.866, abs=0.2)
