"""TUM trajectories, as evo and SLAM benchmarks read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from factorgraph_dvl.files.exporting.motion import ExportedMotion
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import rotation_from_rph


def write_tum(motion: ExportedMotion, path: Path) -> None:
    """Write `time x y z qx qy qz qw` lines.

    Positions are metres east, north, up of the first epoch, in one tangent frame; the quaternion
    takes body to that frame. Times are UTC, seconds since 1970, or those of the trial.
    """
    t = motion.trajectory
    known = np.isfinite(t.geodetic).all(axis=1) & np.isfinite(t.rph).all(axis=1)
    geodetic = t.geodetic[known]
    frame = LocalFrame(*geodetic[0])
    level = rotation_from_rph(t.rph[known], motion.body_axes)
    tangent = frame.level_from_tangent(geodetic[:, 0], geodetic[:, 1])
    nRb = np.swapaxes(tangent, 1, 2) @ level
    quaternion = Rotation.from_matrix(nRb).as_quat(canonical=True)
    time = np.where(np.isnan(motion.utc), t.time, motion.utc)[known]
    rows = np.column_stack([time, frame.position(*geodetic.T), quaternion])
    np.savetxt(path, rows, fmt=["%.6f", *["%.6f"] * 3, *["%.9f"] * 4])
