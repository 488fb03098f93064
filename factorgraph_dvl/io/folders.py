"""Output folders that appear complete or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from factorgraph_dvl.errors import DataError


def check_output(path: Path, *, force: bool = False) -> None:
    """Raise DataError if a folder cannot be written to `path`.

    Parameters
    ----------
    path : of the folder to be written.
    force : allow one that exists and holds files.
    """
    if path.exists() and not path.is_dir():
        raise DataError("is a file", where=str(path), expected="a folder, or a new name")
    if not force and path.is_dir() and any(path.iterdir()):
        raise DataError(
            "the folder exists and is not empty",
            where=str(path),
            expected="a new folder",
            hint="Choose another, or replace its results with --force",
        )
    parent = path if path.is_dir() else path.absolute()
    while not parent.exists():
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise DataError(
            "cannot be written", where=str(path), expected=f"write permission in {parent}"
        )


@contextmanager
def new_folder(path: Path, *, force: bool = False, owned: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block ends without an error.

    A new folder appears by one rename. Into one that exists the files are moved one by
    one: those in `owned` from an earlier run go first, its other files stay. The first
    of `owned` is what makes the folder valid: it is the first to go and the last to come.

    Parameters
    ----------
    path : of the folder.
    force : allow one that exists and holds files.
    owned : names that an earlier run may have left there.

    Raises
    ------
    DataError
        If `path` is a file, or holds files and `force` is not set.
    """
    check_output(path, force=force)
    home = path if path.is_dir() else path.absolute().parent
    home.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=".partial-", dir=home))
    try:
        yield temporary
        if path.is_dir():
            _replace(temporary, path, owned)
        else:
            temporary.chmod(0o777 & ~_umask())
            temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace(new: Path, path: Path, owned: Sequence[str]) -> None:
    for name in owned:
        _remove(path / name)
    for item in sorted(new.iterdir(), key=lambda item: item.name in owned[:1]):
        _remove(path / item.name)
        item.rename(path / item.name)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
