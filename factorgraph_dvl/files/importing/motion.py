"""The records of a trial that need no choice of axes: IMU, navigation solution, depth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import Beside, Merged, merge
from factorgraph_dvl.files.importing.positions import best_source
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.files.motion_table import COLUMNS, STD_COLUMNS
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array

# Chosen: time between samples of an IMU, s, in which a vehicle turns and turns back unseen.
_SLOWEST_IMU = 0.1
_STDS = ("std", "velocity_std", "attitude_std")


def choose(streams: Sequence[Timed], kind: str, decisions: Decisions) -> Merged | None:
    """Return the records of a kind from its fullest source in all files, None without."""
    return merge(best_source(streams, (kind,), _count, decisions), decisions)


def choose_imu(streams: Sequence[Timed], decisions: Decisions) -> Merged | None:
    """Return the samples of the fullest IMU, None without one or if it is too slow to integrate.

    An IMU that is too slow is kept if nothing else says how the vehicle turned.
    """
    imu = choose(streams, "imu", decisions)
    if imu is None or imu.count < 2:
        return imu
    time = imu.sample_time
    step = float(np.median(np.diff(time))) * len(time) / imu.count
    others = [t.stream.label for t in streams if t.stream.kind in ("attitude", "ins") and t.known]
    if step <= _SLOWEST_IMU or not others:
        return imu
    decisions.add(
        imu.label,
        f"samples {step:.2g} s apart do not show how the vehicle moved in between → the IMU is "
        f"not used, but {others[0]}",
    )
    return None


def _count(source: Sequence[Timed]) -> float:
    return float(sum(timed.known for timed in source))


def imu_tables(imu: Merged, epoch: float) -> Iterator[dict[str, Array]]:
    """Yield parts of the table `imu`."""
    for time, part in imu.chunks():
        good = np.isfinite(part["gyro"]).all(axis=1) & np.isfinite(part["accel"]).all(axis=1)
        names = [f"gyro_{axis}_rad_s" for axis in "xyz"], [f"accel_{axis}_m_s2" for axis in "xyz"]
        yield {
            "time_s": (time - epoch)[good],
            **{name: part["gyro"][good, i] for i, name in enumerate(names[0])},
            **{name: part["accel"][good, i] for i, name in enumerate(names[1])},
        }


def depth_tables(depth: Merged, epoch: float) -> Iterator[dict[str, Array]]:
    """Yield parts of the table `depth`."""
    for time, part in depth.chunks():
        yield {"time_s": time - epoch, "depth_m": part["depth"]}


@dataclass(frozen=True)
class Navigation:
    """A navigation solution.

    Parameters
    ----------
    ins : Merged
        INS in order.
    deviations : Merged or None
        Its standard deviations, where these have a file of their own.
    with_std : bool
        Whether it has standard deviations.
    """

    ins: Merged
    deviations: Merged | None
    with_std: bool

    @classmethod
    def of(cls, ins: Merged, deviations: Merged | None) -> Navigation:
        """Return the solution that records contain."""
        stds = [ins.sample[name] for name in _STDS]
        has_own = all(np.isfinite(std).any() for std in stds)
        return cls(ins, None if has_own else deviations, has_own or deviations is not None)

    def tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table `ins`."""
        beside = None if self.deviations is None else Beside(self.deviations)
        for time, part in self.ins.chunks():
            values = np.column_stack(
                [
                    time - epoch,
                    part["lat"] / DEG,
                    (part["lon"] / DEG + 180.0) % 360.0 - 180.0,
                    part["height"],
                    part["velocity"],
                    *(part[name] / DEG for name in ("roll", "pitch")),
                    part["heading"] / DEG % 360.0,
                ]
            )
            good = np.isfinite(values).all(axis=1)
            table = dict(zip(COLUMNS, values[good].T, strict=True))
            if self.with_std:
                stds = np.column_stack([part[name] for name in _STDS])
                if beside is not None:
                    stds = _at(time, *beside.around(time))
                stds[:, 6:] /= DEG
                table |= dict(zip(STD_COLUMNS, stds[good].T, strict=True))
            yield table


def _at(time: Array, own: Array, records: Records) -> Array:
    """Return the standard deviations (N, 9) at times (N,), linear between records."""
    values = np.column_stack([records[name] for name in _STDS])
    return np.column_stack([np.interp(time, own, column) for column in values.T])
