"""Observability as JSON and CSV."""

from __future__ import annotations

import csv
import io
from typing import Any

import msgspec
import numpy as np

from factorgraph_dvl.analysis.information.linearization import PointSet
from factorgraph_dvl.analysis.information.marginals import Direction, Marginals
from factorgraph_dvl.analysis.information.observability import Observability, SegmentMotion
from factorgraph_dvl.analysis.information.segment_singular_values import OBSERVABLE, SingularValues
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.geometry.vectors import Array
from factorgraph_dvl.quality.notation import split_unit
from factorgraph_dvl.quality.texts import text_of
from factorgraph_dvl.report.figure_files import figure_files
from factorgraph_dvl.statistics.information_history import InformationHistory

FIGURES = figure_files("singular_values", "std_along_trial", "correlation", "directions", "shares")
# Files of the command; the first makes the folder valid.
OWNED = ("observability.json", "observability.csv", "history.csv", *FIGURES)


def to_json(view: Observability, source: str) -> bytes:
    """Return `observability.json`: strict JSON, with null for unknown values.

    Parameters
    ----------
    view : Observability
        Observability to write.
    source : str
        Folder of the trial or solution.
    """
    return encode({"format": 1, "source": source, **content(view)})


def encode(values: dict[str, Any]) -> bytes:
    """Return strict JSON, indented."""
    # msgspec writes nan and infinity as null.
    return msgspec.json.format(msgspec.json.encode(values), indent=2) + b"\n"


def content(view: Observability) -> dict[str, Any]:
    """Return the content of `observability.json`."""
    return {
        "trial": view.name,
        "kind": view.kind,
        "segments": [_segment(m) for m in view.segments],
        "singular_values": None if view.point_set is None else _point_set(view.point_set),
        "marginals": None if view.marginals is None else _marginals(view.marginals),
        "shares": None
        if view.shares is None
        else {
            "components": view.shares.names,
            "prior": view.shares.prior.tolist(),
            "segments": view.shares.segments.tolist(),
        },
        "along_the_trial": None if view.history is None else "history.csv",
        "missing": view.missing,
        "warnings": view.warnings,
    }


def to_csv(view: Observability) -> str:
    """Return `observability.csv`: a row for each component; empty = unknown."""
    shares = view.shares
    parts = [f"share_{i + 1}" for i in range(len(view.segments))] if shares else []
    out = io.StringIO()
    fixed = ("component", "unit", "value", "prior_std", "std", "std_over_prior", "observable")
    writer = csv.DictWriter(
        out, (*fixed, *(["share_prior", *parts] if shares else ())), lineterminator="\n"
    )
    writer.writeheader()
    if view.marginals is None:
        return out.getvalue()
    m = view.marginals
    for i, name in enumerate(m.names):
        row: dict[str, Any] = dict(
            zip(
                fixed,
                (
                    name,
                    split_unit(name)[1],
                    float(m.value[i]),
                    float(m.prior_std[i]),
                    float(m.std[i]),
                    float(m.ratio[i]),
                    bool(m.observable[i]),
                ),
                strict=True,
            )
        )
        if shares and name in shares.names:
            k = shares.names.index(name)
            row["share_prior"] = float(shares.prior[k])
            row |= {p: float(v) for p, v in zip(parts, shares.segments[:, k], strict=True)}
        writer.writerow({k: "" if v != v else v for k, v in row.items()})
    return out.getvalue()


def history_columns(history: InformationHistory) -> dict[str, Array]:
    """Return the columns of `history.csv`: σ of each constant, given the data up to a time."""
    std = history.std
    columns = {"time_s": history.time}
    return columns | {f"{name}_std": std[:, i] for i, name in enumerate(history.names)}


def _segment(m: SegmentMotion) -> dict[str, Any]:
    return {
        "start_s": m.segment.start,
        "end_s": m.segment.end,
        "label": m.segment.label,
        "mean_speed_m_s": m.speed,
        "turn_deg": m.turn / DEG,
        "rms_rate_deg_s": (m.rates / DEG).tolist(),
    }


def _point_set(p: PointSet) -> dict[str, Any]:
    return {
        "states": p.states,
        "scaling": p.scaling,
        "scale": p.scale.tolist(),
        "observable_from": float(OBSERVABLE),
        "segments": [_stack(s) for s in p.segments],
        "cumulative": [_stack(s) for s in p.cumulative],
    }


def _stack(s: SingularValues) -> dict[str, Any]:
    return {
        "start_s": s.segment.start,
        "end_s": s.segment.end,
        "label": s.segment.label,
        "pings": s.pings,
        "observed_directions": int(np.sum(s.observed)),
        "values": s.values.tolist(),
        "directions": [
            {
                "dominant": s.dominant(i),
                "vector": s.directions[i].tolist(),
                "observed": bool(s.observed[i]),
                "spurious_share": float(s.spurious[i]),
            }
            for i in range(s.values.size)
        ],
    }


def _marginals(m: Marginals) -> dict[str, Any]:
    return {
        "components": {
            name: {
                "value": float(m.value[i]),
                "std": float(m.std[i]),
                "prior_std": float(m.prior_std[i]),
                "std_over_prior": float(m.ratio[i]),
                "observable": bool(m.observable[i]),
                "grade": m.grade[i],
            }
            for i, name in enumerate(m.names)
        },
        "correlation": {"order": m.names, "matrix": m.correlation.tolist()},
        "directions": [_direction(d) for d in m.directions],
        "sentences": list(map(text_of, m.sentences)),
    }


def _direction(d: Direction) -> dict[str, Any]:
    return {
        "std_over_prior": d.ratio,
        "information_over_prior": d.information,
        "dominant": d.names,
        "vector": d.vector.tolist(),
    }
