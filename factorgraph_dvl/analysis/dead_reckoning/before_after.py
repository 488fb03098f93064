"""Dead reckoning before and after calibration, and the effect of the lever arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from factorgraph_dvl.analysis.beam_quality import beam_calibration
from factorgraph_dvl.analysis.dead_reckoning.integration import (
    DeadReckonedTrack,
    DvlMounting,
    OrientationAt,
    body_positions,
    dead_reckon,
    displaced,
    lever_arm_error,
    mounting_of,
)
from factorgraph_dvl.analysis.dead_reckoning.track_error import Score, difference, score
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.trial import Reference, Trial

# Chosen: the fixes of this time give the start of a track; their noise averages out, and a
# calibrated DVL hardly drifts.
_START_S = 60.0


@dataclass(frozen=True)
class Run:
    """A dead-reckoned track and its errors; None without reference or GNSS."""

    mounting: DvlMounting
    track: DeadReckonedTrack
    score: Score | None


@dataclass(frozen=True)
class LeverArmEffect:
    """Position error from a neglected lever arm, computed in two ways.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Epochs of the track.
    measured : ndarray, shape (M, 3)
        Track without lever arm minus track with it, east, north, up, m.
    closed_form : ndarray, shape (M, 3), m
        The error (C(t) - C(0)) l, east, north, up.
    """

    time: Array
    measured: Array
    closed_form: Array

    @property
    def largest(self) -> float:
        """Largest horizontal effect, m."""
        return float(np.hypot(self.closed_form[:, 0], self.closed_form[:, 1]).max())

    @property
    def disagreement(self) -> float:
        """Largest distance between the two ways, m."""
        return float(np.linalg.norm(self.measured - self.closed_form, axis=1).max())


@dataclass(frozen=True)
class BeforeAfter:
    """Dead reckoning with the calibration, without it, and without the lever arm alone.

    Parameters
    ----------
    calibrated, uncalibrated, without_lever_arm : Run
        The three runs.
    lever_arm : LeverArmEffect
        Difference of the first and the last.
    scored_by : {reference, GNSS, INS, nothing}
        Source of the positions that the tracks are compared with.
    """

    calibrated: Run
    uncalibrated: Run
    without_lever_arm: Run
    lever_arm: LeverArmEffect
    scored_by: Literal["reference", "GNSS", "INS", "nothing"]


def before_after(
    trial: Trial, values: Mapping[str, Array], orientation_at: OrientationAt
) -> BeforeAfter:
    """Dead-reckon a trial with a calibration, and with the mounting in trial.yaml.

    All tracks start at the position that fits the calibrated track to the fixes of the first
    minute: the error of a single fix would remain in the whole track and its score. Without
    GNSS they start at `initial.position`. In a trial with beams but no DVL, the beams are
    calibrated.

    Parameters
    ----------
    trial : Trial
        Trial with DVL or beams; GNSS gives the start, and the truth if there is no reference.
    values : mapping of str to ndarray
        Calibration by name, in reported units; directions as (N, 3) vectors.
    orientation_at : OrientationAt
        Attitude and turn rate at times (M,).

    Raises
    ------
    DataError
        As `dead_reckon`, and if the calibration belongs to other beams.
    """
    truth, scored_by = _truth(trial, orientation_at)
    corrected, mounting = with_calibration(trial, values)
    start = _start(trial, dead_reckon(corrected, mounting, orientation_at), orientation_at)

    def reckon(trial: Trial, mounting: DvlMounting) -> DeadReckonedTrack:
        return dead_reckon(trial, mounting, orientation_at, start)

    best = reckon(corrected, mounting)

    def run(mounting: DvlMounting, track: DeadReckonedTrack) -> Run:
        return Run(mounting, track, None if truth is None else score(track, truth, along=best))

    nominal = mounting_of(trial)
    bare = replace(mounting, lever_arm=np.zeros(3))
    calibrated = run(mounting, best)
    without = run(bare, reckon(corrected, bare))
    nRb = rotation_from_rph(best.rph, trial.body_axes)
    effect = LeverArmEffect(
        best.time,
        difference(without.track, best.time, best.geodetic),
        lever_arm_error(nRb, mounting.lever_arm),
    )
    return BeforeAfter(
        calibrated=calibrated,
        uncalibrated=run(nominal, reckon(trial, nominal)),
        without_lever_arm=without,
        lever_arm=effect,
        scored_by="nothing" if calibrated.score is None else scored_by,
    )


def _start(
    trial: Trial, track: DeadReckonedTrack, orientation_at: OrientationAt
) -> tuple[float, Array]:
    """Return time and position of the start that fits the first fixes best.

    The median by axis is used because a fix may be an outlier.
    """
    first, position = float(track.time[0]), track.geodetic[0]
    if trial.position_sensor is None:
        return first, position
    fixes = body_positions(trial.position_sensor, orientation_at)
    last = min(first + _START_S, float(track.time[-1]))
    early = (fixes.time >= first) & (fixes.time <= last)
    if not early.any():
        return first, position
    off = np.median(difference(track, fixes.time[early], fixes.geodetic[early]), axis=0)
    return first, displaced(position[None], -off[None])[0]


def with_calibration(trial: Trial, values: Mapping[str, Array]) -> tuple[Trial, DvlMounting]:
    """Return the trial with its beams converted to a DVL, and the mounting that remains."""
    if trial.dvl is not None or trial.beams is None:
        return trial, mounting_of(trial, values)
    found = beam_calibration(trial.beams, values)
    log = as_dvl(trial.beams, (found.directions_b, found.scale_error, found.lever_arm))
    corrected = replace(trial, dvl=log)
    return corrected, mounting_of(corrected)


def _truth(
    trial: Trial, orientation_at: OrientationAt
) -> tuple[Reference | None, Literal["reference", "GNSS", "INS", "nothing"]]:
    if trial.reference is not None:
        return trial.reference, "reference"
    sensor = trial.position_sensor
    if sensor is not None:
        return body_positions(sensor, orientation_at), "INS" if isinstance(sensor, Ins) else "GNSS"
    return None, "nothing"
