"""Unit vectors near nominal ones, as two coordinates each.

A direction d near the nominal one d0 is d0, turned by the angle |eta| towards E eta:

    d = cos|eta| d0 + sin|eta| / |eta| E eta.

The columns of E are two axes perpendicular to d0: x and y of the frame, taken along by the
shortest rotation from its z axis, or from -z where that is nearer, to d0. The chart is
exact at any angle below 180 degrees, and to first order eta is the angle along each axis.
"""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.geometry.vectors import Array


def tangent_axes(nominal: Array) -> Array:
    """Return E of unit vectors (N, 3), as (N, 3, 2)."""
    xy, z = nominal[:, :2], nominal[:, 2]
    sign = np.where(z < 0.0, -1.0, 1.0)
    level = np.eye(2) - xy[:, :, None] * xy[:, None, :] / (1.0 + np.abs(z))[:, None, None]
    return np.concatenate([level, -sign[:, None, None] * xy[:, None, :]], axis=1)


def turned(nominal: Array, eta: Array) -> Array:
    """Return the unit vectors (N, 3) at coordinates eta (N, 2), rad."""
    angle = np.linalg.norm(eta, axis=1, keepdims=True)
    along = np.einsum("nij,nj->ni", tangent_axes(nominal), eta)
    return np.asarray(np.cos(angle) * nominal + np.sinc(angle / np.pi) * along)


def turned_jacobian(nominal: Array, eta: Array) -> Array:
    """Return the derivative of `turned` with respect to eta, (N, 3, 2)."""
    E = tangent_axes(nominal)
    angle = np.linalg.norm(eta, axis=1)[:, None, None]
    sinc = np.sinc(angle / np.pi)
    # (cos a - sinc a) / a², without its cancellation near zero.
    safe = np.maximum(angle, 1e-3)
    bent = np.where(
        angle < 1e-3,
        -1.0 / 3.0 + angle**2 / 30.0,
        (np.cos(safe) - np.sinc(safe / np.pi)) / safe**2,
    )
    along = E @ eta[:, :, None]
    return np.asarray(sinc * E + (bent * along - sinc * nominal[:, :, None]) * eta[:, None, :])


def turns_to(nominal: Array, directions: Array) -> Array:
    """Return the coordinates eta (N, 2), rad, of vectors (N, 3) of any length."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.einsum("nij,ni->nj", tangent_axes(nominal), unit)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ni,ni->n", nominal, unit))
    return np.asarray(across * (angle / np.where(sine > 0.0, sine, 1.0))[:, None])
