"""Lines of the package by capability, before it was laid out anew and now.

`python tests/lines_per_capability.py` writes the table to CONTRIBUTING.md. Lines are those of
code: neither blank, nor comment, nor docstring.
"""

from __future__ import annotations

import ast
import io
import subprocess
import tarfile
import tokenize
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NAME = "factorgraph_dvl"
DOCUMENT = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- lines: begin -->", "<!-- lines: end -->"
# The last commit before the package was laid out anew.
BEFORE = "daba728"
# Capability, where it stood, where it stands, and which of that does what could not be done
# before. The first pattern that fits counts.
CAPABILITIES = (
    (
        "units, rotations, Earth, settings, trial, solution",
        "conventions celestial directions earth errors solution trial yaml_file __init__",
        "geometry/* settings/* errors message estimates solution trial __init__",
        "settings/ranges settings/files",
    ),
    (
        "sensors: settings, records, residuals",
        "sensors/* beam_geometry gains turning",
        "sensors/*",
        "sensors/ins sensors/attitude sensors/fingerprint sensors/clock",
    ),
    (
        "IMU: increments, preintegration, motion at any time",
        "increments polynomials preintegration attitude clock signals",
        "imu/*",
        "imu/noise imu/sensitivity imu/attitude_record*",
    ),
    (
        "start values",
        "alignment arcs attitude_alignment mounting",
        "initialization/*",
        "initialization/*_windows initialization/clock_offsets initialization/track_* "
        "initialization/record_clocks",
    ),
    (
        "factor graph, batch solver, covariance",
        "graph chain keys priors information solvers/*",
        "graph/* solvers/* statistics/*",
        "graph/imu_errors graph/clocks graph/processes graph/native_graph "
        "graph/smooth_* "
        "statistics/correlation statistics/constancy solvers/change_along_trial "
        "solvers/correlated_noise solvers/known_parameters solvers/motion_* "
        "solvers/preparation_without_imu "
        "statistics/robust_weights statistics/rows statistics/scores "
        "statistics/variance_components solvers/error_budget solvers/minima solvers/outliers",
    ),
    (
        "position from ranges, planar trials",
        "anchoring planar/*",
        "ranging/* plausibility/*planar*",
        "",
    ),
    ("replay", "replay/*", "replay/*", ""),
    ("plans", "planning/*", "planning/*", ""),
    (
        "Kalman baselines",
        "kalman/*",
        "baselines/*",
        "baselines/liu_2020 baselines/luo_2024",
    ),
    (
        "simulation",
        "simulation/*",
        "simulation/*",
        "simulation/faults simulation/stated_errors simulation/size simulation/compass",
    ),
    (
        "trial and solution folders",
        "io/*",
        "files/*",
        "files/formats/* files/importing/* files/exporting/* files/data_frames "
        "files/run_file files/residual_table files/earlier_calibration",
    ),
    (
        "plausibility of records",
        "analysis/*sanity analysis/records analysis/*survey analysis/finding",
        "quality/* plausibility/*",
        "quality/* plausibility/consistency plausibility/axes plausibility/clocks "
        "plausibility/earlier_calibration",
    ),
    (
        "analyses",
        "analysis/*",
        "analysis/*",
        "analysis/static_noise analysis/information/further_manoeuvres analysis/comparison/halves",
    ),
    ("campaigns of trials", "", "campaign/*", "campaign/*"),
    (
        "figures, tables, result files",
        "report/*",
        "report/*",
        "report/*static_noise report/*imu_noise report/*error_budget report/*campaign* "
        "report/html/* report/overview",
    ),
    (
        "command line",
        "cli/*",
        "cli/*",
        "cli/allan cli/import_files cli/reproduce cli/campaign* cli/events cli/export cli/report "
        "cli/verdict",
    ),
    ("publications, measured", "", "reproduce/*", "reproduce/*"),
)


def code_lines(source: str) -> int:
    """Return how many lines of a module hold code."""
    held: set[int] = set()
    skip = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in skip and token.type != tokenize.ENDMARKER:
            held |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node, clean=False
        ):
            text = node.body[0]
            held -= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    return len(held)


def modules_before() -> dict[str, str]:
    """Return the sources of the modules at the commit before, by path without suffix."""
    packed = subprocess.run(
        ["git", "archive", BEFORE, NAME], cwd=ROOT, capture_output=True, check=True
    ).stdout
    out = {}
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        for member in archive.getmembers():
            file = archive.extractfile(member) if member.name.endswith(".py") else None
            if file is not None:
                name = member.name.removeprefix(f"{NAME}/").removesuffix(".py")
                out[name] = file.read().decode()
    return out


def modules_now() -> dict[str, str]:
    """Return the sources of the modules of the tree, by path without suffix."""
    folder = ROOT / NAME
    return {
        path.relative_to(folder).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(folder.rglob("*.py"))
    }


def fits(name: str, patterns: str) -> bool:
    """Whether a module is one of those that patterns describe."""
    return any(fnmatch(name, pattern) for pattern in patterns.split())


def capability_of(name: str, column: int) -> str:
    """Return which capability a module belongs to, by the column of patterns."""
    for entry in CAPABILITIES:
        if fits(name, entry[column]):
            return entry[0]
    raise LookupError(f"{name} belongs to no capability of tests/lines_per_capability.py")


def drawn() -> str:
    """Return the table as it should be."""
    before, same, new = Counter[str](), Counter[str](), Counter[str]()
    for name, source in modules_before().items():
        before[capability_of(name, 1)] += code_lines(source)
    additions = {entry[0]: entry[3] for entry in CAPABILITIES}
    for name, source in modules_now().items():
        capability = capability_of(name, 2)
        column = new if fits(name, additions[capability]) else same
        column[capability] += code_lines(source)
    lines = [
        BEGIN,
        "",
        f"| capability | before (`{BEFORE}`) | now, same functions | now, new functions |",
        "|---|---:|---:|---:|",
    ]
    for entry in CAPABILITIES:
        counts = (column[entry[0]] for column in (before, same, new))
        lines.append(f"| {entry[0]} | {' | '.join(f'{n:,}' if n else '–' for n in counts)} |")
    totals = (sum(column.values()) for column in (before, same, new))
    lines.append(f"| all | {' | '.join(f'{n:,}' for n in totals)} |")
    return "\n".join([*lines, "", END])


def written() -> str:
    """Return the table as it stands in the document."""
    text = DOCUMENT.read_text(encoding="utf-8")
    return text[text.index(BEGIN) : text.index(END) + len(END)]


if __name__ == "__main__":
    text = DOCUMENT.read_text(encoding="utf-8")
    DOCUMENT.write_text(text.replace(written(), drawn()), encoding="utf-8")
