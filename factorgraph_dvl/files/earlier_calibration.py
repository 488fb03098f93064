"""Earlier calibrations of DVL and IMU, as priors of a trial."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
from msgspec import UnsetType
from scipy.linalg import block_diag

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.estimates import Estimate
from factorgraph_dvl.files.calibration_file import (
    check_usable,
    encode_calibration,
    load_calibration,
)
from factorgraph_dvl.files.folders import SETTINGS_FILE
from factorgraph_dvl.geometry.celestial import seconds_between
from factorgraph_dvl.geometry.rotations import BodyAxes
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.sensors.catalogue import specs_of
from factorgraph_dvl.sensors.dvl import CALIBRATED, Dvl
from factorgraph_dvl.sensors.imu import BIASES, Imu
from factorgraph_dvl.sensors.parameters import JointPrior
from factorgraph_dvl.solution import Calibration
from factorgraph_dvl.trial import Trial

_Calibrated = TypeVar("_Calibrated", Dvl, Imu)


def with_earlier_calibrations(
    imu: Imu | None,
    dvl: Dvl | None,
    folder: Path,
    body_axes: BodyAxes,
    epoch: str,
    *,
    anyway: bool,
) -> tuple[Imu | None, Dvl | None, list[Finding]]:
    """Return IMU and DVL with the priors that their settings name, and what is to be noted.

    Parameters
    ----------
    imu, dvl : Imu or Dvl
        Records without them; None where the trial has none.
    folder : Path
        Folder that the names are relative to.
    body_axes, epoch : str
        Body axes and epoch of the trial.
    anyway : bool
        Take calibrations also if they are graded `do not use`.

    Raises
    ------
    ConfigError, DataError
        If a calibration is missing or cannot be used.
    """
    earlier = {
        record.section: named
        for record in (imu, dvl)
        if record is not None and (named := _named(record, folder, body_axes))
    }
    notes = []
    for section, (source, calibration) in earlier.items():
        verdict = calibration.verdict
        if verdict.grade == "do not use" and anyway:
            text = message("unusable_prior.graded", source=source, reason=str(verdict.reasons[0]))
            notes.append(Finding(Code.UNUSABLE_PRIOR, text, sensor=section.upper()))
    if dvl is not None and Dvl.section in earlier:
        source, calibration = earlier[Dvl.section]
        dvl = calibrated_by(dvl, calibration, body_axes, source, anyway=anyway)
    if imu is not None and Imu.section in earlier:
        source, calibration = earlier[Imu.section]
        both = Dvl.section in earlier and np.array_equal(
            earlier[Dvl.section][1].covariance, calibration.covariance
        )
        imu = with_biases_of(
            imu, calibration, body_axes, epoch, source, with_dvl=both, anyway=anyway
        )
        if dvl is not None and both:
            dvl = replace(dvl, prior=imu.prior)
    return imu, dvl, notes


def _named(record: Dvl | Imu, folder: Path, body_axes: BodyAxes) -> tuple[str, Calibration] | None:
    """Return the calibration that the settings of a sensor name, and its name; None if none."""
    name = record.settings.calibration
    if isinstance(name, UnsetType):
        return None
    path = folder / name
    if not path.exists():
        raise ConfigError(
            f"{record.section}.calibration: the file {name} does not exist",
            where=SETTINGS_FILE,
            expected=f"a calibration.json at {path}",
        )
    return name, load_calibration(path, body_axes=body_axes)


def calibrated_by(
    dvl: Dvl, calibration: Calibration, body_axes: BodyAxes, source: str, *, anyway: bool = False
) -> Dvl:
    """Return a DVL whose prior is what a calibration says of it, correlations included.

    What belongs to the day is left out, such as the current; of the biases of the IMU see
    `with_biases_of`.

    Parameters
    ----------
    dvl : Dvl
        DVL without a calibration.
    calibration : Calibration
        Calibration of the same DVL, mounted as it is now.
    body_axes : BodyAxes
        Body axes of the trial.
    source : str
        Name of the calibration, for messages.
    anyway : bool, default False
        Take it also if it is graded `do not use`.

    Raises
    ------
    DataError
        If the calibration is not to be used, is in other axes, or says nothing of the DVL.
    """
    check_usable(calibration, body_axes, source, anyway=anyway)
    prior = _prior_of(calibration, CALIBRATED, source)
    if not prior.values:
        raise DataError(
            "the calibration has no parameter of the DVL",
            where=source,
            expected=", ".join(CALIBRATED),
        )
    settings = msgspec.structs.replace(dvl.settings, calibration=source)
    return replace(dvl, settings=settings, prior=prior)


def with_biases_of(
    imu: Imu,
    calibration: Calibration,
    body_axes: BodyAxes,
    epoch: str,
    source: str,
    *,
    with_dvl: bool = False,
    anyway: bool = False,
) -> Imu:
    """Return an IMU whose biases start as a calibration left them.

    Their covariance grows by the walk that the settings state, over the time between, and over
    two thirds of the time that the calibration took: of a bias that walks the calibration has the
    mean b over its time T. The variance of b(T) - b is q T / 3, and its covariance with the error
    of b at most q T / 6, where the data say nothing.

    Parameters
    ----------
    imu : Imu
        IMU without a calibration.
    calibration : Calibration
        Calibration of the same IMU, not switched off since.
    body_axes : BodyAxes
        Body axes of the trial.
    epoch : str
        Epoch of the trial; needed where biases walk.
    source : str
        Name of the calibration, for messages.
    with_dvl : bool, default False
        Let the prior have what the calibration says of the DVL besides, to keep the correlations.
    anyway : bool, default False
        Take it also if it is graded `do not use`.

    Raises
    ------
    DataError
        If the calibration is not to be used, is in other axes, or has no biases.
    ConfigError
        If a bias walks and the time between is not known.
    """
    check_usable(calibration, body_axes, source, anyway=anyway)
    prior = _prior_of(calibration, (*BIASES, *(CALIBRATED if with_dvl else ())), source)
    if not prior.values.keys() & set(BIASES):
        raise DataError(
            "the calibration has no biases of an IMU", where=source, expected=" or ".join(BIASES)
        )
    values, P = dict(prior.values), prior.covariance
    for parameter in imu.nominal().parameters(0.0):
        if parameter.name not in values:
            values[parameter.name] = parameter.mean / parameter.si
            P = block_diag(P, np.diag((parameter.sigma / parameter.si) ** 2))
    settings = msgspec.structs.replace(imu.settings, calibration=source)
    then = replace(imu, settings=settings, prior=JointPrior(source, values, P, prior.inputs))
    return replace(then, prior=then.prior_after(_walked(imu, calibration, epoch, source)))


def _walked(imu: Imu, calibration: Calibration, epoch: str, source: str) -> float:
    """Return over what time the biases of a calibration have walked, s."""
    if not imu.settings.bias_walks:
        return 0.0
    if not (calibration.epoch and calibration.span and epoch):
        where = "trial.yaml" if not epoch else source
        raise ConfigError(
            "the biases of the IMU walk, and the time since their calibration is not known",
            where=f"imu.calibration: {source}",
            expected=f"`epoch` in {where}",
            hint="State `epoch` in both trials, and solve the earlier one anew",
        )
    since = seconds_between(calibration.epoch, epoch) + float(imu.time[0])
    begin, end = calibration.span
    return max(begin - since, since - end, 0.0) + 2.0 / 3.0 * (end - begin)


def _prior_of(calibration: Calibration, names: Collection[str], source: str) -> JointPrior:
    """Return what a calibration knows of the parameters of some names that it has."""
    values: dict[str, Array] = {}
    rows: list[int] = []
    at = 0
    for e in calibration.estimates:
        if e.name in names:
            sizes = specs_of(e.name)
            if e.value.size not in sizes:
                raise DataError(
                    f"{e.name} has {e.value.size} numbers",
                    where=source,
                    expected=" or ".join(map(str, sizes)),
                )
            values[e.name] = e.value
            rows += range(at, at + e.value.size)
        at += e.value.size
    return JointPrior(
        source, values, calibration.covariance[np.ix_(rows, rows)], calibration.inputs
    )


def save_prior(folder: Path, name: str, record: _Calibrated, trial: Trial) -> _Calibrated:
    """Write the prior of a sensor; return the sensor with settings that name the file."""
    assert record.prior is not None
    (folder / name).write_bytes(encode_calibration(_calibration_of(record.prior, trial)))
    settings = msgspec.structs.replace(record.settings, calibration=name)
    return replace(record, settings=settings)


def _calibration_of(prior: JointPrior, trial: Trial) -> Calibration:
    """Return a prior as the calibration that it came from."""
    estimates = []
    for name, value in prior.values.items():
        std = prior.std(name)
        names = specs_of(name)[value.size].component_names
        known = np.ones(value.size, dtype=bool)
        unknown = np.full(value.size, np.nan)
        estimates.append(Estimate(name, names, value, std, unknown, unknown, known))
    return Calibration(
        trial=prior.source,
        solver="prior",
        body_axes=trial.body_axes,
        converged=True,
        iterations=0,
        cost=np.nan,
        estimates=tuple(estimates),
        covariance=prior.covariance,
        inputs=prior.inputs,
        epoch=trial.epoch,
        span=None if trial.imu is None else (float(trial.imu.time[0]),) * 2,
    )
