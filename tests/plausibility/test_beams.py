"""A beam whose sign is reversed is named."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.plausibility.dvl import beam_findings
from factorgraph_dvl.quality.finding import Code
from factorgraph_dvl.quality.results import consistency_findings
from factorgraph_dvl.quality.scale_causes import beam_angles
from factorgraph_dvl.sensors.dvl_beams import DvlBeams, DvlBeamsSettings

AZIMUTHS = np.deg2rad([45.0, 135.0, 225.0, 315.0])
TILT = np.deg2rad(30.0)
DIRECTIONS = np.column_stack(
    [
        np.sin(TILT) * np.sin(AZIMUTHS),
        np.sin(TILT) * np.cos(AZIMUTHS),
        -np.cos(TILT) * np.ones(4),
    ]
)


def findings(signs):
    rng = np.random.default_rng(3)
    time = np.arange(200.0)
    velocity = np.column_stack([np.sin(time / 9), 1.5 + np.cos(time / 7), 0.3 * np.sin(time)])
    beams = velocity @ DIRECTIONS.T * signs + 0.005 * rng.standard_normal((200, 4))
    settings = DvlBeamsSettings(
        file="beams.csv",
        directions=tuple(map(tuple, DIRECTIONS.tolist())),
        velocity_std_m_s=0.005,
    )
    return [f for f in beam_findings(DvlBeams(settings, time, beams)) if f.code != Code.BEAMS_LOST]


@pytest.mark.parametrize("beam", range(4))
def test_a_reversed_beam_is_named(beam):
    signs = np.ones(4)
    signs[beam] = -1.0
    (found,) = findings(signs)
    assert found.severity == "warning"
    assert f"with the sign of beam {beam + 1} reversed" in found.text


def test_others_are_not():
    (good,) = findings(np.ones(4))
    assert good.severity == "ok"
    # A beam with another scale contradicts the others, whatever its sign.
    (scaled,) = findings(np.array([1.0, 1.7, 1.0, 1.0]))
    assert "is their order, the sign of one" in scaled.text


@pytest.mark.parametrize(
    ("ratio", "angles"),
    [
        (0.684, (20.0, 30.0)),
        (0.845, (25.0, 30.0)),
        (1.462, (30.0, 20.0)),
        (1.183, (30.0, 25.0)),
        (1.0, None),
        (0.92, None),
        (0.75, None),
        (-0.684, None),
    ],
)
def test_ratios_that_another_beam_angle_makes(ratio, angles):
    assert beam_angles(ratio) == angles


@pytest.mark.parametrize(
    ("scale", "text"),
    [
        (-1.995, "± 0.002: the sign is reversed"),
        (-0.316, "the beams look 20 deg from the vertical, and 30 deg were assumed"),
        (0.462, "the beams look 30 deg from the vertical, and 20 deg were assumed"),
        (-0.155, "the beams look 25 deg from the vertical, and 30 deg were assumed"),
        (0.3, "a bed that moves, a false bottom lock, a wrong unit"),
        (-1.7, "a bed that moves, a false bottom lock, a wrong unit"),
        (0.03, None),
    ],
)
def test_what_a_scale_error_is_a_sign_of(scale, text):
    one = np.ones(1)
    estimate = Estimate(
        "scale_error", ("scale_error",), scale * one, 2e-3 * one, 0.0 * one, one, one > 0.0
    )
    found = [f for f in consistency_findings([estimate], []) if f.code == Code.IMPOSSIBLE_SCALE]
    assert [text in str(f) for f in found] == ([True] if text else [])
