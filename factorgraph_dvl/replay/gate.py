"""Measurements that contradict what is predicted, one by one and in the long run."""

from __future__ import annotations

from collections import deque

import numpy as np

from factorgraph_dvl.conventions import Array

# Standard deviations beyond which a measurement is not used.
_BEYOND = 6.0
# Share of the last measurements beyond, from which a sensor is not used at all, and share
# at which it is used again.
_BAD = 0.3
_GOOD = 0.05
_LAST = 50
_LEAST = 10


class Gate:
    """Decides for each kind of measurement what is used, and says so."""

    def __init__(self) -> None:
        self._last: dict[str, deque[bool]] = {}
        self._shut: set[str] = set()
        self.refused: dict[str, int] = {}

    def passes(self, label: str, normalised: Array) -> tuple[np.ndarray, str]:
        """Return which of M measurements are used, and a message if that changes.

        Parameters
        ----------
        label : of the kind.
        normalised : (M, d) innovations over their standard deviations.
        """
        last = self._last.setdefault(label, deque(maxlen=_LAST))
        beyond = ~(np.abs(normalised).max(axis=1) < _BEYOND)
        last.extend(beyond.tolist())
        share = sum(last) / len(last)
        message = ""
        if label in self._shut:
            if len(last) == _LAST and share <= _GOOD:
                self._shut.discard(label)
                message = f"{label}: agrees with the prediction again and is used again"
        elif len(last) >= _LEAST and share > _BAD:
            self._shut.add(label)
            message = (
                f"{label}: {sum(last)} of the last {len(last)} contradict the prediction by more "
                f"than {_BEYOND:g} standard deviations; not used until they agree. A clock that "
                "has jumped, or a sensor that fails, looks like this"
            )
        used = np.zeros_like(beyond) if label in self._shut else ~beyond
        self.refused[label] = self.refused.get(label, 0) + int((~used).sum())
        return used, message
