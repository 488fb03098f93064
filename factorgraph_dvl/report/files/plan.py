"""The prediction of a plan as JSON, table and lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from factorgraph_dvl.planning.proposal import Proposal
from factorgraph_dvl.planning.requirements import Requirement
from factorgraph_dvl.quality.notation import split_unit
from factorgraph_dvl.report.files.observability import OWNED as OF_THE_VIEW
from factorgraph_dvl.report.files.observability import encode
from factorgraph_dvl.report.table import Cell, Mark, Table
from factorgraph_dvl.solution import Solution

# Files of the command; the first makes the folder valid.
OWNED = ("plan.json", *OF_THE_VIEW)


def to_json(
    solution: Solution,
    duration: float,
    required: Sequence[Requirement],
    proposal: Proposal | None,
    source: str,
) -> bytes:
    """Return `plan.json`.

    Parameters
    ----------
    solution : Solution
        Predicted solution.
    duration : float
        Duration of the plan, s.
    required : sequence of Requirement
        Requirements of the plan.
    proposal : Proposal or None
        Proposed addition; None if all requirements are met.
    source : str
        File of the plan.
    """
    return encode(
        {
            "format": 1,
            "source": source,
            "plan": solution.trial,
            "duration_s": duration,
            "predicted": {
                name: {
                    "std": float(e.std[i]),
                    "prior_std": float(e.prior_std[i]),
                    "observable": bool(e.observable[i]),
                    "grade": solution.grades[e.name][i],
                }
                for e in solution.estimates
                for i, name in enumerate(e.component_names)
            },
            "error_budget": [
                {
                    "cause": c.cause,
                    "assumed": c.assumed,
                    "adds": dict(zip(solution.order, c.adds.tolist(), strict=True)),
                }
                for c in solution.error_budget
            ],
            "required": [_requirement(r) for r in required],
            "missed": [r.component for r in required if not r.met],
            "proposal": None if proposal is None else _proposal(proposal),
        }
    )


def _requirement(r: Requirement) -> dict[str, Any]:
    return {
        "component": r.component,
        "required_std": r.required,
        "predicted_std": r.predicted,
        "met": r.met,
    }


def _proposal(p: Proposal) -> dict[str, Any]:
    return {
        "met": p.met,
        "added_s": p.added,
        "names": p.names,
        "manoeuvres": p.manoeuvres,
        "required": [_requirement(r) for r in p.requirements],
        "missed": [r.component for r in p.missed],
        "sequences_tried": p.tried,
        "all_tried_up_to_s": p.limit,
        "shortest": p.shortest,
    }


def requirement_table(required: Sequence[Requirement], proposal: Proposal | None) -> Table:
    """Return a table of required against predicted σ, without and with the proposal."""
    table = Table(title="Requirements")
    table.column("component")
    table.column("unit")
    table.column("required σ", numeric=True)
    table.column("predicted σ", numeric=True)
    table.column("met")
    if proposal is not None:
        table.column("with the proposal", numeric=True)
        table.column("met")
    for i, r in enumerate(required):
        name, unit = split_unit(r.component)
        row: list[Cell] = [name, unit, f"{r.required:.3g}", f"{r.predicted:.3g}", _met(r)]
        if proposal is not None:
            after = proposal.requirements[i]
            row += [f"{after.predicted:.3g}", _met(after)]
        table.row(*row)
    return table


def proposal_lines(proposal: Proposal) -> list[str]:
    """Return the lines of a proposal: manoeuvres to add, as in a plan, or the best attempt."""
    tried = f"{proposal.tried} sequences were tried"
    if proposal.shortest:
        tried += ", including all shorter ones"
    else:
        tried += f", including all of up to {proposal.limit:.0f} s"
    if proposal.met and not proposal.shortest:
        tried += "; a shorter one may exist"
    if proposal.met:
        lines = [f"Add {proposal.added:.0f} s ({tried}): {', '.join(proposal.names)}."]
    else:
        missed = ", ".join(f"{r.component} ({r.predicted:.2g})" for r in proposal.missed)
        lines = [
            f"No sequence meets all requirements ({tried}). The best one, "
            f"{proposal.added:.0f} s of {', '.join(proposal.names)}, still misses: {missed}."
        ]
    return lines + [f"  - {_as_yaml(m)}" for m in proposal.manoeuvres]


def _as_yaml(manoeuvre: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{key}: {value:g}" for key, value in manoeuvre.items()) + "}"


def _met(r: Requirement) -> Mark:
    return Mark("yes", "green") if r.met else Mark("no", "yellow")
