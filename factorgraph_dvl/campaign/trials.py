"""The trials of a campaign in the order of their dates, with their results and the joint one."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import TextIOWrapper
from pathlib import Path

import numpy as np

from factorgraph_dvl.campaign.information import TrialCalibration, information_of
from factorgraph_dvl.campaign.joint_calibration import JointCalibration, joint_calibration
from factorgraph_dvl.campaign.record import RunRecord
from factorgraph_dvl.campaign.trial_run import TRIALS_FOLDER
from factorgraph_dvl.errors import ConfigError, DataError, as_text
from factorgraph_dvl.files.calibration_file import load_calibration
from factorgraph_dvl.geometry.units import DAY
from factorgraph_dvl.message import Message, message
from factorgraph_dvl.settings.files import open_file
from factorgraph_dvl.solution import Calibration


@dataclass(frozen=True)
class CampaignTrial:
    """A trial of a campaign.

    Parameters
    ----------
    label : str
        Name of the folder with its result.
    name : str
        Name as the trial.yaml has it.
    path : str
        Path of the trial.
    record : RunRecord
        How its run ended.
    calibration : Calibration or None
        Its result.
    unused : Message or str
        Why the joint calibration does not use it; empty if it does.
    """

    label: str
    name: str
    path: str
    record: RunRecord
    calibration: Calibration | None
    unused: Message | str = ""


@dataclass(frozen=True)
class Campaign:
    """The trials of a campaign, and what they have in common.

    Parameters
    ----------
    trials : tuple of CampaignTrial
        Trials by date, or as given where a date is missing.
    dated : bool
        Whether all have a date.
    joint : JointCalibration or None
        Joint calibration of the trials that are used; None if there are none.
    """

    trials: tuple[CampaignTrial, ...]
    dated: bool
    joint: JointCalibration | None

    @property
    def used(self) -> tuple[CampaignTrial, ...]:
        """The trials of the joint calibration, in its order."""
        return tuple(t for t in self.trials if not t.unused)

    @property
    def failed(self) -> tuple[CampaignTrial, ...]:
        """The trials that have no result."""
        return tuple(t for t in self.trials if not t.record.done)


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each trial that is no other's, fit for a folder."""
    taken: Counter[str] = Counter()
    out = []
    for path in paths:
        folder = path if path.is_dir() else path.parent
        stem = folder.resolve().name or "trial"
        # As short as file systems ask for, with room for what is added to it.
        stem = "".join(c if c.isalnum() or c in "-_." else "-" for c in stem)[:100].lstrip(".")
        label = stem or "trial"
        while label in taken:
            taken[stem] += 1
            label = f"{stem}-{taken[stem] + 1}"
        taken[label] += 0
        out.append(label)
    return out


def assembled(
    paths: Sequence[Path],
    labels: Sequence[str],
    records: Sequence[RunRecord],
    out: Path,
    *,
    anyway: bool = False,
    covariates: Mapping[str, Mapping[str, float]] | None = None,
) -> Campaign:
    """Return the trials of a campaign with their joint calibration.

    Parameters
    ----------
    paths, labels, records : sequence of path-like, str, RunRecord
        Paths, labels and records of the trials.
    out : path-like
        Folder of the campaign.
    anyway : bool, default False
        Use results that are graded `do not use`, too.
    covariates : mapping of str to mapping of str to float, optional
        Value in each trial, by covariate and the trial's name.

    Raises
    ------
    ConfigError
        If a covariate has no value for a trial.
    """
    trials = []
    for path, label, record in zip(paths, labels, records, strict=True):
        calibration = None
        unused: Message | str = record.error or message("campaign.not_solved")
        if record.done:
            calibration = load_calibration(out / TRIALS_FOLDER / label)
            unused = _reason_against(calibration, anyway)
        trials.append(
            CampaignTrial(label, record.name, as_text(path), record, calibration, unused)
        )
    times = [_time_of(t.record.epoch) for t in trials]
    dated = all(np.isfinite(times))
    if dated:
        order = sorted(range(len(trials)), key=lambda i: times[i])
        trials, times = [trials[i] for i in order], [times[i] for i in order]
    trials = _in_common_axes(trials)
    used = [i for i, t in enumerate(trials) if not t.unused]
    if not used:
        return Campaign(tuple(trials), dated, None)
    information = information_of([_with_prior(trials[i]) for i in used])
    if not information.names:
        return Campaign(tuple(trials), dated, None)
    days = np.array([times[i] if dated else float(i) for i in used])
    names = [trials[i].name for i in used]
    check_covariates(covariates or {}, names)
    columns = {
        covariate: np.array([values[name] for name in names])
        for covariate, values in (covariates or {}).items()
    }
    return Campaign(tuple(trials), dated, joint_calibration(information, days, columns))


def read_covariates(path: Path) -> dict[str, dict[str, float]]:
    """Read a CSV table with a column `trial` and one for each covariate.

    Parameters
    ----------
    path : path-like
        Path of the table.

    Raises
    ------
    DataError
        If it is no such table.
    """
    expected = "a column `trial`, and columns of numbers such as temperature_deg_c"
    try:
        with (
            open_file(path, expected=expected) as raw,
            TextIOWrapper(raw, "utf-8-sig", newline="") as file,
        ):
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"cannot be read ({error})", where=str(path), expected=expected) from None
    if not rows or "trial" not in rows[0] or len(rows[0]) < 2:
        raise DataError("has no such columns", where=f"{path} line 1", expected=expected)
    at = rows[0].index("trial")
    out: dict[str, dict[str, float]] = {n: {} for i, n in enumerate(rows[0]) if i != at}
    for line, row in enumerate(rows[1:], 2):
        where = f"{path} line {line}"
        if len(row) != len(rows[0]):
            raise DataError(f"has {len(row)} cells", where=where, expected=str(len(rows[0])))
        for name, cell in zip(rows[0], row, strict=True):
            if name != "trial":
                out[name][row[at]] = _number(cell, name, where)
    return out


def _number(cell: str, name: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise DataError(f"{name} is {cell!r}", where=where, expected="a number")
    return value


def check_covariates(covariates: Mapping[str, Mapping[str, float]], names: Sequence[str]) -> None:
    """Raise ConfigError unless covariates have a value for each trial, by name.

    Parameters
    ----------
    covariates : mapping of str to mapping of str to float
        Value in each trial, by covariate and the trial's name.
    names : sequence of str
        Names of the trials.
    """
    for covariate, values in covariates.items():
        for name in names:
            if name not in values:
                raise ConfigError(
                    f"{covariate} has no value for the trial {name}",
                    where="--covariates",
                    expected="one for each trial, by the `name` in its trial.yaml",
                )


def _reason_against(calibration: Calibration, anyway: bool) -> Message | str:
    verdict = calibration.verdict
    if verdict.grade == "do not use" and not anyway:
        reason = verdict.reasons[0]
        if reason.sensor:
            return message("campaign.graded_sensor", sensor=reason.sensor, reason=reason.message)
        return message("campaign.graded", reason=reason.message)
    return "" if np.isfinite(calibration.covariance).all() else message("campaign.not_finite")


def _in_common_axes(trials: Sequence[CampaignTrial]) -> list[CampaignTrial]:
    """Return trials, those in other body axes than most unused."""
    axes = Counter(t.calibration.body_axes for t in trials if t.calibration and not t.unused)
    if not axes:
        return list(trials)
    common = axes.most_common(1)[0][0]
    out = []
    for t in trials:
        if t.calibration is not None and not t.unused and t.calibration.body_axes != common:
            own = t.calibration.body_axes
            t = replace(t, unused=message("campaign.other_axes", axes=own, common=common))
        out.append(t)
    return out


def _with_prior(trial: CampaignTrial) -> TrialCalibration:
    assert trial.calibration is not None
    record = trial.record
    if not record.prior_names:
        return TrialCalibration(trial.calibration)
    covariance = np.array(record.prior_covariance)
    return TrialCalibration(trial.calibration, tuple(record.prior_names), covariance)


def _time_of(epoch: str) -> float:
    """Return an epoch in days since 1970, nan if there is none."""
    if not epoch:
        return np.nan
    try:
        when = datetime.fromisoformat(epoch)
    except ValueError:
        return np.nan
    when = when if when.tzinfo else when.replace(tzinfo=UTC)
    return when.timestamp() / DAY
