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
        self._heard: dict[str, float] = {}
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
            time = float(i.time[-1])
            before = self._heard.get(i.label, time)
            self._heard[i.label] = max(time, before)
            if time > before:
                self._usual[i.label] = min(time - before, self._usual.get(i.label, np.inf))
            if i.label in self._silent:
                self._silent.discard(i.label)
                messages.append(f"{i.label}: back after {i.time[-1] - before:.1f} s")
        for label, last in self._heard.items():
            longest = max(_SILENT, _MISSED * self._usual.get(label, 0.0))
            if now - last > longest and label not in self._silent:
                self._silent.add(label)
                messages.append(
                    f"{label}: nothing since {last:.1f} s; the estimate goes on without"
                )
        return messages
