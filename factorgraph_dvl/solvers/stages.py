"""Stages of a solve, whose results a caller may keep: an interrupted run can then go on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

_Result = TypeVar("_Result")


class Stages(Protocol):
    """Results of stages that have ended."""

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


def finished(
    stages: Stages | None, stage: str, kind: type[_Result], compute: Callable[[], _Result]
) -> _Result:
    """Return the result of a stage, as `Stages.result`; without stages, a new one."""
    return compute() if stages is None else stages.result(stage, kind, compute)
