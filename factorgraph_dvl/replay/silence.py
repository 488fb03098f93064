"""Kinds of measurements that have fallen silent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.replay.estimate import Innovations

# Silence that is worth a message, s.
_SILENT = 5.0


class Silence:
    """When each kind of measurement was heard last."""

    def __init__(self) -> None:
        # When it arrived, and the latest time that it was of.
        self._heard: dict[str, tuple[float, float]] = {}
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
            if i.label in self._silent:
                self._silent.discard(i.label)
                messages.append(f"{i.label}: back after {now - arrived:.1f} s")
        for label, (arrived, of) in self._heard.items():
            if now - arrived > _SILENT and label not in self._silent:
                self._silent.add(label)
                messages.append(f"{label}: nothing since {of:.1f} s; the estimate goes on without")
        return messages
