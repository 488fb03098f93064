"""Output files and folders that appear complete or not at all."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from threading import get_ident

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
        Path of the file.
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


SETTINGS_FILE = "trial.yaml"
_PARTIAL, _NEW, _OLD, _OWNED = "partial", "new", "old", "owned"
# Earlier versions kept results of a run there that was interrupted.
_STAGES = "stages"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2

# Working folders that threads of this process have locked, by thread and output.
_claimed: dict[tuple[int, Path], Path] = {}
# Files that this process wrote last to each output, relative to it.
_written: dict[Path, list[Path]] = {}


@contextmanager
def claim(
    path: Path, *, force: bool = False, owned: Sequence[str] = (), inputs: Iterable[Path] = ()
) -> Iterator[Path]:
    """Keep every other run from writing to an output folder, and yield its working folder.

    What an earlier run left that was killed is cleaned up, and the result that it was
    replacing put back. Within a claim, another one on the same folder does nothing.

    Parameters
    ----------
    path : path-like
        Path of the folder to be written.
    force : bool, default False
        Replace what an earlier run wrote there.
    owned : sequence of str, optional
        Names of what the run may write, as patterns relative to the folder. The first is in every
        result.
    inputs : iterable of path-like, optional
        Files and folders that the run reads.

    Raises
    ------
    DataError
        If the folder contains inputs or, without `force`, anything; if another run is writing
        to it; if it is a link to itself; if it cannot be written or replaced.
    """
    target = real_path(path)
    mine = (get_ident(), target)
    if mine in _claimed:
        yield _claimed[mine]
        return
    _check_inputs(path, target, owned, inputs)
    _check_place(path, target)
    made = [parent for parent in target.parents if not parent.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    work = target.parent / f".{target.name}.factorgraph-dvl"
    lock = _lock(work, path)
    try:
        _recover(work, target)
        _check_content(path, target, force, owned)
        _claimed[mine] = work
        yield work
    finally:
        _claimed.pop(mine, None)
        try:
            _release(work, lock, made)
        except KeyboardInterrupt:
            _release(work, lock, made)
            raise
        finally:
            os.close(lock)


def _release(work: Path, lock: int, made: Sequence[Path]) -> None:
    """Remove a working folder that is locked, and folders made for it that are empty."""
    with suppress(FileNotFoundError):
        # What has its name now may be another run's.
        if os.path.samestat(os.fstat(lock), work.stat()):
            shutil.rmtree(work / _PARTIAL, ignore_errors=True)
            # What could not be removed stays there for the next run.
            if not ((work / _OLD).exists() or (work / _NEW).exists()):
                (work / _OWNED).unlink(missing_ok=True)
            with suppress(OSError):
                work.rmdir()
    with suppress(OSError):
        for parent in made:
            parent.rmdir()


@contextmanager
def new_folder(path: Path, *, force: bool = False, owned: Sequence[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block ends without an error.

    It appears there by one rename, and trades places with an earlier result by one, where
    the file system can do that. Files that are not in `owned` stay.

    Parameters
    ----------
    path, force, owned : path-like, bool, sequence of str
        Path, force and owned as in `claim`.

    Raises
    ------
    DataError
        As `claim`, and if the folder was filled meanwhile and `force` is not set.
    OutputError
        If the disk is full or fails.
    """
    target = real_path(path)
    with claim(path, force=force, owned=owned) as work:
        (work / _OWNED).write_text("\n".join(owned), encoding="utf-8")
        partial = work / _PARTIAL
        partial.mkdir()
        try:
            yield partial
            files = sorted(p.relative_to(partial) for p in partial.rglob("*") if p.is_file())
            if target.is_dir():
                partial.chmod(target.stat().st_mode & 0o7777)
            try:
                partial.rename(target)
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                if not force:
                    raise _occupied(path) from None
                _replace(work, target, owned)
            _written[target] = files
        except OSError as error:
            if error.errno not in _NO_ROOM:
                raise
            raise OutputError(
                f"cannot be written: {error.strerror}; nothing was changed there",
                where=str(path),
                hint="Make room, or choose another folder",
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def files_written(path: Path) -> list[Path]:
    """Return the files that this process wrote last to an output folder, relative to it."""
    return _written.get(real_path(path), [])


def real_path(path: Path) -> Path:
    """Return a path without links; those that lead back to themselves stay in it."""
    return Path(os.path.realpath(path))


def _check_inputs(path: Path, target: Path, owned: Sequence[str], inputs: Iterable[Path]) -> None:
    """Raise DataError if a folder contains a trial that is no result, or anything that is read."""
    if not target.is_dir():
        return
    if SETTINGS_FILE not in owned and (target / SETTINGS_FILE).exists():
        raise DataError(
            f"contains {SETTINGS_FILE}: results may not replace the files of a trial",
            where=str(path),
            expected="another folder for results",
        )
    for given in inputs:
        beside = [p for p in given.iterdir() if not p.is_dir()] if given.is_dir() else []
        for item in (given, *beside):
            if _lies_in(item, target):
                raise DataError(
                    f"contains {item}, which this command reads: its results may not replace it",
                    where=str(path),
                    expected="another folder for results",
                )


def _lies_in(item: Path, folder: Path) -> bool:
    """Whether a file or folder lies in another, at any depth, by its own or its real name."""
    for name in (item.absolute(), real_path(item)):
        for parent in (name, *name.parents):
            with suppress(OSError):
                if parent.samefile(folder):
                    return True
    return False


def _check_place(path: Path, target: Path) -> None:
    """Raise DataError if no folder can be renamed to `target`."""
    if any(place.is_symlink() for place in (target, *target.parents)):
        raise DataError(
            "is a link that leads back to itself",
            where=str(path),
            expected="a folder, or a new name",
            hint="Choose another folder, or remove the link",
        )
    if target.exists() and not target.is_dir():
        raise DataError("is a file", where=str(path), expected="a folder, or a new name")
    parent = target.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise DataError(
            f"{parent} is not a folder", where=str(path), expected="a folder, or a new name"
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        raise DataError(
            "cannot be written",
            where=str(path),
            expected=f"write permission in {parent}",
            hint=f"Choose a folder in it, such as {path / 'result'}" if target.is_dir() else "",
        )
    if target.is_dir() and (os.path.ismount(target) or _lies_in(Path.cwd(), target)):
        what = "where a disk is mounted" if os.path.ismount(target) else "the working folder"
        raise DataError(
            f"is {what}, and cannot be replaced as a whole",
            where=str(path),
            expected="a folder that can be renamed",
            hint=f"Choose a folder in it, such as {path / 'result'}",
        )


def _check_content(path: Path, target: Path, force: bool, owned: Sequence[str]) -> None:
    """Raise DataError if a folder contains what may not be replaced."""
    if not target.is_dir() or not any(target.iterdir()):
        return
    if not force:
        raise _occupied(path)
    if owned and not (target / owned[0]).exists():
        # Without that file it is no result: what has such a name is someone else's.
        for pattern in owned:
            for found in sorted(target.glob(pattern)):
                raise DataError(
                    f"contains {found.relative_to(target)} but no {owned[0]}: it is not an "
                    "earlier result of this command, and --force replaces only such results",
                    where=str(path),
                    expected="another folder",
                )


def _occupied(path: Path) -> DataError:
    return DataError(
        "the folder exists and is not empty",
        where=str(path),
        expected="a new folder",
        hint="Choose another, or replace its results with --force",
    )


def _lock(work: Path, path: Path) -> int:
    """Return the locked handle of the working folder, which is made if it is not there."""
    while True:
        work.mkdir(mode=0o700, exist_ok=True)
        try:
            handle = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except FileNotFoundError:
            # Its run ended just now.
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), work.stat()):
                return handle
        except FileNotFoundError:
            pass
        except BlockingIOError:
            os.close(handle)
            raise DataError(
                "another run is writing to this folder",
                where=str(path),
                expected="one run at a time",
                hint="Choose another folder, or wait until it has ended",
            ) from None
        except OSError as error:
            os.close(handle)
            raise DataError(
                f"cannot be locked ({error.strerror})",
                where=str(work),
                expected="a file system with locks",
                hint="Choose a folder on another disk",
            ) from None
        os.close(handle)


def _recover(work: Path, target: Path) -> None:
    """Remove what a killed run left, and put back what it had set aside."""
    file = work / _OWNED
    owned = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    for left in (_PARTIAL, _STAGES):
        shutil.rmtree(work / left, ignore_errors=True)
    for aside in (work / _OLD, work / _NEW):
        if aside.is_dir():
            if target.exists():
                _remove_leftovers(aside, target, owned)
            else:
                aside.rename(target)


def _replace(work: Path, target: Path, owned: Sequence[str]) -> None:
    """Let a written folder take the place of the target, with the user's files in it."""
    partial, new, old = work / _PARTIAL, work / _NEW, work / _OLD
    for name in _of_others(target, owned):
        source, copy = target / name, partial / name
        if _is_folder(source):
            copy.mkdir(parents=True, exist_ok=True)
            shutil.copymode(source, copy)
        else:
            copy.parent.mkdir(parents=True, exist_ok=True)
            # What cannot be linked is moved afterwards.
            with suppress(OSError):
                os.link(source, copy, follow_symlinks=False)
    partial.rename(new)
    try:
        _exchange(new, target)
    except (OSError, AttributeError):
        # Killed between these two, the next run puts the old result back.
        target.rename(old)
        try:
            new.rename(target)
        except OSError:
            old.rename(target)
            raise
    else:
        new.rename(old)
    _remove_leftovers(old, target, owned)


def _exchange(a: Path, b: Path) -> None:
    """Let two folders trade names at one instant: the standard library has no call for that."""
    libc = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(a), os.fsencode(b)
    if libc.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), str(b))


def _remove_leftovers(aside: Path, target: Path, owned: Sequence[str]) -> None:
    """Remove a folder that was replaced; the user's files in it go to the target first."""
    for name in _of_others(aside, owned):
        source, place = aside / name, target / name
        if _is_folder(source):
            place.mkdir(parents=True, exist_ok=True)
        elif not os.path.lexists(place) or _is_newer(source, place):
            place.parent.mkdir(parents=True, exist_ok=True)
            source.replace(place)
    shutil.rmtree(aside)


def _of_others(folder: Path, owned: Sequence[str], inside: str = "") -> list[PurePath]:
    """Return what in a folder no pattern names, at any depth, folders before their content.

    A folder that a pattern has files in counts only by what else is in it.
    """
    out: list[PurePath] = []
    for item in sorted((folder / inside).iterdir()):
        name = item.relative_to(folder)
        if any(fnmatchcase(name.as_posix(), pattern) for pattern in owned):
            continue
        is_folder = _is_folder(item)
        if not (is_folder and any(name == PurePath(pattern).parent for pattern in owned)):
            out.append(name)
        if is_folder:
            out += _of_others(folder, owned, str(name))
    return out


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_newer(a: Path, b: Path) -> bool:
    """Whether a file is another than b, and was written after it."""
    one, other = a.lstat(), b.lstat()
    return not os.path.samestat(one, other) and one.st_mtime_ns > other.st_mtime_ns
