"""Mirrored and swapped axes, and whether the bow points where the vehicle goes."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import get_args

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.gnss_windows import GnssWindows, WindowFit
from factorgraph_dvl.message import Message, message

NAMES = ("x", "y", "z")


def signed_permutations(determinant: int) -> Array:
    """Return the 24 signed permutations of a determinant, (24, 3, 3)."""
    found = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return np.array([P for P in found if round(float(np.linalg.det(P))) == determinant])


def mirrored(axis: int) -> Array:
    """Return the matrix that inverts one axis."""
    return np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))


def swapped(left_out: int) -> Array:
    """Return the matrix that swaps the two axes other than one."""
    order = list(range(3))
    i, j = (k for k in range(3) if k != left_out)
    order[i], order[j] = j, i
    return np.eye(3)[order]


def in_words(P: Array) -> Message:
    """Say what a signed permutation, which sets recorded axes right, finds wrong with them."""
    order = np.argmax(np.abs(P), axis=1)
    signs = P[np.arange(3), order]
    inverted = [NAMES[k] for k in range(3) if signs[k] < 0.0]
    if np.array_equal(order, np.arange(3)):
        if len(inverted) == 1:
            return message("axes.mirrored", axis=inverted[0])
        if len(inverted) == 3:
            return message("axes.all_opposite")
        return message("axes.opposite", first=inverted[0], second=inverted[1])
    moved = [NAMES[k] for k in range(3) if order[k] != k]
    if len(moved) == 2 and not inverted:
        return message("axes.swapped", first=moved[0], second=moved[1])
    right = ", ".join(f"{'-' if signs[k] < 0.0 else ''}{NAMES[order[k]]}" for k in range(3))
    return message("axes.renamed", right=right)


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


def side_of_bow(angle: float) -> Message:
    """Return in words how far a course is to starboard of the bow, from rad."""
    side = "course.starboard" if angle > 0.0 else "course.port"
    return message(side, angle=abs(angle) / DEG)


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
