"""What a page shows of one result."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.finding import Finding
from factorgraph_dvl.solution import Solution

_FILES = re.compile(r"[^\s'\"`:;,()]+\.(?:csv|parquet|pq|yaml|yml|json|png|pd0|ens|log|txt|bin)\b")
_POSITION = re.compile(r"lat_deg|lon_deg|height|position_deg|positions|lat$|lon$")
_FILE_KEYS = re.compile(r"^file$|_file$|^calibration$|^source$|^catalogue$|^name$")


@dataclass(frozen=True)
class Result:
    """What a page shows of one result.

    Parameters
    ----------
    name : str
        Name of the result, distinct on its page.
    solution : Solution
        The result.
    run : mapping of str to object, optional
        Content of run.json; empty where there is none.
    history : tuple of (ndarray, tuple of str, ndarray), optional
        Times (H,), names, and standard deviations (H, n) as the calibration converged.
    crosscheck, dead_reckoning : mapping of str to object, optional
        Contents of crosscheck.json and deadreckon.json, where they exist.
    halves : mapping of str to sequence, optional
        Columns of halves.csv.
    check : mapping of str to object, optional
        Content of check.json: numbers before and after calibration.
    check_table : mapping of str to ndarray, optional
        Columns of check.parquet, at M times.
    redacted : bool, default False
        Leave out absolute positions, names of trials, and names of files.
    """

    name: str
    solution: Solution
    run: Mapping[str, Any] = field(default_factory=dict)
    history: tuple[Array, tuple[str, ...], Array] | None = None
    crosscheck: Mapping[str, Any] = field(default_factory=dict)
    dead_reckoning: Mapping[str, Any] = field(default_factory=dict)
    halves: Mapping[str, Any] = field(default_factory=dict)
    check: Mapping[str, Any] = field(default_factory=dict)
    check_table: Mapping[str, Any] = field(default_factory=dict)
    redacted: bool = False

    @property
    def trial(self) -> str:
        """Name of the trial to show."""
        return "trial" if self.redacted else self.solution.trial

    @property
    def certificate(self) -> Mapping[str, Any]:
        """What trial.yaml states for the certificate; empty if nothing, or if redacted."""
        found: Mapping[str, Any] = {} if self.redacted else self.run.get("certificate", {})
        return found

    @property
    def maker(self) -> str:
        """Maker of the DVL, empty if not known."""
        return maker_of(self.run.get("certificate", {}))

    @property
    def start(self) -> float:
        """Time from which the page counts, s."""
        return float(self.solution.trajectory.time[0])


def maker_of(certificate: Mapping[str, Any]) -> str:
    """Return the maker of the DVL that a certificate names, empty if it does not."""
    return str(certificate.get("dvl", {}).get("maker", ""))


def redact(result: Result) -> Result:
    """Return a result without absolute positions, names of trials, and names of files."""
    own = result.solution

    def without_names(text: str) -> str:
        text = _FILES.sub("[file]", text)
        return text.replace(own.trial, "[trial]") if own.trial else text

    def hidden(finding: Finding) -> Finding:
        said = finding.message
        if isinstance(said, str):
            return replace(finding, message=without_names(said))
        return replace(finding, message=said.with_words(without_names))

    run = dict(result.run)
    if run:
        run["epoch"] = ""
        run["settings"] = {name: _without(keys) for name, keys in run["settings"].items()}
    solution = replace(own, trial="trial", findings=tuple(map(hidden, own.findings)))
    crosscheck = dict(result.crosscheck)
    for side in ("a", "b"):
        if side in crosscheck:
            crosscheck[side] = dict(crosscheck[side]) | {"file": "[file]", "trial": "trial"}
    return replace(
        result, solution=solution, run=run, crosscheck=crosscheck, name="result", redacted=True
    )


def _without(value: Any) -> Any:
    """Return settings without positions and names of files, at any depth."""
    if isinstance(value, Mapping):
        return {
            key: _without(v)
            for key, v in value.items()
            if not (_POSITION.search(key) or _FILE_KEYS.search(key))
        }
    if isinstance(value, list | tuple):
        return [_without(v) for v in value]
    return _FILES.sub("[file]", value) if isinstance(value, str) else value
