"""The DVL record of a trial: velocities in instrument axes, or along beams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing.axes import beam_geometry, describe_axes, in_instrument_axes
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import SAMPLE, Merged, merge
from factorgraph_dvl.files.importing.positions import best_source
from factorgraph_dvl.files.importing.recognition import by_name
from factorgraph_dvl.files.importing.speeds import speed_of
from factorgraph_dvl.files.importing.time_base import Timed
from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array, rotate, spread
from factorgraph_dvl.sensors.dvl import STD_COLUMNS, VELOCITY_COLUMNS
from factorgraph_dvl.sensors.dvl_beams import beam_columns

# Chosen: the least σ that a log is taken to have, and that of one that says nothing, m/s.
_LEAST_STD, _USUAL_STD = 0.005, 0.02
# One in 1.7 million of normal errors is larger than so many standard deviations.
_GROSS = 5.0
_CONTRADICTORY = (
    "{}: {} of {} pings with an error velocity above 5 σ, half of them from {:.0f} to {:.0f} s "
    "after the first ping: the beams contradict each other, look for a false bottom lock there"
)


@dataclass(frozen=True)
class Velocities:
    """Pings over the bottom or through the water.

    Parameters
    ----------
    pings : Merged
        Pings in order.
    reference : {'bottom', 'water'}
        What velocities are relative to.
    directions : ndarray, shape (4, 3), or None
        Outward beams, if velocities along beams are to be used.
    std : float, m/s
        Standard deviation of a velocity, or of one along a beam.
    own_std : bool
        Whether the instrument states that of each ping.
    window : float, s
        Length over which a ping is a mean; 0 where the instrument does not state it.
    locked, count : int
        Pings with lock, and all.
    turn : ndarray, shape (3, 3)
        Rotation from the axes of the instrument to those that are written.
    """

    pings: Merged
    reference: str
    directions: Array | None
    std: float
    own_std: bool
    window: float
    locked: int
    count: int
    turn: Array = field(default_factory=lambda: np.eye(3))

    @property
    def axes(self) -> BodyAxes | Literal[""]:
        """Axes of the instrument, empty if they are not known."""
        return self.pings.streams[0].stream.axes

    @property
    def section(self) -> str:
        """Section of trial.yaml, and name of the table."""
        return "dvl" if self.directions is None else "dvl_beams"

    def tables(self, epoch: float) -> Iterator[dict[str, Array]]:
        """Yield parts of the table."""
        for time, part in self.pings.chunks():
            table = {"time_s": time + np.nan_to_num(part["delay"]) - epoch}
            if self.directions is not None:
                names = beam_columns(len(self.directions))
                yield table | {name: part["beams"][:, i] for i, name in enumerate(names)}
                continue
            velocity = in_instrument_axes(part) @ self.turn.T
            velocity[np.isnan(velocity).any(axis=1)] = np.nan
            table |= {name: velocity[:, i] for i, name in enumerate(VELOCITY_COLUMNS)}
            if self.own_std:
                std = np.where(np.isfinite(velocity), part["std"] @ np.abs(self.turn.T), np.nan)
                table |= {name: std[:, i] for i, name in enumerate(STD_COLUMNS)}
            yield table


def named_as(log: Velocities, body: BodyAxes, decisions: Decisions) -> Velocities:
    """Return pings in axes that are named as those of the body, if the instrument's are known."""
    if not log.axes or log.axes == body:
        return log
    turn = np.asarray(frd_from_body(body).T @ frd_from_body(log.axes))
    decisions.add(
        log.pings.label,
        f"axes {log.axes} of the DVL → {body}, as those of the body: aligned with it, the "
        "misalignment is zero",
    )
    directions = None if log.directions is None else rotate(turn, log.directions)
    return replace(log, turn=turn, directions=directions)


def choose(streams: Sequence[Timed], decisions: Decisions) -> Velocities | None:
    """Return the pings of all files, None if there is no velocity log.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all kinds.
    decisions : Decisions
        Takes what was chosen, and why.

    Raises
    ------
    DataError
        If the files are of several instruments.
    """
    streams = _without_repetition(streams, decisions)
    _check_one_instrument(streams)
    usable = _usable(streams, decisions)
    for kind, reference in (("dvl", "bottom"), ("water", "water")):
        pings = merge(best_source(usable, (kind,), _lock, decisions), decisions)
        if pings is None:
            continue
        locked = sum(int(np.isfinite(speed_of(part)).sum()) for _, part in pings.chunks())
        has_water = any(timed.stream.kind == "water" for timed in streams)
        if kind == "dvl" and locked == 0 and has_water:
            continue
        return _velocities(pings, reference, locked, decisions)
    return None


def _without_repetition(streams: Sequence[Timed], decisions: Decisions) -> list[Timed]:
    """Leave out what a vehicle logged of its DVL where the log of the DVL itself is there."""
    own = [t.stream for t in streams if t.stream.kind in ("dvl", "water")]
    logs = [stream for stream in own if by_name(stream.format).family in ("dvl", "table")]
    out = []
    for timed in streams:
        if logs and timed.stream in own and timed.stream not in logs:
            decisions.add(
                timed.stream.label, f"left out: it repeats the DVL's own log, {logs[0].file}"
            )
        else:
            out.append(timed)
    return out


def _usable(streams: Sequence[Timed], decisions: Decisions) -> list[Timed]:
    out = []
    for timed in streams:
        if timed.known:
            out.append(timed)
        elif timed.stream.kind in ("dvl", "water"):
            decisions.add(
                timed.stream.label, f"{len(timed.time)} pings, none with a time → left out"
            )
    return out


def _lock(source: Sequence[Timed]) -> float:
    return float(
        sum(np.isfinite(speed_of(timed.stream.records[:SAMPLE])).sum() for timed in source)
    )


def _check_one_instrument(streams: Sequence[Timed]) -> None:
    """Raise DataError where files are of several velocity logs: they are not one record."""
    logs: dict[tuple[object, ...], str] = {}
    for timed in streams:
        if timed.stream.kind == "dvl":
            angles = timed.stream.records[:SAMPLE]["beam_angle"]
            angle = float(np.nanmedian(angles)) / DEG if np.isfinite(angles).any() else 0.0
            logs.setdefault((timed.stream.format, round(angle)), timed.stream.file)
    if len(set(logs.values())) > 1:
        raise DataError(
            f"the files are from {len(logs)} velocity logs ({', '.join(logs.values())})",
            where="import",
            expected="files of one log; import the others to separate trials",
        )


def _velocities(pings: Merged, reference: str, locked: int, decisions: Decisions) -> Velocities:
    count = pings.count
    label = pings.label
    what = (
        "pings with bottom lock"
        if reference == "bottom"
        else "pings with a velocity through water"
    )
    decisions.add(label, f"{locked} of {count} {what}", "dvl.file")
    if reference == "water":
        decisions.add(
            label,
            "no bottom track → mean velocity through the water of the cells that are mostly good, "
            "with a current to estimate",
            "dvl.reference",
        )
    describe_axes(pings, decisions)
    directions = beam_geometry(pings) if locked and reference == "bottom" else None
    sample = pings.sample
    own_std = bool(np.isfinite(sample["std"]).any()) and directions is None
    std, window = _std(pings, decisions), _window(sample, label, decisions)
    return Velocities(pings, reference, directions, std, own_std, window, locked, count)


def _window(sample: Records, label: str, decisions: Decisions) -> float:
    stated = sample["window"][np.isfinite(sample["window"])]
    if not len(stated):
        return 0.0
    window = round(float(np.median(stated)), 3)
    decisions.add(
        label,
        f"each velocity is a mean → a window of {window:g} s",
        "dvl.averaging_s",
    )
    return window


def _std(pings: Merged, decisions: Decisions) -> float:
    label, known = pings.label, np.isfinite(pings.sample["error"])
    error = pings.sample["error"][known]
    # The error velocity is scaled so that its σ is that of the horizontal velocities. Where most
    # have one value, as 0, the instrument does not measure it.
    usual = float(spread(error - np.median(error))) if len(error) else 0.0
    if usual > 0.0:
        value = max(_LEAST_STD, round(usual, 4))
        decisions.add(
            label,
            f"σ of velocities from the spread of the error velocity: {usual:.4f} m/s → {value:g}",
            "dvl.velocity_std_m_s",
        )
        gross = np.abs(error - np.median(error)) > _GROSS * value
        if gross.any():
            after = pings.sample_time[known][gross] - pings.sample_time[0]
            begin, end = np.quantile(after, [0.25, 0.75])
            decisions.warn(_CONTRADICTORY.format(label, int(gross.sum()), len(error), begin, end))
        return value
    decisions.add(label, "no error velocity → σ chosen as is usual", "dvl.velocity_std_m_s")
    return _USUAL_STD
