"""Finished stages of a run, kept beside its output so that an interrupted run can go on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

_FINGERPRINT = "fingerprint"
_SUFFIX = ".msgpack"
# Kinds of numbers that results consist of: truth values, integers, floats.
_KINDS = "biuf"

_Result = TypeVar("_Result")


class FinishedStages:
    """Results of stages in a folder, for as long as inputs and options are the same.

    Parameters
    ----------
    folder : path-like
        Of these files alone.
    fingerprint : str
        Of all that the results depend on.
    resume : bool
        Whether to take what an earlier run left there; else it is removed.

    Attributes
    ----------
    found : bool
        Whether an earlier run left results of the same inputs.
    """

    def __init__(self, folder: Path, fingerprint: str, *, resume: bool) -> None:
        self._folder = folder
        file = folder / _FINGERPRINT
        self.found = resume and file.is_file() and file.read_bytes() == fingerprint.encode()
        if not self.found:
            self.remove()
            folder.mkdir(parents=True, exist_ok=True)
            _write(file, fingerprint.encode())

    @property
    def names(self) -> list[str]:
        """Names of the stages that have a result, the oldest first."""
        files = sorted(self._folder.glob(f"*{_SUFFIX}"), key=lambda file: file.stat().st_mtime_ns)
        return [file.stem for file in files]

    def result(self, stage: str, kind: type[_Result], compute: Callable[[], _Result]) -> _Result:
        """Return the result of a stage: the one that was kept, else a new one, which is kept.

        Parameters
        ----------
        stage : str
            Name of the stage.
        kind : type
            Data class of the result: of numbers, texts, arrays and such data classes.
        compute : callable
            Returns the result.
        """
        file = self._folder / f"{stage}{_SUFFIX}"
        if file.exists():
            try:
                return msgspec.msgpack.decode(file.read_bytes(), type=kind, dec_hook=_decoded)
            except (OSError, msgspec.MsgspecError, TypeError, ValueError):
                # What cannot be read is computed anew.
                pass
        out = compute()
        # Sensors of other packages may have results of other kinds, which are computed anew.
        with suppress(TypeError, OverflowError):
            _write(file, msgspec.msgpack.encode(out, enc_hook=_encoded))
        return out

    def remove(self) -> None:
        """Remove all results."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _write(file: Path, content: bytes) -> None:
    """Write a file, complete or not at all; without room for it the run goes on."""
    partial = file.with_suffix(".partial")
    try:
        partial.write_bytes(content)
        partial.replace(file)
    except OSError:
        with suppress(OSError):
            partial.unlink()


def _encoded(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be kept")


def _decoded(kind: Any, value: Any) -> Any:
    dtype, shape, content = value
    if np.dtype(dtype).kind not in _KINDS:
        raise ValueError(f"an array of {dtype}")
    return np.frombuffer(content, dtype=dtype).reshape(shape).copy()
