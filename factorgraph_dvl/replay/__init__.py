"""Incremental smoothing of data as they arrive: collect, align, go."""

from __future__ import annotations

from factorgraph_dvl.replay.estimate import Update
from factorgraph_dvl.replay.recorded import ReplayRecord, replay
from factorgraph_dvl.replay.session import KINDS, LAG, RATE, Kind, Replay

__all__ = ["KINDS", "LAG", "RATE", "Kind", "Replay", "ReplayRecord", "Update", "replay"]
