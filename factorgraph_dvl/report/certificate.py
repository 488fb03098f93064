"""What the certificate of a calibration states, for page and paper."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from factorgraph_dvl.quality.notation import in_words
from factorgraph_dvl.report.html.content import Result

# Names of keys that state units, and the units.
_UNITS = {
    "temperature_c": ("temperature", "°C"),
    "salinity_psu": ("salinity", "PSU"),
    "sound_speed_m_s": ("sound speed", "m/s"),
}


def statements(result: Result) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what is stated: the words that name it, and its text."""
    solution = result.solution
    yield from _stated(result.certificate)
    if "date" not in result.certificate:
        epoch = result.run.get("epoch")
        yield (("recorded from",), str(epoch)) if epoch else (("date",), "not stated")
    yield ("trial",), result.trial
    method = "Factor graph of all data" if solution.solver == "batch" else solution.solver
    yield ("method",), method
    version = result.run.get("versions", {}).get("factorgraph-dvl", "")
    yield ("software",), f"factorgraph-dvl {version}".strip()
    yield ("verdict",), solution.verdict.grade


def _stated(
    values: Mapping[str, Any], before: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield each statement of trial.yaml, with the instrument that it is of."""
    for key, value in values.items():
        name, unit = _UNITS.get(key, (in_words(key), ""))
        if isinstance(value, Mapping):
            yield from _stated(value, (*before, name))
        else:
            yield (*before, name), f"{value} {unit}".strip()
