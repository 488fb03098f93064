"""Values with which instruments mark what they have not measured, taken as missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from factorgraph_dvl.geometry.vectors import Array, BoolArray, IntArray
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import STD_COLUMNS, Dvl
from factorgraph_dvl.sensors.dvl import VELOCITY_COLUMNS as DVL_COLUMNS
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import POSITION_COLUMNS, VELOCITY_COLUMNS, Gnss
from factorgraph_dvl.sensors.imu import COLUMNS as IMU_COLUMNS
from factorgraph_dvl.sensors.imu import Imu

# No velocity, in m/s, and in mm/s that were not converted: TRDI, Rowe, and others.
_SENTINELS = (-32.768, -32768.0, 88.888, 88888.0, 99.99, -99.99, 99.999, -99.999)
_RELATIVE = 1e-5
# Speed of the neighbours from which on a velocity of exactly zero is none, m/s, and rows of zeros
# at an end of the record that are none. Chosen: far above what a vessel loses in a ping.
_MOVING_M_S = 0.3
_AT_AN_END = 3
# Rows that repeat all their values, and the step at their end, in usual steps and in the unit of
# the values, from which on they are frozen. Chosen: digits repeat by chance three times, not five.
# Of a vessel that moves they are so without a step where no row repeats the one before for less
# long: coarse digits do both.
_REPEATED = 5
_STEPS = 6.0
_LEAST_STEP = {"m_s": 0.02, "deg": 3e-5}
# Share of values that are written more than once, and how much more often than chance repeats all
# components, from which on a log is faster than its instrument. Chosen: one is so at any rate.
_HELD, _BY_CHANCE = 0.1, 0.1
# Share of the steps of a component that may be smaller than its last digit. Chosen: damaged ones.
_ROUNDED = 0.01
# Digits by which rows that were frozen change, at least. Chosen: coarse ones change by one.
_DIGITS = 2.0
# Share of the samples of the IMU that may be frozen. Chosen: more are written several times each.
_MOST_FROZEN = 0.3
# Latitude, longitude and height on one scale, deg: a metre is 1e-5 deg.
_FIX_DEG = np.array([1.0, 1.0, 1e-5])


# A damaged number may be too large for a product; ranges are checked later.
@np.errstate(over="ignore", invalid="ignore")
def without_invalid_values(
    section: str, columns: Mapping[str, Array], source: str
) -> tuple[dict[str, Array], list[Finding]]:
    """Return the columns of a table with invalid values as nan, and what was found.

    Rows of the IMU that are all zeros or frozen are left out: there a gap is a gap.

    Parameters
    ----------
    section : str
        Section of trial.yaml.
    columns : mapping of str to ndarray, shape (M,)
        Columns as read; left as they are.
    source : str
        Name of the file, for messages.
    """
    out = dict(columns)
    findings: list[Finding] = []
    if section == Dvl.section:
        _blank(out, DVL_COLUMNS, "DVL", source, findings, beside=STD_COLUMNS)
    elif section == DvlBeams.section:
        beams = [name for name in out if name.startswith("beam")]
        _blank(out, beams, "DVL beams", source, findings, single=True)
    elif section == Gnss.section:
        _blank(out, VELOCITY_COLUMNS, "GNSS", source, findings)
        _blank_fixes(out, source, findings)
    elif section == Imu.section:
        zero = np.logical_and.reduce([out[name] == 0.0 for name in IMU_COLUMNS[1:]])
        if 0 < zero.sum() < 0.5 * zero.size:
            out = {name: values[~zero] for name, values in out.items()}
            text = message("invalid_values.zero_samples", count=zero.sum())
            findings.append(_finding("IMU", source, [text]))
        channels = [out[name] for name in IMU_COLUMNS[1:]]
        frozen = frozen_samples(channels[:3]) | frozen_samples(channels[3:])
        if frozen.any():
            out = {name: values[~frozen] for name, values in out.items()}
            text = message("invalid_values.repeated_samples", count=frozen.sum())
            findings.append(_finding("IMU", source, [text]))
    return out, findings


def frozen_samples(triad: Sequence[Array]) -> BoolArray:
    """Return which samples of three channels (M,) repeat those before for long, (M,) bool.

    Three channels with digits of their own never do by chance. Coarse digits, and samples that are
    written several times, repeat in many runs.
    """
    same = np.logical_and.reduce([np.diff(channel) == 0.0 for channel in triad])
    begin, end = runs(same)
    long = end - begin >= _REPEATED
    out = np.zeros(triad[0].size, dtype=bool)
    if np.count_nonzero(~long) > np.count_nonzero(long):
        return out
    for a, b in zip(begin[long].tolist(), end[long].tolist(), strict=True):
        out[a + 1 : b + 1] = True
    return out & (np.count_nonzero(out) < _MOST_FROZEN * out.size)


def runs(true: BoolArray) -> tuple[IntArray, IntArray]:
    """Return where runs of true (M,) begin, and where they end."""
    inside = np.pad(true, 1)
    edges = np.flatnonzero(inside[1:] != inside[:-1])
    return edges[::2], edges[1::2]


def _blank(
    columns: dict[str, Array],
    names: Sequence[str],
    label: str,
    source: str,
    findings: list[Finding],
    *,
    single: bool = False,
    beside: Sequence[str] = (),
) -> None:
    """Blank velocities that are none; with `single`, each component by itself."""
    if not set(names) <= set(columns):
        return
    values = np.stack([columns[name] for name in names], axis=1)
    none = np.zeros(values.shape, dtype=bool)
    words = []
    for sentinel in _SENTINELS:
        marked = np.abs(values - sentinel) < _RELATIVE * abs(sentinel)
        if marked.any():
            count = int(marked.any(axis=1).sum())
            words.append(message("invalid_values.sentinel", count=count, sentinel=sentinel))
        none |= marked
    if not single:
        none[none.any(axis=1)] = True
    kept = np.where(none, np.nan, values)
    zero = _zero_fills(kept)
    if zero.any():
        words.append(message("invalid_values.zeros", count=int(zero.sum())))
        none[zero] = True
    kept = np.where(none, np.nan, values)
    moving = np.sqrt(np.nansum(kept**2, axis=1)) > _MOVING_M_S
    frozen = _frozen(kept, _LEAST_STEP["m_s"], moving)
    if frozen.any():
        words.append(message("invalid_values.repeated", count=int(frozen.sum())))
        none[frozen] = True
    held = _held(np.where(none, np.nan, values), moving)
    if held.any():
        words.append(message("invalid_values.held", count=int(held.sum())))
        none[held] = True
    if words:
        kept = np.where(none, np.nan, values)
        for i, name in enumerate(names):
            columns[name] = kept[:, i]
        for name in set(beside) & set(columns):
            columns[name] = np.where(none.any(axis=1), np.nan, columns[name])
        findings.append(_finding(label, source, words))


def _blank_fixes(columns: dict[str, Array], source: str, findings: list[Finding]) -> None:
    if not set(POSITION_COLUMNS) <= set(columns):
        return
    values = np.stack([columns[name] for name in POSITION_COLUMNS], axis=1)
    zero = np.all(values[:, :2] == 0.0, axis=1)
    known = values[~zero & ~np.isnan(values[:, 0]), :2]
    elsewhere = np.abs(np.median(known, axis=0)) if len(known) else np.zeros(2)
    zero &= bool(np.any(elsewhere > 1.0))
    fixes = np.where(zero[:, None], np.nan, values * _FIX_DEG)
    # Receivers at rest hold their fix.
    frozen = _frozen(fixes, _LEAST_STEP["deg"], np.zeros(zero.size, dtype=bool))
    words = []
    if zero.any():
        words.append(message("invalid_values.zero_fixes", count=int(zero.sum())))
    if frozen.any():
        words.append(message("invalid_values.repeated_fixes", count=int(frozen.sum())))
    none = zero | frozen
    held = _held(np.where(none[:, None], np.nan, values), ~none)
    if held.any():
        words.append(message("invalid_values.held", count=int(held.sum())))
    if words:
        kept = np.where((none | held)[:, None], np.nan, values)
        for i, name in enumerate(POSITION_COLUMNS):
            columns[name] = kept[:, i]
        findings.append(_finding("GNSS", source, words))


def _zero_fills(values: Array) -> Array:
    """Return which rows (M, n) are zeros while the rows around them move, (M,) bool."""
    zero = np.all(values == 0.0, axis=1)
    moving = np.flatnonzero(~zero & ~np.isnan(values).all(axis=1))
    if not zero.any() or moving.size == 0:
        return np.zeros(zero.size, dtype=bool)
    speed = np.sqrt(np.nansum(values[moving] ** 2, axis=1))
    rows = np.flatnonzero(zero)
    after = np.searchsorted(moving, rows)
    ends = np.concatenate([[np.inf], speed, [np.inf]])
    slower = np.minimum(ends[after], ends[after + 1])
    first, last = moving[0], moving[-1]
    many = np.where(rows < first, first, np.where(rows > last, zero.size - 1 - last, _AT_AN_END))
    out = np.zeros(zero.size, dtype=bool)
    out[rows] = (slower > _MOVING_M_S) & (many >= _AT_AN_END)
    return out


def _frozen(values: Array, least: float, moving: np.ndarray) -> Array:
    """Return which rows (M, n) repeat those before until the value jumps, (M,) bool.

    Where `moving` (M,), without a jump too, if nothing repeats by chance or for coarse digits.
    """
    there = np.flatnonzero(~np.isnan(values).any(axis=1))
    out = np.zeros(values.shape[0], dtype=bool)
    if there.size < 2 * _REPEATED:
        return out
    components = np.abs(np.diff(values[there], axis=0))
    steps = np.linalg.norm(components, axis=1)
    usual = float(np.median(steps))
    if usual == 0.0:
        return out
    digit = _last_digit(components[components > 0.0])
    starts, ends = runs(steps == 0.0)
    long = ends - starts >= _REPEATED - 1
    by_chance = np.count_nonzero(~long) > np.count_nonzero(long)
    for begin, end in zip(starts.tolist(), ends.tolist(), strict=True):
        # Steps begin .. end - 1 are zero: rows begin + 1 .. end repeat row begin.
        after = steps[end] if end < steps.size else usual
        jumps = end < steps.size and after > max(_STEPS * usual, least)
        changes = after > _DIGITS * digit
        surely = jumps or (moving[there[begin]] and changes and not by_chance)
        if end - begin + 1 >= _REPEATED and surely:
            out[there[begin + 1 : end + 1]] = True
    return out


def _held(values: Array, moving: BoolArray) -> BoolArray:
    """Return which rows (M, n) were written before, by a log that is faster than its instrument.

    Of rows that are `moving` (M,). Those repeat all components more often than their digits make
    it by chance: where a smooth motion repeats coarse digits, they change by one at a time, and
    after any time.
    """
    there = np.flatnonzero(moving & ~np.isnan(values).any(axis=1))
    out = np.zeros(moving.size, dtype=bool)
    steps = np.abs(np.diff(values[there], axis=0))
    every = (steps == 0.0).all(axis=1) & (np.diff(there) == 1)
    begin, end = runs(every)
    new = int(np.count_nonzero(~every))
    # Those that chance makes are of any length.
    usual, long = np.quantile(end - begin, [0.5, 0.9]) if begin.size else (0.0, 0.0)
    if min(begin.size, new) < _REPEATED or long > 2.0 * usual + 1.0:
        return out
    edges = np.unique(np.concatenate([begin[begin > 0] - 1, end[end < every.size]]))
    chances = (_chance(every_step, every_step[edges]) for every_step in steps.T)
    share = begin.size / (new + 1)
    if share > _HELD and np.prod(list(chances)) < _BY_CHANCE * share:
        out[there[1:][every]] = True
    return out


def _chance(steps: Array, beside: Array) -> float:
    """Return how probably a component repeats, if its steps (M,) are as large as some of them."""
    nonzero, beside = steps[steps > 0.0], beside[beside > 0.0]
    if not beside.size:
        return 1.0
    return min(_last_digit(nonzero) / float(np.median(beside)), 1.0)


def _last_digit(steps: Array) -> float:
    """Return the unit of the last digit of values, from their steps (M,) that are none of zero."""
    return float(np.quantile(steps, _ROUNDED))


def _finding(label: str, source: str, words: Sequence[Message]) -> Finding:
    return Finding(
        Code.INVALID_VALUES,
        message("invalid_values.missing", values=words, source=source),
        label,
    )
