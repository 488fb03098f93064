"""A trial folder of what raw files contain: sections of trial.yaml, tables, import.log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.files.formats.format import empty, has_place
from factorgraph_dvl.files.formats.framing import Records
from factorgraph_dvl.files.importing import (
    motion,
    orientation,
    positions,
    transceiver,
    velocity,
)
from factorgraph_dvl.files.importing.decisions import Decisions
from factorgraph_dvl.files.importing.merging import Merged
from factorgraph_dvl.files.importing.time_base import FIRST_DATE, Timed
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.settings.yaml_file import dump_yaml
from factorgraph_dvl.trial import NO_LOCK, NO_MOTION, NO_POSITION, NO_VELOCITY

# Kinds of records, besides fixes, that say where a trial is.
_PLACED = ("ins", "topside")
# Why records of a kind are not used.
_UNUSED = {
    "attitude": "attitude: an IMU or a navigation solution says how the vehicle turns",
    "ins": "navigation solution: there are an IMU and positions",
    "ins_std": "standard deviations: no navigation solution has them",
    "course": "course and speed: there are no fixes that they belong to",
    "dvl": "velocities over the bottom: no ping has lock",
    "water": "velocities through the water: there are those over the bottom",
}
Tables = Callable[[float], Iterator[dict[str, Array]]]
SUFFIX = ".parquet"
# Chosen: priors of misalignment, deg, and of lever arms, m. Tilt sensors inside a DVL are aligned
# with its beams to a degree; a compass there may be off by anything. Beams that are 20 to 30° from
# the axis of a DVL lose the bottom if that is tilted by more than some tens of degrees.
_INSIDE, _DOWNWARD, _UNKNOWN_ARM = [1.0, 1.0, 180.0], [30.0, 30.0, 180.0], [10.0, 10.0, 10.0]
# Chosen: biases of logs that come with no data sheet, m/s, on a bed that may move.
_BIAS = [0.005, 0.005, 0.005]
# Chosen: clocks that are related by when sentences arrived, without an IMU that would relate them
# better, and the latency of instruments, s.
_LATENCY = 2.0
# Chosen: latency of attitudes beside other records by the same clock, s: filters and means.
_SAME_CLOCK = 1.0
# Chosen: how long errors of attitude sensors and compasses stay alike, s.
_ATTITUDE_CORRELATION = 300.0


@dataclass
class Assembly:
    """Sections and tables of a trial as they are put together.

    Parameters
    ----------
    decisions : Decisions
        Takes what was done, and why.
    settings : dict
        Settings of trial.yaml, by section.
    tables : dict of str to callable
        Tables by section: given the epoch, yields parts of the table.
    """

    decisions: Decisions
    settings: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, Tables] = field(default_factory=dict)

    def add(self, section: str, tables: Tables, **keys: Any) -> None:
        """Add a section with its table."""
        self.settings[section] = {"file": section + SUFFIX, **keys}
        self.tables[section] = tables


def assemble(streams: Sequence[Timed], name: str, decisions: Decisions) -> tuple[Assembly, float]:
    """Choose what of the files makes a trial.

    Parameters
    ----------
    streams : sequence of Timed
        Streams of all files.
    name : str
        Name of the trial.
    decisions : Decisions
        Takes what was chosen, and what is missing.

    Returns
    -------
    assembly : Assembly
        Sections and tables.
    epoch : float
        UTC of time zero, a whole second, s since 1970.
    """
    out = Assembly(decisions)
    first = min((first for t in streams for first, _ in t.blocks), default=0.0)
    epoch = float(np.floor(first))
    out.settings |= {"format": 1, "name": name}
    if epoch >= FIRST_DATE:
        out.settings["epoch"] = f"{np.datetime64(int(epoch), 's')}Z"
    imu = motion.choose_imu(streams, decisions)
    ins = None if imu is not None else motion.choose(streams, "ins", decisions)
    gnss = positions.choose(streams, decisions)
    if imu is not None and gnss is None:
        gnss = positions.choose(fixes_of_navigation(streams, decisions), decisions)
    raw = transceiver.choose(streams, decisions)
    where = _place(gnss, streams)
    attitude = None
    if imu is None and ins is None:
        attitude = orientation.choose(streams, where, decisions)
    carrier = imu if imu is not None else ins if ins is not None else None
    if attitude is not None:
        carrier = attitude.attitude
    axes = carrier.streams[0].stream.axes if carrier is not None else ""
    out.settings["body_axes"] = axes or "RFU"
    if imu is not None:
        out.add("imu", lambda zero: motion.imu_tables(imu, zero), grade="tactical")
        decisions.add(
            imu.label,
            f"{imu.count} samples → grade chosen; state that of your IMU",
            "imu.grade",
        )
    has_body = imu is not None or ins is not None
    under_water = gnss is not None and gnss.fixes.streams[0].stream.kind == "transponder"
    if gnss is not None and not under_water:
        _add_gnss(out, gnss, has_body)
    if raw is not None:
        _add_usbl(out, raw.tables, has_body, raw.ship_tables)
    elif gnss is not None and under_water:
        _add_usbl(out, gnss.tables, has_body)
    deviations = None if ins is None else motion.choose(streams, "ins_std", decisions)
    if ins is not None:
        _add_ins(out, ins, deviations)
    log = velocity.choose(streams, decisions)
    if attitude is not None:
        _add_attitude(out, attitude, _clock_of(attitude, log, gnss))
    if log is not None:
        if not axes and imu is None and ins is None and log.axes:
            # A heading alone has no axes.
            out.settings["body_axes"] = log.axes
        log = velocity.named_as(log, out.settings["body_axes"], decisions)
        _add_log(out, log, attitude)
    depth = motion.choose(streams, "depth", decisions)
    if depth is not None:
        out.add("depth", lambda zero: motion.depth_tables(depth, zero), std_m=0.1)
    chosen = [imu, ins] if attitude is None else [attitude.attitude]
    chosen += [] if gnss is None else [gnss.fixes, gnss.courses]
    chosen += [deviations, depth] if log is None else [deviations, depth, log.pings]
    chosen += [] if raw is None else [raw.measured, raw.position, raw.attitude]
    used = [part for part in chosen if part is not None]
    _say_unused(streams, used, decisions)
    _say_apart(used, decisions)
    if gnss is None and ins is None and raw is None:
        decisions.lack(NO_POSITION)
    if log is None:
        decisions.lack(NO_VELOCITY)
    elif log.locked == 0:
        decisions.lack(NO_LOCK.format(count=log.count))
    if imu is None and ins is None and attitude is None:
        decisions.lack(NO_MOTION)
    return out, epoch


def fixes_of_navigation(streams: Sequence[Timed], decisions: Decisions) -> list[Timed]:
    """Return the positions and velocities of navigation solutions as fixes, beside an IMU."""
    out = []
    for timed in streams:
        if timed.stream.kind != "ins":
            continue
        records = timed.stream.records.converted(_as_fixes)
        decisions.add(
            timed.stream.label,
            "positions and velocities of the navigation solution → fixes beside the IMU; they "
            "must not come from the same IMU and DVL",
            "gnss.file",
        )
        out.append(replace(timed, stream=replace(timed.stream, kind="fix", records=records)))
    return out


def _as_fixes(navigation: Records) -> Records:
    out = empty("fix", len(navigation))
    for name in ("at", "time", "received", "lat", "lon", "height"):
        out[name] = navigation[name]
    for name in ("velocity", "std", "velocity_std"):
        out[name] = navigation[name]
    return out


def _place(
    gnss: positions.Positions | None, streams: Sequence[Timed]
) -> tuple[float, float] | None:
    """Return a latitude and longitude of the trial, rad."""
    parts = [] if gnss is None else [gnss.fixes.sample]
    parts += [timed.stream.records[:1000] for timed in streams if timed.stream.kind in _PLACED]
    for part in parts:
        known = part[has_place(part)]
        if len(known):
            return float(np.median(known["lat"])), float(np.median(known["lon"]))
    return None


def _say_apart(used: Sequence[Merged], decisions: Decisions) -> None:
    """Warn of records that have no time in common with the first ones, of the motion."""
    for other in used[1:]:
        (begin, end), (start, stop) = (part.sample_time[[0, -1]] for part in (used[0], other))
        if start > end or stop < begin:
            decisions.warn(f"{other.label}: no time in common with {used[0].label}")


def _say_unused(streams: Sequence[Timed], used: Sequence[Merged], decisions: Decisions) -> None:
    """Say of the kinds of which nothing is used why; of others `best_source` says it."""
    kinds = {timed.stream.kind for part in used for timed in part.streams}
    labels = {timed.stream.label for part in used for timed in part.streams}
    for timed in streams:
        kind, label = timed.stream.kind, timed.stream.label
        # A navigation solution beside an IMU may be used as fixes.
        is_used = kind in kinds or (kind == "ins" and label in labels)
        if timed.known and kind in _UNUSED and not is_used:
            decisions.add(label, f"{_UNUSED[kind]} → not used")


def _add_usbl(out: Assembly, tables: Tables, has_body: bool, ship: Tables | None = None) -> None:
    """Add positions of a transponder under water, or what the transceiver of a ship measured."""
    keys: dict[str, Any] = {"transponder_lever_arm_m": [0.0, 0.0, 0.0]}
    out.decisions.add(
        "usbl.transponder_lever_arm_m",
        "no file states where the transponder is on the vehicle → at the origin of the body; "
        "measure it, and state it",
    )
    if not has_body:
        keys["time_offset_std_s"] = 0.0
        out.decisions.add(
            "usbl.time_offset_std_s", "no IMU → the clock of the positions is that of the trial"
        )
    if ship is not None:
        keys["ship"] = {"file": "ship" + SUFFIX, "transceiver_lever_arm_m": [0.0, 0.0, 0.0]}
        out.tables["ship"] = ship
        out.decisions.add(
            "usbl.ship",
            "no file states where the transceiver is on the ship → at the point whose position "
            "is recorded; measure it, and state it",
            "usbl.ship",
        )
    out.add("usbl", tables, **keys)


def _add_gnss(out: Assembly, gnss: positions.Positions, has_body: bool) -> None:
    keys: dict[str, Any] = {"lever_arm_m": [0.0, 0.0, 0.0]}
    if has_body:
        keys["lever_arm_std_m"] = _UNKNOWN_ARM
        out.decisions.add(
            "gnss.lever_arm_m",
            "no file states the antenna's position → estimated; measure it, right, forward and up "
            "of the IMU, and state it with its σ",
            "gnss.lever_arm_std_m",
        )
    else:
        keys["lever_arm_std_m"] = [0.0, 0.0, 0.0]
        out.decisions.add(
            "gnss.lever_arm_m",
            "no IMU → the antenna is the origin of the body, from which lever arms run",
            "gnss.lever_arm_std_m",
        )
        keys["time_offset_std_s"] = 0.0
        out.decisions.add(
            "gnss.time_offset_std_s",
            "no IMU → UTC of the fixes is the clock of the trial",
            "gnss.time_offset_std_s",
        )
    if gnss.courses is not None:
        keys["velocity_correlation_time_s"] = positions.VELOCITY_CORRELATION
        out.decisions.add(
            gnss.courses.label,
            "receivers filter course and speed → their errors are correlated in time",
            "gnss.velocity_correlation_time_s",
        )
    out.add("gnss", gnss.tables, **keys)


def _add_ins(out: Assembly, ins: Merged, deviations: Merged | None) -> None:
    navigation = motion.Navigation.of(ins, deviations)
    keys: dict[str, Any] = {"correlated_share": 1.0}
    out.decisions.add(
        ins.label,
        f"{ins.count} records of a navigation solution, in place of an IMU",
        "ins.file",
    )
    out.decisions.add(
        ins.label, "errors of a filter or smoother are correlated in time", "ins.correlated_share"
    )
    if not navigation.with_std:
        keys |= {
            "position_std_m": [0.1, 0.1, 0.2],
            "velocity_std_m_s": [0.02, 0.02, 0.02],
            "attitude_std_deg": [0.02, 0.02, 0.05],
        }
        for key in ("position_std_m", "velocity_std_m_s", "attitude_std_deg"):
            out.decisions.add(
                f"ins.{key}",
                "not in the file → chosen; state what the system reports",
                f"ins.{key}",
            )
    out.add("ins", navigation.tables, **keys)


def _clock_of(
    attitude: orientation.ImportedAttitude,
    log: velocity.Velocities | None,
    gnss: positions.Positions | None,
) -> tuple[str, str]:
    """Return the section whose clock attitudes have, and why; empty if they have their own."""
    if attitude.own:
        return ("", "") if log is None else (log.section, "the attitude sensors are in the DVL")
    own = attitude.attitude.streams[0].stream
    fixes = None if gnss is None else gnss.fixes.streams[0].stream
    if fixes is not None and (own.file, own.clock) == (fixes.file, fixes.clock):
        return "gnss", "the headings come with the fixes"
    return "", ""


def _add_attitude(
    out: Assembly, attitude: orientation.ImportedAttitude, clock: tuple[str, str]
) -> None:
    keys: dict[str, Any] = {
        "std_deg": [float(value) for value in attitude.std],
        "correlation_time_s": _ATTITUDE_CORRELATION,
    }
    out.decisions.add(
        attitude.attitude.label,
        "σ in all, chosen as typical of such an instrument",
        "attitude.std_deg",
    )
    if attitude.offset_std:
        keys["heading_offset_std_deg"] = attitude.offset_std
    if attitude.deviation_std:
        keys["deviation_std_deg"] = attitude.deviation_std
        out.decisions.add(
            attitude.attitude.label,
            "the deviation of a magnetic compass depends on the heading → estimated",
            "attitude.deviation_std_deg",
        )
    section, why = clock
    if section:
        keys["clock"], keys["time_offset_std_s"] = section, _SAME_CLOCK
        out.decisions.add(
            attitude.attitude.label,
            f"{why} → one clock; how late they may be beside it, chosen",
            "attitude.clock",
        )
    out.add("attitude", attitude.tables, **keys)


def _add_log(
    out: Assembly, log: velocity.Velocities, attitude: orientation.ImportedAttitude | None
) -> None:
    keys: dict[str, Any] = {}
    if log.directions is not None:
        keys["directions"] = [[round(float(x), 6) for x in row] for row in log.directions]
        keys["parametrisation"] = "common"
        out.decisions.add(
            log.pings.label,
            "all pings are along beams → `dvl_beams`; the mounting is not known, so all beams "
            "have one common misalignment",
            "dvl_beams.parametrisation",
        )
    section = log.section
    keys["velocity_std_m_s"] = log.std
    if attitude is not None and attitude.own:
        keys["misalignment_std_deg"] = _INSIDE
        out.decisions.add(
            log.pings.label,
            "the attitude sensors are in the DVL → misalignment within a degree; any angle about "
            "the vertical, because it contains the error of the compass",
            f"{section}.misalignment_std_deg",
        )
    elif log.axes and log.reference == "bottom":
        keys["misalignment_std_deg"] = _DOWNWARD
        out.decisions.add(
            log.pings.label,
            "a DVL with bottom lock looks down → roll and pitch of its mount within some tens of "
            "degrees; any angle about the vertical",
            f"{section}.misalignment_std_deg",
        )
    else:
        keys["misalignment_std_deg"] = [180.0, 180.0, 180.0]
    keys["lever_arm_std_m"] = _UNKNOWN_ARM
    keys["bias_std_m_s"] = _BIAS
    out.decisions.add(
        log.pings.label, "no data sheet in the file → prior of a bias chosen", "dvl.bias_std_m_s"
    )
    if log.window > 0.0:
        keys["averaging_s"], keys["averaging_std_s"] = log.window, round(0.1 * log.window, 4)
    least = 0.5 if attitude is None else _LATENCY
    keys["time_offset_std_s"] = round(max(least, log.pings.offset_std), 3)
    if log.pings.rate_std:
        keys["clock_rate_std_ppm"] = round(log.pings.rate_std, 1)
    if log.directions is not None:
        # Beams have none.
        del keys["bias_std_m_s"]
    elif log.reference == "water":
        keys["reference"] = "water"
    out.add(section, log.tables, **keys)


def yaml_text(settings: Mapping[str, Any], comments: Mapping[str, str]) -> str:
    """Return the text of trial.yaml, each decision above the key that it stands behind."""

    def flow(value: Any) -> str:
        text = dump_yaml(value, flow=True, width=10_000)
        return text.removesuffix("...\n").strip()

    lines = ["# Imported by factorgraph-dvl; import.log says why each key is as it is"]
    for section, content in settings.items():
        if not isinstance(content, dict):
            lines.append(f"{section}: {flow(content)}")
            continue
        lines.append(f"{section}:")
        for key, value in content.items():
            comment = comments.get(f"{section}.{key}")
            if comment:
                lines.append(f"  # {comment}")
            lines.append(f"  {key}: {flow(value)}")
    return "\n".join(lines) + "\n"


def digest(text: bytes) -> str:
    """Return the SHA-256 of the text of a trial.yaml."""
    return hashlib.sha256(text).hexdigest()


def write_tables(assembly: Assembly, epoch: float, folder: Path) -> dict[str, int]:
    """Write the tables of an assembly, part by part; return their numbers of rows.

    Rows whose time does not increase, as of pings whose stamps were shifted, are left out.
    """
    from factorgraph_dvl.files.tables import TableWriter

    rows = {}
    for section, tables in assembly.tables.items():
        last = -np.inf
        with TableWriter(folder / f"{section}{SUFFIX}") as writer:
            for table in tables(epoch):
                time = table["time_s"]
                keep = np.diff(np.maximum.accumulate(time), prepend=last) > 0.0
                if not keep.all():
                    table = {name: values[keep] for name, values in table.items()}
                if keep.any():
                    last = float(table["time_s"][-1])
                writer.write(table)
        rows[section] = writer.rows
    return rows
