"""Pings in the axes of their instrument: ship and Earth coordinates turned back."""

from __future__ import annotations

import numpy as np

from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.formats.janus import (
    beam_directions,
    from_beams,
    instrument_to_outer,
    to_instrument,
)
from factorgraph_dvl.files.formats.velocities import BEAM, EARTH, INSTRUMENT, SHIP
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import Merged
from factorgraph_dvl.geometry.vectors import Array

_NAMES = {BEAM: "beam", INSTRUMENT: "instrument", SHIP: "ship", EARTH: "Earth"}


def in_instrument_axes(pings: Records) -> Array:
    """Return velocities over the bottom or through the water in instrument axes.

    Parameters
    ----------
    pings : Records
        (N,) in any coordinates.

    Returns
    -------
    ndarray, shape (N, 3), m/s
        Nan where there is no lock, or where what turns them back is not known.
    """
    velocity = np.array(pings["velocity"])
    beams = pings["axes"] == BEAM
    if beams.any():
        part = pings[beams]
        # Beams are positive outward for the transducer, so what they amount to is the bottom's.
        turned = -from_beams(np.array(part["beams"]), part["beam_angle"], part["convex"])[:, :3]
        known = np.isfinite(part["velocity"]).all(axis=1)[:, None]
        velocity[beams] = np.where(known, part["velocity"], turned)
    rotation = instrument_to_outer(
        pings["axes"],
        pings["roll"],
        pings["pitch"],
        pings["heading"],
        pings["alignment"],
        pings["tilts_used"],
        pings["up"],
    )
    return to_instrument(velocity, rotation)


def beam_geometry(merged: Merged) -> Array | None:
    """Return outward directions (4, 3) if all pings with lock are along beams, else None."""
    pings = merged.sample
    locked = pings[np.isfinite(pings["beams"]).any(axis=1) | np.isfinite(pings["velocity"]).any(1)]
    angle = np.unique(locked["beam_angle"])
    in_beams = len(locked) > 0 and bool((locked["axes"] == BEAM).all())
    stated = {timed.stream.directions for timed in merged.streams}
    if in_beams and len(stated) == 1 and (directions := stated.pop()):
        return np.array(directions)
    return beam_directions(float(angle[0])) if in_beams and np.isfinite(angle).all() else None


def describe_axes(merged: Merged, decisions: Decisions) -> None:
    """Note in which coordinates the pings are, and what turns them back."""
    pings = merged.sample
    for axes in np.unique(pings["axes"]).tolist():
        part = pings[pings["axes"] == axes]
        decisions.add(merged.label, f"{_NAMES[axes]} coordinates → {_turned(part, axes)}")
    if pings["up"].any():
        decisions.add(merged.label, "it looks up: axes are turned over by 180° about forward")
    sound = pings["sound_speed"][np.isfinite(pings["sound_speed"])]
    if len(sound):
        ends = dict.fromkeys(f"{speed:.0f}" for speed in (sound.min(), sound.max()))
        value = f"{' to '.join(ends)} m/s"
        decisions.add(
            merged.label,
            f"velocities were made with a sound speed of {value} → kept; an error of it is in "
            "the scale error",
            "dvl.scale_error_std",
        )


def _turned(pings: Records, axes: int) -> str:
    alignment = (
        float(np.nanmedian(np.rad2deg(pings["alignment"]))) if _any(pings["alignment"]) else 0.0
    )
    tilts = "roll, pitch" if pings["tilts_used"].any() else ""
    if axes in (BEAM, INSTRUMENT):
        ea = f"; EA of {alignment:.2f}° was not applied by the instrument" if alignment else ""
        return f"as they are{ea}"
    if axes == SHIP:
        used = " and ".join(filter(None, (tilts, f"EA {alignment:.2f}°")))
        return f"turned back to instrument axes by the file's own {used}"
    used = " and ".join(filter(None, (tilts, "heading")))
    return (
        f"turned back to instrument axes by the file's own {used}; its errors are in the attitude"
    )


def _any(values: Array) -> bool:
    return bool(np.isfinite(values).any())
