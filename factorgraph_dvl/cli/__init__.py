"""The command line: parse, load, call, report, exit code."""

from __future__ import annotations

from factorgraph_dvl.cli.app import main

__all__ = ["main"]
