"""Input files: regular ones only, opened in one place."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

from factorgraph_dvl.errors import ConfigError, DataError

# By definition, bytes.
MEGABYTE = 1_000_000
_OTHERS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (lambda mode: not stat.S_ISREG(mode), "a device"),
)


def read_bytes(
    path: Path,
    *,
    limit: int,
    expected: str,
    kind: type[ConfigError | DataError] = DataError,
) -> bytes:
    """Read a file that is no larger than its kind can be.

    Parameters
    ----------
    path : path-like
        Path of the file.
    limit : int
        Limit of its size, bytes.
    expected : str
        What it should contain, for messages.
    kind : type of ConfigError or DataError, optional
        Kind of the error.

    Raises
    ------
    DataError
        If it cannot be opened or read, or is too large.
    """
    with open_file(path, expected=expected, kind=kind) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            if size > limit:
                raise kind(
                    f"the file has {size / MEGABYTE:.0f} MB",
                    where=str(path),
                    expected=f"{expected}, at most {limit / MEGABYTE:g} MB",
                )
            return file.read(limit)
        except OSError as error:
            raise kind(f"cannot be read ({error.strerror})", where=str(path)) from None


def open_file(
    path: Path,
    *,
    expected: str,
    where: str = "",
    kind: type[ConfigError | DataError] = DataError,
) -> BufferedReader:
    """Open a regular file for reading.

    A pipe or a device may block for ever, never end, or act when it is opened: it is not opened.

    Parameters
    ----------
    path : path-like
        Path of the file.
    expected : str
        What it should contain, for messages.
    where : str, optional
        Name of the file in messages; by default its path.
    kind : type of ConfigError or DataError, optional
        Kind of the error.

    Raises
    ------
    DataError
        If there is no such file, it is no regular one, or it cannot be opened.
    """
    where = where or str(path)
    try:
        mode = os.stat(path).st_mode
        for is_one, name in _OTHERS:
            if is_one(mode):
                raise kind(f"is {name}", where=where, expected=f"a regular file: {expected}")
        return open(path, "rb", opener=_open_at_once)
    except (FileNotFoundError, NotADirectoryError):
        raise kind("the file does not exist", where=where, expected=expected) from None
    except OSError as error:
        loop = error.errno == errno.ELOOP
        what = (
            "is a link that leads back to itself" if loop else f"cannot be read ({error.strerror})"
        )
        raise kind(what, where=where, expected=expected) from None
    except UnicodeEncodeError as error:
        raise kind(
            f"the name of the file cannot be written in {error.encoding}, the encoding of this "
            "system's file names",
            where=where,
            expected="a locale with UTF-8, such as LC_ALL=C.UTF-8",
        ) from None
    except ValueError:
        raise kind("is not the name of a file", where=where, expected=expected) from None


def check_file(
    path: Path,
    *,
    expected: str,
    where: str = "",
    kind: type[ConfigError | DataError] = DataError,
) -> None:
    """Raise the error of `open_file` unless a file can be opened.

    For files that a library opens by their names. The parameters are those of `open_file`.
    """
    open_file(path, expected=expected, where=where, kind=kind).close()


def _open_at_once(path: str, flags: int) -> int:
    # Opening a pipe that has just taken the place of the file would wait for a writer.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
