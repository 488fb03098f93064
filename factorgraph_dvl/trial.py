"""A trial: the records of its sensors, where it starts, and a reference to compare with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from msgspec import UnsetType

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.geometry.earth import LocalFrame
from factorgraph_dvl.geometry.rotations import BodyAxes, frd_from_body
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.quality.verdict import DEFAULT_LIMITS
from factorgraph_dvl.sensors.attitude import Attitude
from factorgraph_dvl.sensors.beacon import Beacons
from factorgraph_dvl.sensors.beam_geometry import as_dvl
from factorgraph_dvl.sensors.catalogue import PLANAR, add_plug_in
from factorgraph_dvl.sensors.clock import on_shared_clocks
from factorgraph_dvl.sensors.depth import Depth
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import BEAM_PREFIX, DvlBeams
from factorgraph_dvl.sensors.fingerprint import fingerprints, shared
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.ins import Ins
from factorgraph_dvl.sensors.parameters import JointPrior
from factorgraph_dvl.sensors.protocol import Aid, NoiseModel, SensorRecord
from factorgraph_dvl.sensors.records import joined, rows_of
from factorgraph_dvl.sensors.speed_log import Heading, SpeedLog
from factorgraph_dvl.sensors.turntable import Turntable
from factorgraph_dvl.sensors.usbl import Usbl, near_their_neighbours

_Sensor = TypeVar("_Sensor", bound=Aid)
_Record = TypeVar("_Record", bound=Aid | Imu)

# What a trial may lack, in the words of import.log and of errors.
NO_POSITION = (
    "positions: no file has any; give a record of GNSS of the same time, such as NMEA or .pos"
)
NO_VELOCITY = (
    "velocities: no file has any; give the log of the DVL of the same time, such as PD0, AD2CP or "
    "its reports as JSON"
)
NO_LOCK = (
    "velocities: {count} pings, and none of them with bottom lock or a velocity through water"
)
NO_MOTION = "attitude: no file has an IMU, a navigation solution, or roll, pitch and heading"


@dataclass(frozen=True)
class InitialPosition:
    """Prior of the position at the first IMU sample.

    Parameters
    ----------
    geodetic : ndarray, shape (3,)
        Latitude, longitude (rad), ellipsoidal height (m).
    std : ndarray, shape (3,)
        East, north, up, m.
    """

    geodetic: Array
    std: Array


@dataclass(frozen=True)
class InitialAttitude:
    """Prior of the attitude at the first IMU sample.

    Parameters
    ----------
    rph : ndarray, shape (3,)
        Roll, pitch, heading, rad.
    std : ndarray, shape (3,), rad
        Standard deviations of roll, pitch, heading.
    """

    rph: Array
    std: Array


@dataclass(frozen=True)
class InitialVelocity:
    """Prior of the velocity at the first IMU sample.

    Parameters
    ----------
    velocity : ndarray, shape (3,), m/s
        Local-level east, north, up, of the IMU.
    std : ndarray, shape (3,), m/s
        Standard deviations of east, north, up.
    """

    velocity: Array
    std: Array


@dataclass(frozen=True)
class Reference:
    """Truth or a trusted solution; never used to solve.

    Parameters
    ----------
    time : ndarray, shape (M,), s
        Times of the epochs.
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude (rad), ellipsoidal height (m) of the IMU.
    velocity : ndarray, shape (M, 3)
        Local-level east, north, up, m/s.
    rph : ndarray, shape (M, 3)
        Roll, pitch, heading, rad.
    """

    time: Array
    geodetic: Array
    velocity: Array
    rph: Array


@dataclass(frozen=True)
class Trial:
    """Everything that is known of a trial before it is solved.

    Parameters
    ----------
    name : str
        Name of the trial.
    imu : Imu or None
        The IMU; None where an INS, another sensor of attitude, or a compass with a speed log
        takes its place.
    gnss, dvl : Gnss or Dvl
        The sensors that a calibration needs, None where the trial does not have them.
    others : tuple of Aid, optional
        All further sensors.
    body_axes : BodyAxes, optional
        Axes in which all body quantities are given.
    epoch : str, optional
        UTC of time zero, ISO 8601; empty if not given.
    noise : {'estimated', 'stated'}, optional
        Whether the stated noise of sensors that do not say so themselves is final.
    initial_attitude : InitialAttitude, optional
        Prior; None = found from the data.
    initial_position : InitialPosition, optional
        Prior; None = found from the data.
    initial_velocity : InitialVelocity, optional
        Prior; None = found from the data.
    reference : Reference, optional
        Truth or a trusted solution, None if there is none.
    calibration_truth : dict of str to ndarray, optional
        True values of calibration parameters by reported name, in reported units; empty outside
        simulations.
    notes : tuple of Finding, optional
        What was noticed while loading, for the user.
    limits : mapping of str to float, optional
        Standard deviations that are good enough, by parameter, in reported units.
    certificate : mapping of str to object, optional
        What the page prints of vessel, place and instruments, as `certificate` of trial.yaml.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> trial
    <Trial 'short run': imu 4300, gnss 172, dvl 172>
    >>> trial.depth is None
    True
    """

    name: str
    imu: Imu | None
    gnss: Gnss | None = None
    dvl: Dvl | None = None
    others: tuple[Aid, ...] = ()
    body_axes: BodyAxes = "RFU"
    epoch: str = ""
    noise: NoiseModel = "estimated"
    initial_attitude: InitialAttitude | None = None
    initial_position: InitialPosition | None = None
    initial_velocity: InitialVelocity | None = None
    reference: Reference | None = None
    calibration_truth: dict[str, Array] = field(default_factory=dict)
    notes: tuple[Finding, ...] = ()
    limits: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_LIMITS))
    certificate: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = [] if self.imu is None else [f"imu {self.imu.time.size}"]
        counts += [f"{aid.section} {aid.time.size}" for aid in self.aids]
        return f"<Trial {self.name!r}: {', '.join(counts)}>"

    def __post_init__(self) -> None:
        # What a sensor must know of another is set here, whoever made or changed the trial.
        for aid in self.others:
            add_plug_in(type(aid))
        prefix = BEAM_PREFIX if self.dvl is not None else ""
        for i, aid in enumerate(self.others):
            if isinstance(aid, DvlBeams) and aid.prefix != prefix:
                renamed = replace(aid, prefix=prefix)
                others = (*self.others[:i], renamed, *self.others[i + 1 :])
                object.__setattr__(self, "others", others)
            if isinstance(aid, Turntable) and self.gnss is not None:
                up = -frd_from_body(self.body_axes)[2]
                object.__setattr__(self, "gnss", replace(self.gnss, turning=aid.turning(up)))
        self._check_planar()
        self._check_prior()
        on_shared_clocks((p for aid in self.aids for p in aid.parameters()), self.aids)

    def _check_planar(self) -> None:
        """Raise ConfigError for what a track in the plane would leave out."""
        if self.find(Heading) is None and self.find(SpeedLog) is None:
            return
        unused = [r.section for r in self.records if type(r) not in PLANAR]
        unused += ["initial.roll_pitch_heading_deg"] if self.initial_attitude else []
        unused += ["initial.velocity"] if self.initial_velocity else []
        if unused:
            raise ConfigError(
                "heading and log make a planar trial, which does not use this key",
                where=f"trial.yaml key {unused[0]}",
                expected=", ".join(kind.section for kind in PLANAR),
                hint="State a compass beside other sensors as `attitude`, and a log as `dvl` with "
                "`reference: water`",
            )

    def _check_prior(self) -> None:
        """Raise DataError if a prior of DVL or IMU came from data of this trial."""
        for key, prior in self.priors.items():
            section = shared(self._fingerprints, prior.inputs) if prior.inputs else ""
            if section:
                raise DataError(
                    f"the calibration came from the {section} data of this trial itself, which "
                    "would count twice and make every standard deviation too small",
                    where=f"{key}.calibration: {prior.source}",
                    expected="a calibration from other data",
                    hint="Leave the key out, or name the calibration of an earlier trial",
                )

    @property
    def priors(self) -> dict[str, JointPrior]:
        """Earlier calibrations by section."""
        records = (self.imu, self.dvl)
        return {r.section: r.prior for r in records if r is not None and r.prior is not None}

    @cached_property
    def _fingerprints(self) -> tuple[str, ...]:
        # A turntable's angle is that of its program, which two trials may share.
        return fingerprints(a for a in self.records if not isinstance(a, Turntable))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Fingerprints of all data behind a result: the records, and those of the priors."""
        earlier = (text for prior in self.priors.values() for text in prior.inputs)
        return (*self._fingerprints, *dict.fromkeys(earlier))

    def estimates_noise(self, record: SensorRecord) -> bool:
        """Whether the stated noise of a sensor is a start value; if not, it is final."""
        stated = record.settings.noise
        return (self.noise if isinstance(stated, UnsetType) else stated) == "estimated"

    def find(self, kind: type[_Sensor]) -> _Sensor | None:
        """Return the sensor of a type, None where the trial does not have it."""
        return next((aid for aid in self.aids if isinstance(aid, kind)), None)

    def required(self, kind: type[_Sensor]) -> _Sensor:
        """Return the sensor of a type.

        Raises
        ------
        ConfigError
            If the trial does not have it.
        """
        found = self.find(kind)
        if found is None:
            raise ConfigError(
                f"the trial has no `{kind.section}`, which is needed here",
                where="trial.yaml",
                expected=f"a section {kind.section}",
            )
        return found

    @property
    def planar(self) -> bool:
        """Whether compass and log stand for the IMU: the track is found in the plane."""
        return self.find(Heading) is not None

    @property
    def beams(self) -> DvlBeams | None:
        """The beams of a DVL, None where the trial does not have them."""
        return self.find(DvlBeams)

    @property
    def log(self) -> Dvl | None:
        """The DVL, or what its beams amount to with their nominal directions."""
        return self.dvl if self.dvl is not None or self.beams is None else as_dvl(self.beams)

    def on_one_clock(self) -> Trial:
        """Return the trial with stamps of GNSS less their stated time offset."""
        return self if self.gnss is None else replace(self, gnss=self.gnss.on_trial_clock())

    def until(self, end: float, *, since: float = -np.inf) -> Trial:
        """Return the records between two times, s; a sensor that has none then is left out."""

        def cut(record: _Record | None) -> _Record | None:
            if record is None:
                return None
            inside = (record.time >= since) & (record.time <= end)
            return rows_of(record, inside) if inside.any() else None

        others = (cut(aid) for aid in self.others)
        return replace(
            self,
            imu=cut(self.imu),
            gnss=cut(self.gnss),
            dvl=cut(self.dvl),
            others=tuple(aid for aid in others if aid is not None),
        )

    @property
    def inertial(self) -> Imu:
        """The IMU.

        Raises
        ------
        ConfigError
            If the trial has none.
        """
        if self.imu is None:
            raise ConfigError(
                "the trial has no IMU, which this command needs",
                where="trial.yaml",
                expected="an imu section",
                hint="Other commands and some methods of `kalman` accept `ins` or `attitude` "
                "in its place",
            )
        return self.imu

    @property
    def records(self) -> tuple[SensorRecord, ...]:
        """The records of all sensors, that of the IMU first."""
        return self.aids if self.imu is None else (self.imu, *self.aids)

    @property
    def aids(self) -> tuple[Aid, ...]:
        """The sensors other than the IMU."""
        return tuple(aid for aid in (self.gnss, self.dvl, *self.others) if aid is not None)

    @property
    def beacons(self) -> Beacons | None:
        """The ranging to beacons, None where the trial does not have it."""
        return self.find(Beacons)

    @property
    def attitude(self) -> Attitude | Ins | None:
        """The sensor of attitude, None where the trial does not have one."""
        return self.find(Attitude) or self.find(Ins)

    @property
    def positioning(self) -> Gnss | Usbl | Ins | None:
        """The sensor whose positions the trial starts from: GNSS, else the USBL, else the INS."""
        return self.gnss or self.find(Usbl) or self.find(Ins)

    @cached_property
    def fixes(self) -> Gnss | None:
        """Positions to start from: those of GNSS, and of a USBL as its mounting is stated.

        Beside an antenna, a transponder is where that is, within their distance.
        """
        usbl = self.find(Usbl)
        under = None if usbl is None else usbl.fixes(self.frame(), self.body_axes)
        if self.gnss is None or under is None:
            return self.gnss or under
        apart = np.subtract(under.settings.lever_arm_m, self.gnss.settings.lever_arm_m)
        std = np.hypot(under.position_std, np.linalg.norm(apart))
        return joined((self.gnss, replace(under, position_std=std)))

    @property
    def position_sensor(self) -> Gnss | Ins | None:
        """GNSS and USBL, or else the INS; None where the trial has none of them."""
        return self.fixes or self.find(Ins)

    def with_fixes(self) -> Trial:
        """Return the trial with the positions of a USBL as if GNSS had measured them.

        Those far from their neighbours are left out: a start is made from differences of them.
        """
        fixes = self.fixes
        if fixes is None or fixes is self.gnss:
            return self
        return replace(self, gnss=rows_of(fixes, near_their_neighbours(fixes, self.frame())))

    @property
    def body_sensor(self) -> Imu | Attitude | Ins | Heading:
        """The instrument whose body is that of the trial: the IMU, or what takes its place.

        Raises
        ------
        ConfigError
            If the trial has none.
        """
        return self.imu or self.attitude or self.find(Heading) or self.inertial

    @property
    def depth(self) -> Depth | None:
        """The depth sensor, None where the trial does not have it."""
        return self.find(Depth)

    def frame(self) -> LocalFrame:
        """Return the tangent frame at the first known position; of a planar trial, at a beacon.

        Raises
        ------
        DataError
            If neither GNSS nor `initial.position` nor a USBL nor a beacon gives a position.
        """
        known = np.empty((0, 3))
        if self.planar and self.beacons is not None:
            # Ranges fit a plane best where it touches the Earth near the beacons.
            known = self.beacons.places
        elif self.initial_position is not None:
            known = self.initial_position.geodetic[None]
        elif self.gnss is not None:
            known = self.gnss.geodetic[~np.isnan(self.gnss.geodetic[:, 0])]
        usbl, ins = self.find(Usbl), self.find(Ins)
        if not known.size and usbl is not None:
            known = usbl.place()[None]
        if not known.size and ins is not None:
            known = ins.geodetic[np.logical_not(ins.missing)]
        if not known.size and self.beacons is not None:
            known = self.beacons.places
        if known.size:
            lat, lon, height = known[0]
            return LocalFrame(lat, lon, height, self.epoch)
        raise DataError(
            NO_POSITION,
            where="trial.yaml",
            expected="a gnss, usbl or ins section with positions, initial.position, or beacons",
        )
