"""IMU, GNSS and DVL against each other: axes, clocks and places that contradict.

What is found wrong with the IMU is set right before the next question, so that several mistakes
are named at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.initialization.carried_windows import CarriedWindows, carried_windows
from factorgraph_dvl.initialization.clock_fit import Comparison
from factorgraph_dvl.initialization.clock_offsets import (
    ClockOffset,
    clock_offset,
    least_misfit,
    noise_share,
    stands_out,
)
from factorgraph_dvl.initialization.dvl_windows import DvlWindows, dvl_windows
from factorgraph_dvl.initialization.gnss_windows import GnssWindows, WindowFit, gnss_windows
from factorgraph_dvl.initialization.velocity_windows import isolated
from factorgraph_dvl.message import Message, either, message
from factorgraph_dvl.plausibility.axes import (
    BodyDirections,
    axes_that_fit,
    body_directions,
    in_words,
    off_course,
    relabelling,
    side_of_bow,
)
from factorgraph_dvl.plausibility.clocks import LEAP_SECONDS, clock_findings, far_clock_finding
from factorgraph_dvl.plausibility.dvl import mirrored_finding
from factorgraph_dvl.plausibility.imu import (
    CONTRADICTS,
    HANDEDNESS,
    UPRIGHT,
    Candidate,
    diagnosis,
)
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.records import rows_of
from factorgraph_dvl.trial import Trial

# Angle between bow and course from which on axes are wrong, and course change from which on it is
# no accident. Chosen: current and wind make less; a vehicle that goes sideways does not turn so.
_OFF_COURSE = 50.0 * DEG
_TURNED = 30.0 * DEG
# Error of the antenna's place that is said, m, and times σ. Chosen: what taking a wrong antenna
# for the right one makes; the scatter of correlated receivers.
_ARM_M = 0.3
_ARM_SIGMAS = 12.0
# Share of velocity changes that neither IMU nor noise explains, from which on clocks that are off
# by far are tried. Chosen: what wrong ones leave.
_UNEXPLAINED = 0.3
# Variance of what is left beside that of noise, from which on axes are tried as well. Chosen:
# wrong axes make motion of their own, of which what they do not explain is a small share.
_BEYOND_NOISE = 5.0
# Share of the changes of velocity that must be elsewhere to show what is wrong throughout.
_ENOUGH = 0.5
# Searches for gross errors, each with what those before left out. Chosen: the first sees the
# largest only.
_SEARCHES = 4
# Share of it that a cause may leave.
_LEFT = 0.5
# Residual, in medians, from which on it counts no more, and share of squares that another clock
# may leave to be believed. Chosen: outliers count alike by any clock.
_TRUNCATED = 5.0
_LEFT_BY_CLOCK = 0.9
# Offsets around which clocks that are off by far are looked for, and the reach, s. Chosen: a
# minute, after the leap seconds.
_FAR_S = (LEAP_SECONDS, -LEAP_SECONDS, *(s * k for k in range(9, 60, 9) for s in (1.0, -1.0)))
_REACH_S = 5.0
_FAR_STEP_S = 0.25
# Offset from which on a minimum may be the edge of a scan, s.
_AT_EDGE_S = 4.5
# Share of what is unexplained that such a clock may leave, and of all that the IMU leaves. Chosen:
# it explains all but outliers and noise.
_FAR_LEFT = 0.2
_FAR_LEFT_OF_ALL = 0.5
# Variance of a window beside the usual one from which on such a clock is looked for. Chosen:
# correlated noise leaves less.
_STANDS_OUT = 4.0
# How many times less mirrored axes of a DVL leave than right-handed ones, and scale error they
# may have. Chosen: sway repeats itself, so that a late clock mirrors some axes nearly.
_MIRRORED = 4.0
_LARGEST_SCALE_ERROR = 0.5
# Offset below which a clock is none that sway repeats, s.
_ALIASED_S = 0.05
# What sets velocities right whose third component is positive down.
_DOWN = np.diag([1.0, 1.0, -1.0])
# Errors of single sensors that leave nothing to compare.
_NO_IMU = frozenset(
    {
        Code.TIME_UNIT,
        Code.FORCE_UNIT,
        Code.GYRO_FROZEN,
        Code.IMU_CHANNEL,
        Code.FROZEN_VALUES,
        Code.SATURATED,
        Code.IMU_SPIKES,
    }
)


def consistency_findings(trial: Trial, errors: Sequence[Finding]) -> Iterator[Finding]:
    """Yield what is wrong with sensors relative to each other.

    Parameters
    ----------
    trial : Trial
        Records to compare.
    errors : sequence of Finding
        What is wrong with single sensors; those are left out.
    """
    if any(f.code in _NO_IMU for f in errors):
        return
    left_out = {f.sensor for f in errors}
    sensors = [s for s in (trial.gnss, trial.log) if s is not None and s.label not in left_out]
    windows = carried_windows(trial.inertial)
    if windows is None or not sensors:
        return

    def compare(windows: CarriedWindows) -> list[tuple[Comparison, float]]:
        made = [(_compared(windows, s, _stated(s)), _stated(s)) for s in sensors]
        return [(comparison, around) for comparison, around in made if comparison is not None]

    views = _views(windows, sensors)
    if max((view.excess for view in views), default=0.0) > CONTRADICTS:
        # What is grossly wrong for an instant says nothing of axes and clocks.
        sensors = [_without_gross_errors(s, views) for s in sensors]
        views = _views(windows, sensors)
    wrong: list[Candidate] = []
    suspected = any(f.code == Code.GYRO_UNIT for f in errors)
    suspected = suspected or any(view.beyond_noise > _BEYOND_NOISE for view in views)
    if suspected or max((view.excess for view in views), default=0.0) > CONTRADICTS:
        down_b = frd_from_body(trial.body_axes)[2]
        wrong = diagnosis(compare, trial.inertial, -down_b)
    if wrong:
        corrected = [
            _views(carried_windows(each.corrected(trial.inertial)) or windows, sensors)
            for each in wrong
        ]
        # One mistake is more probable than another one and a mirrored DVL.
        alone = [i for i, each in enumerate(corrected) if not any(v.mirrored for v in each)]
        wrong = [wrong[i] for i in alone] or wrong
        views = corrected[alone[0] if alone else 0]
        directions = next((v.directions() for v in views if isinstance(v, _GnssView)), None)
        yield _imu_finding(wrong, directions, trial.body_axes)
    for view in views:
        far = view.excess > _UNEXPLAINED or view.off > _AT_EDGE_S or _stands_out(view)
        found = _far(view) if far else view
        yield from found.findings()
        if isinstance(found, _GnssView) and not wrong:
            yield from _course_findings(found.directions(), trial.body_axes)


_Windows = TypeVar("_Windows", GnssWindows, DvlWindows)


def _stands_out(view: _GnssView | _DvlView) -> bool:
    if view.clock is None:
        return False
    return stands_out(view.compared, view.clock.late(view.compared.time)) > _STANDS_OUT


def _stated(sensor: Gnss | Dvl) -> float:
    return sensor.settings.velocity_lag_s[0]


def _compared(
    windows: CarriedWindows, sensor: Gnss | Dvl, around: float
) -> GnssWindows | DvlWindows | None:
    compared: GnssWindows | DvlWindows | None
    if isinstance(sensor, Gnss):
        compared = gnss_windows(windows, sensor, around)
    else:
        compared = dvl_windows(windows, sensor, around)
    return None if compared is None else compared.without_outliers(around)


def _without_outliers(compared: _Windows, around: float) -> _Windows:
    """Return a comparison without outliers: beside the clock as it is stated, or as it looks.

    With a wrong clock, what changes the motion stands out.
    """
    kept = compared.without_outliers(around)
    if kept.inside.sum() == compared.inside.sum():
        return kept
    clock = clock_offset(compared, around)
    if clock is None:
        return kept
    lefts = [
        np.linalg.norm(compared.residual(late), axis=2)[compared.inside]
        for late in (around, clock.late(compared.time))
    ]
    most = _TRUNCATED * max(min(float(np.median(left)) for left in lefts), compared.noise)
    stated, found = (float(np.sum(np.minimum(left, most) ** 2)) for left in lefts)
    if found < _LEFT_BY_CLOCK * stated:
        return compared.without_outliers(clock.late(compared.time))
    return kept


def _views(windows: CarriedWindows, sensors: Sequence[Gnss | Dvl]) -> list[_GnssView | _DvlView]:
    made = (_view(windows, sensor, _stated(sensor)) for sensor in sensors)
    return [view for view in made if view is not None]


def _view(
    windows: CarriedWindows, sensor: Gnss | Dvl, around: float
) -> _GnssView | _DvlView | None:
    if isinstance(sensor, Gnss):
        gnss = gnss_windows(windows, sensor, around)
        if gnss is None:
            return None
        gnss = _without_outliers(gnss, around)
        return _GnssView(windows, gnss, clock_offset(gnss, around), around, sensor)
    dvl = dvl_windows(windows, sensor, around)
    if dvl is None:
        return None
    dvl = _without_outliers(dvl, around)
    right = _dvl_view(windows, sensor, replace(dvl, handedness=1), around)
    if right.excess < CONTRADICTS and right.off < _ALIASED_S:
        return right
    mirrored = _dvl_view(windows, sensor, replace(dvl, handedness=-1), around)
    return mirrored if mirrored.believed_beside(right) else right


def _dvl_view(
    windows: CarriedWindows, sensor: Dvl, compared: DvlWindows, around: float
) -> _DvlView:
    return _DvlView(windows, compared, clock_offset(compared, around), around, sensor)


@dataclass(frozen=True)
class _View(Generic[_Windows]):
    """A sensor against the IMU; `clock` is None where there are too few data; `around`, s."""

    windows: CarriedWindows
    compared: _Windows
    clock: ClockOffset | None
    around: float

    @property
    def late(self) -> float | Array:
        """By how much the clock is late at each window, s."""
        return self.around if self.clock is None else self.clock.late(self.compared.time)

    @cached_property
    def excess(self) -> float:
        """Share of the changes of velocity that neither IMU nor noise explains.

        What is wrong with axes shows wherever the velocity changes; a share that only one window
        leaves, or two beside each other, is something else.
        """
        # Where noise is more than all changes of velocity, the IMU shows nothing to compare.
        if self.clock is None or noise_share(self.compared) > 1.0:
            return 0.0
        squares = np.sum(self.compared.residual(self.late) ** 2, axis=(1, 2))
        signal = self.compared.signal
        elsewhere = np.abs(np.arange(signal.size) - int(np.argmax(squares))) > 1
        share = float(squares.sum() / max(signal.sum(), 1e-12))
        if signal[elsewhere].sum() > _ENOUGH * signal.sum():
            share = min(share, float(squares[elsewhere].sum() / signal[elsewhere].sum()))
        return share - 1.5 * noise_share(self.compared)

    @property
    def beyond_noise(self) -> float:
        """Variance of what neither IMU nor clock explains, beside that of stated noise."""
        if self.clock is None or self.compared.noise <= 0.0:
            return 0.0
        left = self.compared.residual(self.late)
        count = max(float(self.compared.count.sum()), 1.0)
        return float(np.sum(left**2)) / (self.compared.noise**2 * count)

    @property
    def off(self) -> float:
        """How far the clock is from what is stated, s."""
        return 0.0 if self.clock is None else abs(self.clock.offset - self.around)


@dataclass(frozen=True)
class _GnssView(_View[GnssWindows]):
    """GNSS against the IMU."""

    sensor: Gnss
    mirrored = False

    def fit(self) -> WindowFit:
        """Return the fit with the clock set right."""
        return self.compared.fit(self.late)

    def directions(self) -> BodyDirections:
        """Return vertical and course in body axes."""
        return body_directions(self.compared, self.late, self.fit())

    def findings(self) -> Iterator[Finding]:
        """Yield what is wrong with axes, clock and antenna."""
        mistake = _gnss_mistake(self) if self.excess > CONTRADICTS else None
        if mistake is not None:
            yield Finding(Code.GNSS_AXES, mistake, self.sensor.label, severity="error")
        elif self.clock is not None:
            yield from _clock(self.sensor, self.clock, self.around)
            yield from self._antenna()

    def _antenna(self) -> Iterator[Finding]:
        fit = self.fit()
        sigma = np.sqrt(np.diag(fit.arm_covariance))
        stated = np.array(self.sensor.settings.lever_arm_m)
        free = 3.0 * np.array(self.sensor.settings.lever_arm_std_m)
        if np.any(np.abs(fit.arm_error) > np.maximum(_ARM_SIGMAS * sigma, _ARM_M) + free):
            text = message(
                "antenna.elsewhere", found=stated + fit.arm_error, std=sigma.max(), stated=stated
            )
            yield Finding(Code.ANTENNA, text, self.sensor.label)


@dataclass(frozen=True)
class _DvlView(_View[DvlWindows]):
    """A DVL against the IMU."""

    sensor: Dvl

    @property
    def mirrored(self) -> bool:
        """Whether the axes of the DVL are mirrored."""
        return self.compared.handedness < 0

    def believed_beside(self, right: _DvlView) -> bool:
        """Whether these axes, mirrored, are accepted rather than right-handed ones.

        Sway repeats itself: with a clock that is off by half a period the other axes fit nearly.
        """
        if self.clock is None or right.clock is None:
            return False
        scale_error = self.compared.fit(self.late).scale_error
        ratio = self.clock.unexplained / max(right.clock.unexplained, 1e-12)
        better = ratio < 1.0 / _MIRRORED and right.excess > CONTRADICTS
        aliased = ratio < 1.0 and self.off < _ALIASED_S
        possible = abs(scale_error) < _LARGEST_SCALE_ERROR and self.excess < _UNEXPLAINED
        return possible and (better or aliased)

    def findings(self) -> Iterator[Finding]:
        """Yield what is wrong with axes and clock."""
        if self.mirrored:
            yield mirrored_finding(self.sensor, self.compared.fit(self.late))
        if self.clock is not None:
            yield from _clock(self.sensor, self.clock, self.around)


def _without_gross_errors(sensor: Gnss | Dvl, views: Sequence[_GnssView | _DvlView]) -> Gnss | Dvl:
    """Return a record without what stands out beside the carried IMU."""
    view = next((v for v in views if v.sensor is sensor), None)
    if view is None or view.excess < CONTRADICTS:
        return sensor
    compared: GnssWindows | DvlWindows = view.compared
    gross = np.zeros(compared.inside.shape, dtype=bool)
    for _ in range(_SEARCHES):
        found = isolated(compared.residual(view.late), compared.inside)
        if not found.any():
            break
        gross |= found
        compared = replace(compared, inside=compared.inside & ~found)
    return rows_of(sensor, ~np.isin(sensor.time, compared.time[gross])) if gross.any() else sensor


def _clock(sensor: Gnss | Dvl, clock: ClockOffset, around: float) -> Iterator[Finding]:
    if around == _stated(sensor):
        yield from clock_findings(sensor, clock, float(np.ptp(sensor.time)))
    else:
        yield far_clock_finding(sensor, clock.offset)


def _far(view: _GnssView | _DvlView) -> _GnssView | _DvlView:
    """Return a view with a clock that is off by far, the same if no such clock explains more."""
    shares = []
    for later in _FAR_S:
        moved = _compared(view.windows, view.sensor, view.around + later)
        if moved is not None:
            share, _ = least_misfit(moved, view.around + later, _REACH_S, _FAR_STEP_S)
            shares.append((share, view.around + later))
    if not shares:
        return view
    found = _view(view.windows, view.sensor, min(shares)[1])
    if found is None or found.clock is None or view.clock is None:
        return view
    enough = found.excess < max(_FAR_LEFT * view.excess, CONTRADICTS)
    better = found.clock.unexplained < _FAR_LEFT_OF_ALL * view.clock.unexplained
    return found if enough and better else view


def _gnss_mistake(view: _GnssView) -> Message | None:
    """Return what is wrong with order or sign of the axes of GNSS, None if that explains nothing.

    East and north swapped are, but for the unknown heading, one of them mirrored.
    """
    as_recorded, _ = least_misfit(view.compared, view.around, _REACH_S)
    for text, matrix in (
        (message("gnss_axes.swapped"), np.eye(3)[[1, 0, 2]]),
        (message("gnss_axes.up"), _DOWN),
    ):
        other = replace(view.compared, velocity=view.compared.velocity @ matrix.T)
        share, _ = least_misfit(other, view.around, _REACH_S)
        noise = 1.5 * noise_share(other)
        # In the same windows: those with the largest changes are explained better than the rest.
        if share - noise < _LEFT * (as_recorded - noise):
            return text
    return None


def _course_findings(directions: BodyDirections, body_axes: BodyAxes) -> Iterator[Finding]:
    angle = off_course(directions, body_axes)
    upright = -frd_from_body(body_axes)[2] @ directions.up > UPRIGHT
    if angle is None or not upright or abs(angle) < _OFF_COURSE:
        return
    fit = [axes for axes in axes_that_fit(directions) if axes != body_axes]
    cause = message("course.turned_imu")
    if fit:
        cause = message("course.other_axes", axes=either(fit))
    astern = abs(angle) > 150.0 * DEG
    where = message("course.astern") if astern else side_of_bow(angle)
    yield Finding(
        Code.COURSE,
        message("course.moves", axes=body_axes, where=where, cause=cause),
        "IMU",
        severity="error" if directions.turned > _TURNED else "warning",
    )


def _imu_finding(
    wrong: Sequence[Candidate], directions: BodyDirections | None, body_axes: BodyAxes
) -> Finding:
    """Return which axes or units of the IMU are wrong."""
    first = wrong[0]
    if first.code == Code.GYRO_UNIT:
        text = first.message
    elif first is HANDEDNESS:
        found: list[Array] = []
        if directions is not None:
            back = HANDEDNESS.accel
            course = None if directions.course is None else back @ directions.course
            recorded = replace(directions, up=back @ directions.up, course=course)
            found = relabelling(recorded, body_axes, -1)
        cause = in_words(found[0]) if len(found) == 1 else message("imu_axes.one_of_them")
        text = message("imu_axes.fit_only_if", cause=cause)
    else:
        causes = either([c.message for c in wrong if c is not HANDEDNESS])
        text = message("axes.fit_only_if", causes=causes)
    return Finding(first.code, text, "IMU", severity="error")
