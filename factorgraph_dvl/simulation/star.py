"""Simulated star tracker."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import cast

import erfa
import numpy as np
from erfa import ufunc
from scipy.spatial.transform import Rotation

from factorgraph_dvl.errors import ConfigError
from factorgraph_dvl.geometry.rotations import rotation_from_rph
from factorgraph_dvl.geometry.units import ARCSEC, DAY, DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.sensors.star import Star, StarSettings
from factorgraph_dvl.simulation.instruments import ScenarioView, StarTruth
from factorgraph_dvl.simulation.measurements import sample_times, within
from factorgraph_dvl.simulation.motion import TrueMotion, TrueState


def simulate_star(
    scenario: ScenarioView, motion: TrueMotion, rng: np.random.Generator
) -> tuple[Star, dict[str, Array]]:
    """Return the tracker's record, quaternions or star vectors, and its mounting.

    The attitude goes from the local level of the true position to ITRS, and from there to
    GCRS by ERFA's whole transformation at every sample. The noise turns the tracker's axes;
    that of a vector turns the vector, across itself.
    """
    truth: StarTruth = scenario.star
    if not scenario.epoch:
        raise ConfigError(
            "a star tracker is simulated without `epoch`",
            where=f"{scenario.source or 'scenario'} key epoch",
            expected="UTC of time zero, such as 2018-12-01T05:30:00Z",
        )
    jitter_rng, noise_rng = rng.spawn(2)
    time = sample_times(truth, motion.duration, jitter_rng)
    time = time[~within(time, truth.outages_s)]
    state = motion.at(time)
    mounting = Rotation.from_rotvec(np.array(truth.mounting_deg) * DEG)
    body = Rotation.from_matrix(rotation_from_rph(state.rph, scenario.body_axes))
    tracker = (
        _inertial_from_earth(scenario.epoch, time, truth.ut1_utc_s)
        * _earth_from_level(state)
        * body
        * mounting.inv()
    )
    sigma = np.broadcast_to(truth.std_arcsec, 3) * ARCSEC * scenario.noise
    settings = cast("StarSettings", scenario.settings("star"))
    if truth.stars:
        inertial = np.array(truth.stars)
        inertial /= np.linalg.norm(inertial, axis=1, keepdims=True)
        seen = np.stack([tracker.inv().apply(star) for star in inertial], axis=1).reshape(-1, 3)
        turn = noise_rng.standard_normal(seen.shape) * sigma
        turn -= np.sum(turn * seen, axis=1, keepdims=True) * seen
        seen = Rotation.from_rotvec(turn).apply(seen)
        catalogue = np.tile(inertial, (time.size, 1))
        each = np.repeat(time, inertial.shape[0])
        star = Star.from_vectors(settings, each, seen, catalogue, "star")
    else:
        noise = noise_rng.standard_normal((time.size, 3)) * sigma
        quaternion = (tracker * Rotation.from_rotvec(noise)).as_quat()[:, [3, 0, 1, 2]]
        star = Star.from_columns(
            settings,
            dict(zip(("time_s", "qw", "qx", "qy", "qz"), [time, *quaternion.T], strict=True))
            | {name: np.full(time.size, np.nan) for name in Star.optional[1]},
            "star",
        )
    return star, {"star_mounting_deg": np.array(truth.mounting_deg)}


def _inertial_from_earth(epoch: str, time: Array, ut1_utc: float) -> Rotation:
    """Return the rotations from ITRS to GCRS, time by time."""
    begin = datetime.fromisoformat(epoch)
    if begin.tzinfo is not None:
        begin = begin.astimezone(UTC)
    # `erfa.utctai` warns of years beyond the leap seconds it knows: to catch that would change
    # the warnings of all threads.
    *utc, _ = ufunc.dtf2d(
        b"UTC",
        begin.year,
        begin.month,
        begin.day,
        begin.hour,
        begin.minute,
        begin.second + begin.microsecond * 1e-6,
    )
    tai_day, tai_fraction, _ = ufunc.utctai(*utc)
    tt = erfa.taitt(tai_day, tai_fraction + time / DAY)
    *ut1, _ = ufunc.utcut1(*utc, ut1_utc)
    matrix = erfa.c2t06a(*tt, ut1[0], ut1[1] + time / DAY, 0.0, 0.0)
    return Rotation.from_matrix(matrix).inv()


def _earth_from_level(state: TrueState) -> Rotation:
    """Return the rotations from local-level east, north, up to ITRS."""
    lat, lon = state.geodetic[:, 0], state.geodetic[:, 1]
    # East, north, up at 0, 0 are the ITRS axes y, z, x; up then goes to the latitude, east
    # to the longitude.
    permuted = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return Rotation.from_euler("ZY", np.stack([lon, -lat], axis=1)) * permuted
