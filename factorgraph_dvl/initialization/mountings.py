"""Start values of the sensors' mountings, from the motion without them, and what that is from."""

from __future__ import annotations

from collections import ChainMap
from itertools import product

import numpy as np
from numpy.typing import NDArray

from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.imu.preintegration import Segments
from factorgraph_dvl.imu.propagation import States, attach_inside, motion_at
from factorgraph_dvl.initialization.attitude_sensors import attitudes, mean_mounting
from factorgraph_dvl.initialization.dvl_mounting import initial_mountings
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.protocol import Aid, Motion
from factorgraph_dvl.sensors.usbl import Usbl
from factorgraph_dvl.trial import Trial

# So long before and after a fix, s, the motion without the DVL is good enough to find its
# mounting. Chosen: a tilt of 1 mrad then costs 0.1 m/s.
_NEAR_FIX = 10.0


def mounted_aids(trial: Trial, mountings: dict[str, Array]) -> list[Aid] | None:
    """Return the sensors that the motion can be estimated with before the others are mounted.

    None where no such motion is needed, because the DVL is calibrated, or not to be had,
    because there are no positions.

    Parameters
    ----------
    trial : Trial
        Its sensors.
    mountings : dict of str to ndarray
        Mountings that are known already, by parameter name.
    """
    if trial.fixes is None or (trial.dvl is not None and _is_calibrated(trial.dvl)):
        return None
    return [
        aid
        for aid in trial.aids
        if aid is not trial.dvl
        and not any(
            p.rotation and p.estimated and p.name not in mountings
            # That of a USBL is known well enough to start from.
            for p in (() if isinstance(aid, Usbl) else aid.parameters())
        )
    ]


def strays(trial: Trial) -> dict[str, Array]:
    """Return the weights of what a USBL measured, 0 where a start is made without the fix.

    Parameters
    ----------
    trial : Trial
        Its sensors.

    Returns
    -------
    dict of str to ndarray
        Weights (M, 1) by label; nothing where all fixes are near their neighbours.
    """
    usbl, start = trial.find(Usbl), trial.on_one_clock().with_fixes().gnss
    if usbl is None or start is None:
        return {}
    kept = {
        o.label: np.isin(o.time, start.time)[:, None].astype(float)
        for o in usbl.observations(trial.frame(), trial.body_axes)
    }
    return {label: weights for label, weights in kept.items() if not weights.all()}


def mountings_from_motion(
    trial: Trial, frame: LocalFrame, seg: Segments, gravity_n: Array, states: States
) -> list[dict[str, Array]]:
    """Return parameters of the sensors' mountings that fit a motion, the best first.

    The others are further local minima. Beams with directions of their own are near enough
    to the nominal ones, and a calibrated DVL to its calibration.

    Parameters
    ----------
    trial : Trial
        Its sensors.
    frame : LocalFrame
        Tangent frame n.
    seg : Segments
        Increments of the IMU between the nodes.
    gravity_n : ndarray, shape (S, 3)
        `LocalFrame.gravity_without_rotation` along the segments, m/s².
    states : States
        Motion at the nodes.

    Returns
    -------
    list of dict of str to ndarray
        Parameters by name, SI; rotations as matrices.
    """

    def motion(time: Array) -> tuple[Motion, NDArray[np.bool_]]:
        at, covered = attach_inside(seg, time, frame.earth_rate)
        near = covered & _near_fixes(trial.fixes, time)
        return motion_at(at, states, gravity_n, frame.earth_rate), near

    of_attitude = {}
    for seen in attitudes(trial, frame):
        if seen.mounting.estimated:
            body, near = motion(seen.time)
            of_attitude[seen.mounting.name] = mean_mounting(seen, body.nRb * near[:, None, None])
    logs: list[list[dict[str, Array]]] = []
    if trial.dvl is not None and not _is_calibrated(trial.dvl):
        logs.append(initial_mountings(trial.dvl, motion))
    beams = trial.beams
    if beams is not None and beams.settings.parametrisation == "common":
        own = {p.name: p.name.removeprefix(beams.prefix) for p in beams.parameters()}
        logs.append(
            [
                {name: found[plain] for name, plain in own.items()}
                for found in initial_mountings(as_dvl(beams), motion)
            ]
        )
    return [of_attitude | dict(ChainMap(*each)) for each in product(*logs)]


def _is_calibrated(dvl: Dvl) -> bool:
    """Whether an earlier calibration knows all of the mounting that is to be estimated."""
    free = [p for p in dvl.parameters() if p.estimated]
    return any(p.joint for p in free) and all(p.joint or not p.rotation for p in free)


def _near_fixes(gnss: Gnss | None, time: Array) -> NDArray[np.bool_]:
    """Whether times are near a fix; without any, all are as good."""
    if gnss is None:
        return np.ones(time.size, dtype=bool)
    known = ~np.isnan(gnss.geodetic[:, 0]) | ~np.isnan(gnss.velocity[:, 0])
    fixes = np.concatenate([[-np.inf], gnss.time[known], [np.inf]])
    after = np.searchsorted(fixes, time)
    nearest = np.minimum(time - fixes[after - 1], fixes[after] - time)
    return np.asarray((nearest < _NEAR_FIX) | (fixes.size == 2))
