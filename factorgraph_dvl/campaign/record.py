"""Records of the runs of a campaign: what went in, how it ended, what it took."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import msgspec

from factorgraph_dvl import __version__
from factorgraph_dvl.errors import DataError
from factorgraph_dvl.files.run_file import hash_of
from factorgraph_dvl.settings.convert import from_json
from factorgraph_dvl.settings.files import MEGABYTE, read_bytes


class RunRecord(msgspec.Struct, kw_only=True):
    """How a run ended.

    Parameters
    ----------
    name : str
        Name of the trial, or the number of the seed.
    fingerprint : str
        Fingerprint of all that the run depends on; see `fingerprint_of`.
    done : bool
        Whether it has a result.
    error : str, optional
        Why it has none.
    epoch : str, optional
        Epoch of the trial, ISO 8601.
    wall_s, cpu_s, peak_bytes : float or int, optional
        What it took.
    result : str, optional
        SHA-256 of the file with its result, by which one that was changed is known.
    prior_names : list of str, optional
        Components that an earlier calibration was the prior of.
    prior_covariance : list of list of float, optional
        Prior covariance of these, in reported units.
    """

    name: str
    fingerprint: str
    done: bool
    error: str = ""
    epoch: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_bytes: int = 0
    result: str = ""
    prior_names: list[str] = msgspec.field(default_factory=list)
    prior_covariance: list[list[float]] = msgspec.field(default_factory=list)


_Record = TypeVar("_Record", bound=RunRecord)


def write_record(record: RunRecord, path: Path) -> None:
    """Write a record, complete or not at all."""
    write_whole(path, msgspec.json.encode(record))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that appears complete or not at all, also if its folder is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_record(path: Path, kind: type[_Record]) -> _Record | None:
    """Return a record, None where there is none that can be read."""
    try:
        content = read_bytes(path, limit=MEGABYTE, expected="the record of a run")
        return from_json(content, kind)
    except (DataError, msgspec.MsgspecError):
        return None


def fingerprint_of(files: Iterable[Path], options: Mapping[str, str]) -> str:
    """Return a hash of the content of files, of options, and of the version of the program.

    Parameters
    ----------
    files : iterable of path-like
        Files that a run reads; those that do not exist count as empty.
    options : mapping of str to str
        What else its result depends on.
    """
    total = hashlib.sha256(__version__.encode())
    for name, value in sorted(options.items()):
        total.update(f"\0{name}\0{value}".encode())
    for file in files:
        total.update(f"\0{file.name}\0{hash_of(file)}".encode())
    return total.hexdigest()
