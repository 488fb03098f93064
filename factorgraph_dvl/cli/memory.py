"""Error message of a run without enough memory."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from factorgraph_dvl.errors import SolveError

_P = ParamSpec("_P")
_R = TypeVar("_R")

# Measured with `solve` at a state a second: 0.40 GB for 120 000 IMU samples with 12 000 rows of
# other sensors; 0.74 GB for 480 000 with 48 000, 0.69 GB for half of these samples.
_LIBRARIES_GB = 1.5
_BASE_GB = 0.29
_GB_PER_SAMPLE = 0.22e-6
_GB_PER_ROW = 7.1e-6


def naming_memory(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a command that reports the memory it needs if there is too little."""

    @wraps(command)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return command(*args, **kwargs)
        except MemoryError:
            trial = kwargs.get("trial_path")
        # The memory of the command is free again here.
        samples, rows = _sizes(trial) if isinstance(trial, Path) else (0, 0)
        need = ""
        if samples:
            size = _BASE_GB + _GB_PER_SAMPLE * samples + _GB_PER_ROW * rows
            need = (
                f": a trial of {samples} IMU samples and {rows} other measurements needs about "
                f"{size:.1f} GB, and libraries reserve {_LIBRARIES_GB:g} GB of address space"
            )
        raise SolveError(
            f"there is not enough memory{need}",
            hint="Use more memory, a shorter span of time, or IMU samples at a lower rate",
        )

    return run


def _sizes(trial_path: Path) -> tuple[int, int]:
    """Return the rows of a trial's IMU and of its other sensors; 0 if unknown."""
    from factorgraph_dvl.files.tables import count_rows
    from factorgraph_dvl.files.trial_folder import record_files

    try:
        imu, *others = (count_rows(file) for file in record_files(trial_path))
    except Exception:
        # The estimate is optional: it must not replace the error.
        return 0, 0
    return imu, sum(others)
