"""Whether the bow by `body_axes` points where the vehicle goes, and what is wrong if not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.gnss_windows import GnssWindows, WindowFit
from factorgraph_dvl.plausibility.axis_permutations import signed_permutations

# Speed from which on the course is one, m/s, and heading σ up to which a window has a heading.
# Chosen: beyond drift by wind and current; a tenth of what is looked for.
_LEAST_SPEED = 0.5
_LARGEST_SIGMA = 8.0 * DEG
# Velocities that are needed, and length of their mean direction in body. Chosen: a vehicle that
# goes anywhere, as one that hovers does, has none.
_LEAST_COUNT = 20
_CONCENTRATION = 0.85
# Share of both directions that a signed permutation must meet. Chosen: 30 deg of drift angle.
_MEETS = 0.85


@dataclass(frozen=True)
class BodyDirections:
    """Directions in body axes: `up`, and `course`, the mean direction of motion, None if none.

    `turned` is the range of courses, rad, over which they were found.
    """

    up: Array
    course: Array | None
    turned: float


def body_directions(
    compared: GnssWindows, offset: float | Array, fit: WindowFit
) -> BodyDirections:
    """Return vertical and course in body axes, as GNSS and gravity show them."""
    nRb = compared.attitude(offset, fit.level_R)
    up = nRb[..., 2, :][compared.inside].mean(axis=0)
    velocity = compared.velocity[compared.rows]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    use = compared.inside & (speed > _LEAST_SPEED)
    use &= (fit.heading_sigma < _LARGEST_SIGMA)[:, None]
    course = None
    turned = 0.0
    if use.sum() >= _LEAST_COUNT:
        level = velocity[use] * [1.0, 1.0, 0.0] / speed[use][:, None]
        mean = np.einsum("mij,mi->mj", nRb[use], level).mean(axis=0)
        # A circle of courses has no mean: how much they differ.
        turned = float(np.arccos(np.clip(np.linalg.norm(level.mean(axis=0)), -1.0, 1.0)))
        if np.linalg.norm(mean) > _CONCENTRATION:
            course = mean / np.linalg.norm(mean)
    return BodyDirections(up / np.linalg.norm(up), course, turned)


def off_course(directions: BodyDirections, body_axes: BodyAxes) -> float | None:
    """Return by how much the course is to starboard of the bow, rad; None if nothing is known."""
    if directions.course is None:
        return None
    forward, starboard, _ = frd_from_body(body_axes) @ directions.course
    return float(np.arctan2(starboard, forward))


def axes_that_fit(directions: BodyDirections) -> list[BodyAxes]:
    """Return the `body_axes` with which the bow points along the course, and up is up."""
    if directions.course is None:
        return []
    fit: list[BodyAxes] = []
    for axes in get_args(BodyAxes):
        forward, _, down = frd_from_body(axes)
        if forward @ directions.course > _MEETS and -down @ directions.up > _MEETS:
            fit.append(axes)
    return fit


def relabelling(directions: BodyDirections, body_axes: BodyAxes, determinant: int) -> list[Array]:
    """Return the signed permutations after which bow and vertical are as `body_axes` says.

    One where the course is known, else as many as the vertical leaves.
    """
    forward, _, down = frd_from_body(body_axes)
    found = []
    for P in signed_permutations(determinant):
        upright = -down @ P @ directions.up > _MEETS
        ahead = directions.course is None or forward @ P @ directions.course > _MEETS
        if upright and ahead:
            found.append(P)
    return found
