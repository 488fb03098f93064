"""Files that are read whole: regular ones only, and no larger than their kind can be."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from factorgraph_dvl.errors import ConfigError, DataError

# By definition, bytes.
MEGABYTE = 1_000_000


def read_bytes(
    path: Path,
    *,
    limit: int,
    expected: str,
    kind: type[ConfigError | DataError] = DataError,
) -> bytes:
    """Read a file.

    A pipe or a device may block for ever or never end: it is not read.

    Parameters
    ----------
    path : path-like
        Of the file.
    limit : int
        Of its size, bytes.
    expected : str
        What it should hold, for messages.
    kind : type of ConfigError or DataError, optional
        Of the error.

    Raises
    ------
    DataError
        If there is no such file, it is none, it is too large, or it cannot be read.
    """
    where = str(path)
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise kind("is a pipe or a device", where=where, expected="a regular file")
            if status.st_size > limit:
                raise kind(
                    f"the file has {status.st_size / MEGABYTE:.0f} MB",
                    where=where,
                    expected=f"{expected}, at most {limit / MEGABYTE:g} MB",
                )
            return file.read(limit)
    except (FileNotFoundError, NotADirectoryError):
        raise kind("the file does not exist", where=where, expected=expected) from None
    except IsADirectoryError:
        raise kind("is a folder", where=where, expected=f"a file: {expected}") from None
    except OSError as error:
        raise kind(f"cannot be read ({error.strerror})", where=where) from None
    except ValueError:
        raise kind("is not the name of a file", where=where, expected=expected) from None


def _open_at_once(path: str, flags: int) -> int:
    # Opening a pipe would wait for somebody to write into it.
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
