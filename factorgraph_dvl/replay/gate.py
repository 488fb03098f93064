"""Measurements that contradict what is predicted, one by one and in the long run."""

from __future__ import annotations

from collections import deque

import numpy as np

from factorgraph_dvl.geometry.vectors import Array

# Standard deviations beyond which a measurement is not used.
_BEYOND = 6.0
# Share of the last measurements beyond, from which a kind is not used at all, and share
# at which it is used again.
_BAD = 0.3
_GOOD = 0.05
_LAST = 50
_LEAST = 10
# The same shares where single measurements may be none, as the range of an echo.
_BAD_ECHOES = 0.6
_GOOD_ECHOES = 0.4
# Root mean square of the last normalised innovations from which they are doubted, not used,
# and believed again. That of 50 honest ones exceeds 1.3 once in 1e6.
_DOUBT = 1.5
_SHUT = 3.0
_BELIEVE = 1.3


class Gate:
    """Decides for each kind of measurement what is used, and says so.

    Attributes
    ----------
    refused : number of measurements that were not used, by kind.
    doubted, shut : kinds that disagree with the prediction at the moment, and those among
        them that are not used.
    """

    def __init__(self) -> None:
        self._last: dict[str, deque[tuple[bool, float]]] = {}
        self.doubted: set[str] = set()
        self.shut: set[str] = set()
        self.refused: dict[str, int] = {}

    def passes(
        self, label: str, normalised: Array, echoes: float | None = None
    ) -> tuple[np.ndarray, str]:
        """Return which of M measurements are used, and a message if that changes.

        Parameters
        ----------
        label : str
            Of the kind.
        normalised : ndarray, shape (M, d)
            Innovations over their standard deviations; nan where a component was not measured.
        echoes : float, optional
            Standard deviations beyond which a measurement of this kind is none, if single ones may
            be; None if not.
        """
        last = self._last.setdefault(label, deque(maxlen=_LAST))
        limit = _BEYOND if echoes is None else echoes
        beyond = np.any(np.abs(normalised) >= limit, axis=1)
        squares = np.nanmean(normalised**2, axis=1)
        last.extend(zip(beyond.tolist(), squares.tolist(), strict=True))
        message = self._judge(label, last, limit, echoes is not None)
        used = np.zeros_like(beyond) if label in self.shut else ~beyond
        self.refused[label] = self.refused.get(label, 0) + int((~used).sum())
        return used, message

    def _judge(
        self, label: str, last: deque[tuple[bool, float]], limit: float, echoes: bool
    ) -> str:
        good, bad = (_GOOD_ECHOES, _BAD_ECHOES) if echoes else (_GOOD, _BAD)
        count = sum(beyond for beyond, _ in last)
        share = count / len(last)
        # Single ones that are beyond are left out one by one.
        within = [square for beyond, square in last if not beyond]
        rms = float(np.sqrt(np.mean(within))) if within else np.inf
        full = len(last) == _LAST
        if label in self.doubted:
            if full and share <= good and rms < _BELIEVE:
                self.doubted.discard(label)
                self.shut.discard(label)
                return f"{label}: agrees with the prediction again"
        elif full and rms > _DOUBT:
            self.doubted.add(label)
            if rms <= _SHUT and share <= bad:
                return (
                    f"{label}: the last {_LAST} differ from the prediction by {rms:.1f} times "
                    "what is stated; the standard deviations are too small. A clock that has "
                    "jumped, a time offset or a sensor that fails looks like this"
                )
        if label not in self.shut and (
            (len(last) >= _LEAST and share > bad) or (full and rms > _SHUT)
        ):
            self.doubted.add(label)
            self.shut.add(label)
            what = f"the last {_LAST} differ from the prediction by {rms:.1f} times what is stated"
            if share > bad:
                what = (
                    f"{count} of the last {len(last)} contradict the prediction by more than "
                    f"{limit:g} standard deviations"
                )
            return (
                f"{label}: {what}; not used until they agree. A clock that has jumped, or a "
                "sensor that fails, looks like this"
            )
        return ""
