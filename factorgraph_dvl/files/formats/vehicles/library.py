"""Third-party readers: loaded where they are used, silent, their failures as errors of ours."""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph_dvl.errors import ConfigError, DataError
from factorgraph_dvl.files.formats.format import Batch
from factorgraph_dvl.geometry.vectors import Array

# Kinds of fixes in autopilots (none, no fix, 2D, 3D, differential, RTK float, RTK fixed) to GGA's
# numbers.
_QUALITY = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 5.0, 4.0])


def load(module: str, extra: str) -> Any:
    """Import a third-party module.

    Parameters
    ----------
    module : str
        Its name.
    extra : str
        The extra of this package that installs it.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ConfigError(
            f"{module.partition('.')[0]} is not installed",
            expected=f"the extra `{extra}`",
            hint=f"Install it by: pip install 'factorgraph-dvl[{extra}]'",
        ) from None


class _Nowhere(io.TextIOBase):
    def write(self, text: str) -> int:
        return len(text)


@contextmanager
def quiet() -> Iterator[None]:
    """Drop what a library prints; not around a `yield` that leaves this package."""
    with redirect_stdout(_Nowhere()), redirect_stderr(_Nowhere()):
        yield


def silently(batches: Iterator[Batch]) -> list[Batch]:
    """Return all batches; damaged numbers overflow quietly, their ranges are checked later."""
    with np.errstate(all="ignore"):
        return list(batches)


def column(rows: Sequence[Mapping[str, Any]], name: str) -> Array:
    """Return the values of a column by its name, nan where it is missing or no number."""
    values = (row.get(name) for row in rows)
    return np.array([float(v) if isinstance(v, int | float) else np.nan for v in values])


def columns(rows: Sequence[Mapping[str, Any]], *names: str) -> Array:
    """Return several columns side by side, (N, M)."""
    return np.stack([column(rows, name) for name in names], axis=1)


def gga_quality(kind: Array) -> Array:
    """Return the quality as in GGA of fixes by their kind in logs of autopilots, 0 if unknown."""
    known = np.isin(kind, np.arange(len(_QUALITY)))
    return np.where(known, _QUALITY[np.where(known, kind, 0).astype(int)], 0.0)


def unreadable(path: Path, error: BaseException, expected: str, hint: str = "") -> DataError:
    """Return the error for a file that a library gives up on before its first message."""
    return DataError(
        f"cannot be read ({describe(error)})", where=path.name, expected=expected, hint=hint
    )


def describe(error: BaseException) -> str:
    """Return an exception of a library in one short line."""
    text = " ".join(str(error).split())[:200]
    return text.rstrip(".") or type(error).__name__


def given_up(path: Path, error: BaseException, count: int) -> str:
    """Return the note on a file that a library gives up on after `count` messages."""
    return f"{path.name} is damaged: read up to message {count} ({describe(error)})"
