"""A mount in words: aligned, turned, turned over, sideways; by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorgraph_dvl.analysis.mount import direction, mount_in_words
from factorgraph_dvl.quality.texts import text_of


def turned(order, angles):
    """Return axes of a DVL in forward, starboard, down: those of the vehicle, turned."""
    return Rotation.from_euler(order, angles, degrees=True).as_matrix().T


@pytest.mark.parametrize(
    ("axes", "expected"),
    [
        (
            np.eye(3),
            ["looks down; its z axis points down.", "x axis points to the bow", "to starboard"],
        ),
        (
            turned("Z", [3.7]),
            [
                "axis points down",
                "3.70 deg to starboard of the bow",
                "3.70 deg towards the stern from starb",
            ],
        ),
        (
            turned("Z", [-3.7]),
            [
                "axis points down",
                "3.70 deg to port of the bow",
                "3.70 deg towards the bow from starboard",
            ],
        ),
        # Turned over about the bow: y to port, z up. Yaw is applied to the whole.
        (
            turned("ZYX", [3.3, 0.0, 180.0]),
            ["looks down; its z axis points up.", "3.30 deg to starboard of the bow", "from port"],
        ),
        (turned("Z", [175.0]), ["axis points down", "5.00 deg to starboard of the stern", "port"]),
        # A bow that is raised by 10 deg.
        (
            turned("Y", [10.0]),
            [
                "down, 10.00 deg off the vertical; its z axis points down.",
                "to the bow, 10.00 deg above the horizontal",
                "starboard",
            ],
        ),
        # Rolled by 90 deg to starboard: y points down, z to port.
        (
            turned("X", [90.0]),
            ["sideways: its z axis points to port", "to the bow", "points down"],
        ),
        (turned("X", [-90.0]), ["z axis points to starboard", "to the bow", "points up"]),
    ],
)
def test_by_hand(axes, expected):
    found = list(map(text_of, mount_in_words(axes)))
    assert len(found) == 3
    for part, sentence in zip(expected, found, strict=True):
        assert part in sentence


def test_a_direction_between_two_is_that_of_the_nearer():
    def said(angle, language="en"):
        return text_of(direction(np.array([np.cos(angle), np.sin(angle), 0.0])), language)

    assert said(0.7) == "40.11 deg to starboard of the bow"
    assert said(0.9).endswith("towards the bow from starboard")
    assert (said(0.7, "zh"), said(-0.7, "zh")) == ("船首偏右舷 40.11 deg", "船首偏左舷 40.11 deg")
