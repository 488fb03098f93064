"""Kinds of measurements that have fallen silent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.replay.estimate import Innovations

# Silence that is worth a message, s, and in usual intervals: a range may be missed.
_SILENT = 5.0
_MISSED = 4.0


class Silence:
    """When each kind of measurement was heard last."""

    def __init__(self) -> None:
        # When it arrived, and the latest time that it was of.
        self._heard: dict[str, tuple[float, float]] = {}
        self._usual: dict[str, float] = {}
        self._silent: set[str] = set()

    def forget(self) -> None:
        """Begin anew."""
        self._heard.clear()
        self._silent.clear()

    def listen(self, now: float, heard: Sequence[Innovations]) -> list[str]:
        """Return which kinds have fallen silent by a time, s, and which are back."""
        messages = []
        for i in heard:
            arrived, of = self._heard.get(i.label, (now, -np.inf))
            self._heard[i.label] = (now, max(float(i.time.max()), of))
            if now > arrived:
                self._usual[i.label] = min(now - arrived, self._usual.get(i.label, np.inf))
            if i.label in self._silent:
                self._silent.discard(i.label)
                messages.append(f"{i.label}: back after {now - arrived:.1f} s")
        for label, (arrived, of) in self._heard.items():
            longest = max(_SILENT, _MISSED * self._usual.get(label, 0.0))
            if now - arrived > longest and label not in self._silent:
                self._silent.add(label)
                messages.append(f"{label}: nothing since {of:.1f} s; the estimate goes on without")
        return messages
