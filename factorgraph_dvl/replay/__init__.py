"""Incremental smoothing of data as they arrive: collect, align, navigate."""

from __future__ import annotations

from factorgraph_dvl.replay.playback import replay
from factorgraph_dvl.replay.record import ReplayRecord, Update
from factorgraph_dvl.replay.session import KINDS, LAG, RATE, Kind, Replay

__all__ = ["KINDS", "LAG", "RATE", "Kind", "Replay", "ReplayRecord", "Update", "replay"]
