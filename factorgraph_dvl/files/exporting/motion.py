"""A trajectory with UTC, as what every format is written from."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.estimates import Trajectory
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.solution import Solution

# Times of a trial that are seconds since 1970 already. Chosen: since 2001.
_UNIX_FROM = 1e9


@dataclass(frozen=True)
class ExportedMotion:
    """A trajectory and when it was.

    Parameters
    ----------
    name : str
        Name of the trial.
    trajectory : Trajectory
        Motion of the IMU.
    body_axes : BodyAxes
        Axes of the body.
    utc : ndarray, shape (M,), s
        Seconds since 1970-01-01T00:00:00 UTC; nan where nobody knows.
    summary : str
        The verdict, for formats that have room for a remark.
    """

    name: str
    trajectory: Trajectory
    body_axes: BodyAxes
    utc: Array
    summary: str

    def known_utc(self, kind: str) -> Array:
        """Return UTC for a format that cannot do without.

        Raises
        ------
        DataError
            If it is not known.
        """
        if np.isnan(self.utc).any():
            raise DataError(
                f"{kind} needs UTC, and the trial has no epoch",
                expected="`epoch` in trial.yaml: the UTC of time_s = 0",
                hint="Add it and solve again, or export another format",
            )
        return self.utc


def exported_motion(solution: Solution, epoch: str) -> ExportedMotion:
    """Return what is exported of a solution.

    Parameters
    ----------
    solution : Solution
        Solution with a trajectory.
    epoch : str
        UTC of time zero, ISO 8601; empty if not known. Times after 2001 in seconds since 1970
        are UTC without it.
    """
    time = solution.trajectory.time
    if epoch:
        start = datetime.fromisoformat(epoch)
        start = start if start.tzinfo else start.replace(tzinfo=UTC)
        utc = start.timestamp() + time
    else:
        utc = time if time[0] > _UNIX_FROM else np.full(time.size, np.nan)
    verdict = solution.verdict
    summary = ": ".join([f"graded {verdict.grade}", *map(str, verdict.reasons[:1])])
    return ExportedMotion(solution.trial, solution.trajectory, solution.body_axes, utc, summary)


def iso_times(utc: Array) -> list[str]:
    """Return UTC (M,), s, as ISO 8601 to the millisecond."""
    milliseconds = np.round(utc * 1e3).astype("datetime64[ms]")
    return [f"{text}Z" for text in np.datetime_as_string(milliseconds).tolist()]
