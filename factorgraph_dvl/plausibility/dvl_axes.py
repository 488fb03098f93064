"""Whether axes of a DVL are mirrored, as the signs of PD0 are, and which."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.rotations import exp_so3, log_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.dvl_windows import DvlFit
from factorgraph_dvl.message import Message, either, message
from factorgraph_dvl.plausibility.axis_permutations import in_words, mirrored, swapped
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import MISALIGNMENT, Dvl

# Misalignments that differ by less, rad, are equally likely by their size. Chosen.
_ALIKE = 20.0 * DEG


def mirrored_finding(dvl: Dvl, fit: DvlFit) -> Finding:
    """Return the error that the DVL's axes can only be mirrored ones, and which.

    Parameters
    ----------
    dvl : Dvl
        Record of the DVL.
    fit : DvlFit
        Of its pings to the carried IMU, with mirrored axes.
    """
    prior = next(p for p in dvl.parameters() if p.name == MISALIGNMENT)
    explained = []
    for P in (-np.eye(3), *(mirrored(k) for k in range(3)), *(swapped(k) for k in range(3))):
        dRb = P @ fit.dRb
        deviation = float(np.linalg.norm(log_so3(exp_so3(prior.mean).T @ dRb)))
        explained.append((deviation, P, log_so3(dRb) / DEG))
    least = min(deviation for deviation, _, _ in explained)
    likely = [each for each in explained if each[0] < least + _ALIKE]
    return Finding(
        Code.DVL_AXES,
        message("dvl_axes.mirrored", causes=either([_cause(P, a) for _, P, a in likely])),
        dvl.label,
        severity="error",
    )


def _cause(P: Array, angles: Array) -> Message:
    if np.array_equal(P, -np.eye(3)):
        return message("dvl_axes.as_pd0", angles=angles)
    return message("dvl_axes.cause", axes=in_words(P), angles=angles)
