"""Innovation gate: rejects single outliers, and whole kinds that contradict the prediction."""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.message import message
from factorgraph_dvl.quality.finding import Code, Finding

# Standard deviations beyond which a measurement is rejected; chosen: 2e-9 of Gaussian errors.
_LIMIT = 6.0
# Measurements of a kind that are judged together, and fewest that suffice to exclude it; chosen:
# 5 s of a DVL at 10 Hz, and 1 s.
_WINDOW = 50
_LEAST = 10
# Share of the window beyond the limit from which a kind is excluded, and up to which it is used
# again; chosen: far above single outliers, and far below that of a faulty sensor.
_EXCLUDE_SHARE = 0.3
_READMIT_SHARE = 0.05
# The same for kinds with outliers of their own, such as echoes; chosen: half may be echoes.
_EXCLUDE_SHARE_ECHOES = 0.6
_READMIT_SHARE_ECHOES = 0.4
# RMS of the window's normalised innovations from which a kind is inconsistent, excluded, and
# consistent again; chosen. Measured on Gaussian innovations: the RMS of 50 exceeds 1.3 in 1e-6.
_INCONSISTENT_RMS = 1.5
_EXCLUDE_RMS = 3.0
_CONSISTENT_RMS = 1.3


class InnovationGate:
    """Decides for each kind of measurement which are used, by their normalised innovations.

    Attributes
    ----------
    rejected : Counter
        Number of measurements that were not used, by kind.
    inconsistent : set of str
        Kinds whose innovations are larger than predicted at the moment.
    excluded : set of str
        Those among them of which nothing is used.
    """

    def __init__(self) -> None:
        # By kind, of the last measurements: whether each is an outlier, and its mean square, 0 of
        # an outlier.
        self._windows: dict[str, tuple[deque[bool], deque[float]]] = {}
        self.inconsistent: set[str] = set()
        self.excluded: set[str] = set()
        self.rejected: Counter[str] = Counter()

    def accept(
        self, label: str, normalised: Array, echo_limit: float | None = None
    ) -> tuple[np.ndarray, Finding | None]:
        """Return which of M measurements are used, and a finding if a kind's status changes.

        Parameters
        ----------
        label : str
            Name of the kind.
        normalised : ndarray, shape (M, d)
            Innovations over their standard deviations; nan where a component was not measured.
        echo_limit : float, optional
            Standard deviations beyond which a measurement is an outlier of the kind, such as an
            echo; None for kinds without.

        Returns
        -------
        ndarray, shape (M,)
            Whether each measurement is used.
        Finding or None
            What changed; None if nothing did.
        """
        if label not in self._windows:
            self._windows[label] = deque(maxlen=_WINDOW), deque(maxlen=_WINDOW)
        outliers, squares = self._windows[label]
        limit = _LIMIT if echo_limit is None else echo_limit
        # A few numbers at a time: plain ones take a tenth of the time of arrays.
        rows = normalised.tolist()
        beyond = [any(abs(x) >= limit for x in row) for row in rows]
        outliers.extend(beyond)
        squares.extend(
            0.0 if outlier else _mean_square(row)
            for outlier, row in zip(beyond, rows, strict=True)
        )
        finding = self._judge(label, limit, echo_limit is not None)
        excluded = label in self.excluded
        used = [not (excluded or outlier) for outlier in beyond]
        self.rejected[label] += used.count(False)
        return np.array(used, dtype=bool), finding

    def _judge(self, label: str, limit: float, echoes: bool) -> Finding | None:
        readmit, exclude = (
            (_READMIT_SHARE_ECHOES, _EXCLUDE_SHARE_ECHOES)
            if echoes
            else (_READMIT_SHARE, _EXCLUDE_SHARE)
        )
        # Outliers are rejected one by one and say nothing of the others.
        outliers, squares = self._windows[label]
        count, total = sum(outliers), len(outliers)
        share = count / total
        rms = math.sqrt(math.fsum(squares) / (total - count)) if count < total else math.inf
        full = total == _WINDOW
        if label in self.inconsistent:
            if full and share <= readmit and rms < _CONSISTENT_RMS:
                self.inconsistent.discard(label)
                self.excluded.discard(label)
                return Finding(Code.HEARD_AGAIN, message("heard_again.consistent"), label)
        elif full and rms > _INCONSISTENT_RMS:
            self.inconsistent.add(label)
            if rms <= _EXCLUDE_RMS and share <= exclude:
                return Finding(
                    Code.CONTRADICTS,
                    message("contradicts.larger", count=_WINDOW, ratio=rms),
                    label,
                )
        if label not in self.excluded and (
            (total >= _LEAST and share > exclude) or (full and rms > _EXCLUDE_RMS)
        ):
            self.inconsistent.add(label)
            self.excluded.add(label)
            text = message("contradicts.excluded", count=_WINDOW, ratio=rms)
            if share > exclude:
                text = message(
                    "contradicts.excluded_beyond", count=count, total=total, limit=limit
                )
            return Finding(Code.CONTRADICTS, text, label)
        return None


def _mean_square(row: list[float]) -> float:
    """Return the mean square of the finite numbers of a row, nan if there are none."""
    squares = [x * x for x in row if math.isfinite(x)]
    return math.fsum(squares) / len(squares) if squares else math.nan
