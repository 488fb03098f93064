"""The command line within a test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from factorgraph_dvl.cli import main


@dataclass
class Result:
    code: int
    out: str
    err: str


Run = Callable[..., Result]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*args: str | Path) -> Result:
        with pytest.raises(SystemExit) as caught:
            main([str(arg) for arg in args])
        code = caught.value.code
        assert isinstance(code, int)
        text = capsys.readouterr()
        return Result(code, text.out, text.err)

    return call
