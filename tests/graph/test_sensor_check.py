"""The check of somebody else's sensor: right ones pass, and each mistake is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from factorgraph_dvl_compass import Compass, CompassHeading, CompassSettings
from truth import scenario

from factorgraph_dvl import LocalFrame, check_sensor, simulate
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.geometry.rotations import wrapped
from factorgraph_dvl.graph.sensor_check import _quotient

FRAME = LocalFrame(0.6, 2.1, 0.0)
TIME, HEADING = np.arange(4.0), np.radians([10.0, 100.0, 190.0, 359.0])


@pytest.mark.parametrize("body_axes", ["RFU", "FRD", "FLU"])
def test_the_packages_own_sensors_pass(body_axes):
    trial = simulate(scenario(depth={"rate_hz": 1, "std_m": 0.1}, body_axes=body_axes))
    assert {aid.section for aid in trial.aids} == {"gnss", "dvl", "depth"}
    for aid in (*trial.aids, Compass(CompassSettings(), TIME, HEADING)):
        check_sensor(aid, trial.frame(), body_axes)


class Flat(CompassHeading):
    """A residual without the axis of the components."""

    def residual(self, motion, values):
        return super().residual(motion, values)[:, 0]


class Turned(CompassHeading):
    """The wrong sign."""

    def linearize(self, motion, values, wanted):
        lin = super().linearize(motion, values, wanted)
        return replace(lin, d_theta=-lin.d_theta)


class Radians(CompassHeading):
    """A derivative in another unit than the residual."""

    def linearize(self, motion, values, wanted):
        lin = super().linearize(motion, values, wanted)
        return replace(lin, d_parameters={n: np.radians(d) for n, d in lin.d_parameters.items()})


class Narrow(CompassHeading):
    """A derivative without the axis of the components."""

    def linearize(self, motion, values, wanted):
        lin = super().linearize(motion, values, wanted)
        return replace(lin, d_theta=lin.d_theta[:, 0])


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (Flat, r"Flat.residual\(\): the shape is \(4,\); expected \(4, 1\)"),
        (Turned, r"Turned.linearize\(\).d_theta: the derivative is"),
        (Radians, r"d_parameters\['compass_bias_deg'\]: the derivative is \[\[1.0\]\]"),
        (Narrow, r"Narrow.linearize\(\).d_theta: the shape is \(4, 3\); expected \(4, 1, 3\)"),
    ],
)
def test_a_wrong_observation_is_named(kind, text):
    class Own(Compass):
        def observations(self, frame, body_axes):
            return tuple(kind(**vars(o)) for o in super().observations(frame, body_axes))

    with pytest.raises(DataError, match=text):
        check_sensor(Own(CompassSettings(), TIME, HEADING), FRAME, "RFU")


def test_what_a_sensor_lacks_is_named():
    class NoSpecs(Compass):
        specs = ()

    class NoColumn(Compass):
        def columns(self):
            return {"time_s": self.time}

    for kind, text in (
        (NoSpecs, "compass_bias_deg is missing"),
        (NoColumn, "heading_deg is miss"),
    ):
        with pytest.raises(DataError, match=text):
            check_sensor(kind(CompassSettings(), TIME, HEADING), FRAME, "RFU")
    with pytest.raises(DataError, match=r"lacks .*explain.*observations"):
        check_sensor(object(), FRAME, "RFU")
    with pytest.raises(DataError, match="no measurement"):
        check_sensor(Compass(CompassSettings(), TIME, np.nan * HEADING), FRAME, "RFU")


def test_differences_of_angles_do_not_jump_at_half_a_turn():
    def angle(h):
        return wrapped(np.array([[np.pi]]) + h)

    np.testing.assert_allclose(_quotient(angle, 1, 1e-6, angles=True), 1.0, rtol=1e-6)
