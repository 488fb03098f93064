"""Mirrored and swapped axes: signed permutations, and their words."""

from __future__ import annotations

import itertools

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
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
