"""Trial folders, format 1: trial.yaml and the tables that it names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
from msgspec import UNSET

from factorgraph_dvl.errors import ConfigError, DataError, FactorgraphDvlError, printable
from factorgraph_dvl.files.calibration_file import CALIBRATION_FILE
from factorgraph_dvl.files.earlier_calibration import save_prior, with_earlier_calibrations
from factorgraph_dvl.files.folders import SETTINGS_FILE, new_folder
from factorgraph_dvl.files.initial_conditions import (
    attitude_of,
    initial_settings,
    position_of,
    velocity_of,
)
from factorgraph_dvl.files.motion_table import COLUMNS as MOTION_COLUMNS
from factorgraph_dvl.files.motion_table import motion_columns, read_reference, reference_from
from factorgraph_dvl.files.tables import Tables, columns_of, read_table, write_table
from factorgraph_dvl.files.trial_yaml import (
    LimitSettings,
    ReferenceSettings,
    TrialSettings,
    parse_trial,
    settings_type,
    to_yaml,
)
from factorgraph_dvl.files.truth_file import read_truth, truth_json
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding
from factorgraph_dvl.quality.invalid_values import without_invalid_values
from factorgraph_dvl.quality.verdict import DEFAULT_LIMITS
from factorgraph_dvl.sensors.catalogue import AIDS, aid_types
from factorgraph_dvl.sensors.dvl import Dvl
from factorgraph_dvl.sensors.dvl_beams import DvlBeams
from factorgraph_dvl.sensors.gnss import Gnss
from factorgraph_dvl.sensors.imu import Imu
from factorgraph_dvl.sensors.protocol import (
    Aid,
    SensorRecord,
    SensorSection,
    part_types,
    parts_of,
)
from factorgraph_dvl.sensors.records import check_possible
from factorgraph_dvl.settings.certificate import CertificateSettings
from factorgraph_dvl.settings.convert import from_plain
from factorgraph_dvl.settings.yaml_file import parse_yaml, read_text
from factorgraph_dvl.trial import (
    Reference,
    Trial,
)

TRUTH_FILE = "truth.json"
# Where a trial that was loaded with a calibration of its DVL or its IMU keeps it when it is saved.
PRIOR_FILE = "dvl-calibration.json"
BIAS_FILE = "imu-calibration.json"
_PARTS = tuple(part.section for kind in AIDS for part in part_types(kind).values())
_TABLES = dict.fromkeys(("imu", *(kind.section for kind in AIDS), *_PARTS, "reference"))
OWNED = (
    SETTINGS_FILE,
    TRUTH_FILE,
    PRIOR_FILE,
    BIAS_FILE,
    *(f"{table}{suffix}" for table in _TABLES for suffix in (".csv", ".parquet")),
)


# What trial.yaml begins with if `simulate` wrote it, or `save_trial`.
_SIMULATED = "# Simulated by factorgraph-dvl"
_SAVED = "# Saved by factorgraph_dvl"
# Keys whose values are names of files.
_NAMING = ("file", "calibration", "trajectory")

_Sensor = TypeVar("_Sensor", bound=SensorRecord)


def load_trial(path: Path | str, *, anyway: bool = False) -> Trial:
    """Read a trial folder.

    Parameters
    ----------
    path : path-like
        Path of the folder, or of the trial.yaml in it.
    anyway : bool, default False
        Start from the calibrations in `dvl.calibration` and `imu.calibration` also if they are
        graded `do not use`; the trial notes it.

    Raises
    ------
    ConfigError
        If trial.yaml is missing or contains a key that is unknown, missing, of the wrong
        type or out of range.
    DataError
        If a table is missing or does not contain what it should.

    Examples
    --------
    >>> import factorgraph_dvl as fd
    >>> fd.load_trial("data/seed-a-phase-90").body_axes
    'RFU'
    """
    folder, file = locate(Path(path))
    settings = parse_trial(read_text(file), file.name)
    trial = assembled(settings, folder, folder, anyway=anyway)
    name = printable(settings.name or folder.resolve().name)
    truth = read_truth(folder / TRUTH_FILE)
    return replace(trial, name=name, calibration_truth=truth)


def assembled(
    settings: TrialSettings, tables: Path | Tables, folder: Path, *, anyway: bool = False
) -> Trial:
    """Return the trial that settings describe, without its truth.

    Parameters
    ----------
    settings : TrialSettings
        Settings as in trial.yaml.
    tables : Path or mapping of str to mapping
        Folder with the tables of the sensors, or the tables by section.
    folder : Path
        Where `dvl.calibration` is looked for.
    anyway : bool, default False
        Option as of `load_trial`.
    """
    initial = settings.initial
    kinds = {aid.section: aid for aid in aid_types()}
    notes: list[Finding] = []
    imu = None if settings.imu is UNSET else read_record(tables, Imu, settings.imu, notes)
    aids = {
        name: read_record(tables, kinds[name], section, notes)
        for name, section in settings.aids.items()
    }
    dvl = cast("Dvl | None", aids.pop(Dvl.section, None))
    imu, dvl, found = with_earlier_calibrations(
        *(imu, dvl, folder, settings.body_axes, settings.epoch), anyway=anyway
    )
    notes += found
    if dvl is not None and _share_pings(dvl, aids):
        notes.append(
            Finding(
                Code.COUNTED_TWICE,
                message("counted_twice.dvl"),
            )
        )
    return Trial(
        name=printable(settings.name),
        imu=imu,
        gnss=cast("Gnss | None", aids.pop(Gnss.section, None)),
        dvl=dvl,
        others=tuple(aids.values()),
        body_axes=settings.body_axes,
        epoch=settings.epoch,
        noise="estimated" if settings.noise is UNSET else settings.noise,
        initial_attitude=None if initial is UNSET else attitude_of(initial),
        initial_position=None if initial is UNSET else position_of(initial),
        initial_velocity=None if initial is UNSET else velocity_of(initial),
        reference=_reference_of(tables, settings),
        notes=tuple(notes),
        certificate=(
            {} if settings.certificate is UNSET else msgspec.to_builtins(settings.certificate)
        ),
        limits={**DEFAULT_LIMITS, **({} if settings.limits is UNSET else settings.limits.stated)},
    )


def load_reference(path: Path | str) -> tuple[Reference | None, dict[str, Array]]:
    """Read what a trial folder has to compare with, and none of its sensors.

    Parameters
    ----------
    path : path-like
        Path of the folder, or of the trial.yaml in it.

    Returns
    -------
    reference : Reference or None
        None if there is none.
    truth : dict of str to ndarray
        The true calibration by reported name; empty if there is none.

    Raises
    ------
    ConfigError, DataError
        As `load_trial`.
    """
    folder, file = locate(Path(path))
    settings = parse_trial(read_text(file), file.name)
    return _reference_of(folder, settings), read_truth(folder / TRUTH_FILE)


def record_files(path: Path) -> list[Path]:
    """Return the tables of a trial's sensors, that of the IMU first.

    Raises
    ------
    ConfigError, DataError
        As `load_trial`.
    """
    folder, file = locate(path)
    settings = parse_trial(read_text(file), file.name)
    sections: list[SensorSection] = [] if settings.imu is UNSET else [settings.imu]
    sections += settings.aids.values()
    for kind in aid_types():
        if (section := settings.aids.get(kind.section)) is not None:
            inner = (getattr(section, name) for name in part_types(kind))
            sections += [part for part in inner if part is not UNSET]
    return [folder / section.file for section in sections]


def save_trial(
    trial: Trial,
    path: Path | str,
    *,
    force: bool = False,
    parquet: bool = False,
    seed: int | None = None,
) -> None:
    """Write a trial folder, complete or not at all.

    Parameters
    ----------
    trial : Trial
        Trial to write.
    path : path-like
        Path of the folder.
    force : bool, default False
        Replace a trial that `save_trial` or `simulate` wrote; never another one, whose tables may
        be the only ones.
    parquet : bool, default False
        Write the sensors' tables as Parquet.
    seed : int, optional
        Seed of a trial that was simulated: trial.yaml says so.

    Raises
    ------
    DataError
        If the folder exists, is not empty, and `force` is not set, or contains a trial that was
        written otherwise.

    Examples
    --------
    >>> import tempfile
    >>> import factorgraph_dvl as fd
    >>> trial = fd.simulate("examples/short.yaml", seed=1)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fd.save_trial(trial, f"{folder}/trial", parquet=True)
    ...     fd.load_trial(f"{folder}/trial").dvl.time.size
    172
    """
    suffix = ".parquet" if parquet else ".csv"
    _check_written(Path(path), "save_trial", (_SAVED, _SIMULATED))
    tables = (f"{record.section}{suffix}" for record in trial.records)
    owned = tuple(dict.fromkeys((*OWNED, *tables)))
    with new_folder(Path(path), force=force, owned=owned) as folder:
        for record in trial.records:
            for each in (record, *parts_of(record).values()):
                write_table(folder / f"{each.section}{suffix}", each.columns())
        if trial.reference is not None:
            write_table(folder / f"reference{suffix}", motion_columns(trial.reference))
        if trial.calibration_truth:
            (folder / TRUTH_FILE).write_bytes(truth_json(trial.calibration_truth))
        if trial.imu is not None and trial.imu.prior is not None:
            trial = replace(trial, imu=save_prior(folder, BIAS_FILE, trial.imu, trial))
        if trial.dvl is not None and trial.dvl.prior is not None:
            both = trial.imu is not None and trial.dvl.prior is trial.imu.prior
            file = BIAS_FILE if both else PRIOR_FILE
            trial = replace(trial, dvl=save_prior(folder, file, trial.dvl, trial))
        _write_settings(folder, _settings(trial, suffix), seed)


def _write_settings(folder: Path, settings: TrialSettings, seed: int | None) -> None:
    """Write trial.yaml, which says what wrote it, and the seed of a simulated trial."""
    head = f"{_SAVED}; it may replace this folder\n"
    if seed is not None:
        head = f"{_SIMULATED}, seed {seed}; simulate --force replaces it\n"
    (folder / SETTINGS_FILE).write_text(head + to_yaml(settings), encoding="utf-8")


def check_simulated(path: Path) -> None:
    """Raise DataError if a folder contains a trial that was not written by `simulate`."""
    _check_written(path, "simulate", (_SIMULATED,))


def _check_written(path: Path, by: str, heads: tuple[str, ...]) -> None:
    file = path / SETTINGS_FILE
    if file.exists() and not read_text(file).startswith(heads):
        raise DataError(
            f"contains a {SETTINGS_FILE} that `{by}` did not write, and may not replace",
            where=str(path),
            expected=f"another folder, or one whose {SETTINGS_FILE} begins with `{heads[0]}`",
        )


def inputs_of(path: Path) -> list[Path]:
    """Return what is read of a trial or of results: the folder, and all files that it names.

    What cannot be read names none: that is found out when it is loaded.
    """
    file = path / SETTINGS_FILE if path.is_dir() else path
    found = [path if path.is_dir() else file]
    if path.is_dir() or file.name == SETTINGS_FILE:
        found.append(file.parent)
    if file.suffix.lower() not in (".yaml", ".yml", ".json"):
        return found
    with suppress(ConfigError):
        named = parse_yaml(read_text(file), dict[str, Any], source=file.name)
        found += [file.parent / name for name in _named(named)]
    return found


def files_of(path: Path) -> list[Path]:
    """Return the files that a trial is read from, in a fixed order: settings, records, others."""
    found = {file for file in inputs_of(path) if file.is_file()}
    with suppress(FactorgraphDvlError):
        # Records that the settings do not name have names by default.
        found |= set(record_files(path))
    return [locate(path)[1], *sorted(found - {locate(path)[1]})]


def _named(settings: Any) -> Iterator[str]:
    """Yield the names of files in settings, at any depth."""
    if isinstance(settings, dict):
        for key, value in settings.items():
            if key in _NAMING and isinstance(value, str):
                yield value
            else:
                yield from _named(value)


def _share_pings(dvl: Dvl, others: dict[str, Aid]) -> bool:
    beams = others.get(DvlBeams.section)
    return beams is not None and bool(np.mean(np.isin(beams.time, dvl.time)) > 0.5)


_IMPORT = "Make one of files of instruments with: factorgraph-dvl import FILE… --out TRIAL"


def locate(path: Path) -> tuple[Path, Path]:
    """Return a trial's folder and its trial.yaml."""
    if not path.exists():
        raise DataError("the trial does not exist", where=str(path), expected="a trial folder")
    if not path.is_dir():
        if path.suffix.lower() not in (".yaml", ".yml"):
            raise DataError(
                "not a trial",
                where=str(path),
                expected=f"a trial folder, or the {SETTINGS_FILE} in it",
                hint=_IMPORT,
            )
        return path.parent, path
    file = path / SETTINGS_FILE
    if not file.exists():
        if (path / CALIBRATION_FILE).exists():
            raise DataError(
                "the folder of a result, not of a trial",
                where=str(path),
                expected=f"a folder with {SETTINGS_FILE}",
                hint="Show a result with: factorgraph-dvl report DIR",
            )
        raise DataError(
            f"the folder has no {SETTINGS_FILE}",
            where=str(path),
            expected="a trial folder",
            hint=_IMPORT,
        )
    return path, file


def _reference_of(tables: Path | Tables, settings: TrialSettings) -> Reference | None:
    """Return the reference that the settings of a trial name, None if they name none."""
    if settings.reference is UNSET:
        return None
    file = settings.reference.file
    if isinstance(tables, Path):
        return read_reference(tables / file, file)
    return reference_from(columns_of(tables["reference"], MOTION_COLUMNS, source=file), file)


def read_record(
    tables: Path | Tables, kind: type[_Sensor], settings: SensorSection, notes: list[Finding]
) -> _Sensor:
    """Return the record of a sensor, from the table that its settings name in a folder.

    Invalid values are missing in it; `notes` takes in how many there were.
    """
    required = (*kind.required, *settings.more_columns)
    if isinstance(tables, Path):
        file = tables / settings.file
        table = read_table(file, required, kind.optional, source=settings.file)
    else:
        table = columns_of(tables[kind.section], required, kind.optional, source=settings.file)
    columns, found = without_invalid_values(kind.section, table, settings.file)
    notes += found
    check_possible(columns, settings.file)
    inner = {
        name: read_record(tables, part, section, notes)
        for name, part in part_types(kind).items()
        if (section := getattr(settings, name)) is not UNSET
    }
    return cast(Any, kind).from_columns(settings, columns, settings.file, **inner)


def _settings(trial: Trial, suffix: str) -> TrialSettings:
    return settings_type(record.section for record in trial.records)(
        format=1,
        name=trial.name,
        body_axes=trial.body_axes,
        epoch=trial.epoch,
        noise=UNSET if trial.planar else trial.noise,
        **{record.section: _named_settings(record, suffix) for record in trial.records},
        limits=_limits(trial),
        certificate=(
            from_plain(dict(trial.certificate), CertificateSettings)
            if trial.certificate
            else UNSET
        ),
        initial=initial_settings(trial),
        reference=(
            UNSET if trial.reference is None else ReferenceSettings(file=f"reference{suffix}")
        ),
    )


def _named_settings(record: SensorRecord, suffix: str) -> SensorSection:
    """Return the settings of a record and its parts, with the tables as they are written."""
    inner = {name: _named_settings(part, suffix) for name, part in parts_of(record).items()}
    return msgspec.structs.replace(record.settings, file=f"{record.section}{suffix}", **inner)


def _certificate(trial: Trial) -> CertificateSettings | msgspec.UnsetType:
    stated = dict(trial.certificate)
    return from_plain(stated, CertificateSettings) if stated else UNSET


def _limits(trial: Trial) -> LimitSettings | msgspec.UnsetType:
    stated = {n: limit for n, limit in trial.limits.items() if limit != DEFAULT_LIMITS.get(n)}
    return LimitSettings(**stated) if stated else UNSET
