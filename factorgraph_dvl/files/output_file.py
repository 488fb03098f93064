"""Output files that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from factorgraph_dvl.errors import DataError, OutputError


def check_new_file(path: Path, *, force: bool) -> None:
    """Raise DataError unless a file can be written, and does not exist, or `force` is set."""
    if path.is_dir():
        raise DataError("is a folder", where=str(path), expected="the name of a file")
    if not path.parent.is_dir():
        raise DataError("the folder does not exist", where=str(path.parent), expected="a folder")
    if path.exists() and not path.is_file():
        raise DataError("is a pipe or a device", where=str(path), expected="the name of a file")
    # A link that leads nowhere, too, would be replaced.
    if os.path.lexists(path) and not force:
        raise DataError(
            "the file exists",
            where=str(path),
            expected="a new file",
            hint="Choose another, or replace it with --force",
        )


def write_file(path: Path, write: Callable[[Path], object], *, force: bool = False) -> None:
    """Write a file beside its place, and move it there when it is complete.

    Parameters
    ----------
    path : path-like
        Of the file.
    write : callable of path-like, object
        Writes the file to a path of the same name, and others beside it.
    force : bool, default False
        Replace the file that is there.

    Raises
    ------
    DataError
        As `check_new_file`.
    OutputError
        If it cannot be written.
    """
    check_new_file(path, force=force)
    try:
        with TemporaryDirectory(prefix=".factorgraph-dvl-", dir=path.parent) as folder:
            partial = Path(folder) / path.name
            write(partial)
            # Files that belong to it lie beside it.
            written = sorted(Path(folder).iterdir(), key=lambda file: file.name == path.name)
            for file in written:
                check_new_file(path.parent / file.name, force=force)
            for file in written:
                os.replace(file, path.parent / file.name)
    except OSError as error:
        raise OutputError(
            f"cannot be written: {error.strerror}; nothing was changed there", where=str(path)
        ) from error
