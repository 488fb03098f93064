"""Move modules to their new places and rewrite what names them.

Run once from the root of the repository: `python scripts/move_modules.py`.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from pathlib import Path

PACKAGE = "factorgraph_dvl"
ROOT = Path(__file__).parent.parent

# Dotted names below the package: where a module was, where it goes.
MOVES = {
    # geometry
    "earth": "geometry.earth",
    "celestial": "geometry.celestial",
    "directions": "geometry.unit_vectors",
    "conventions": "geometry.rotations",
    # settings
    "yaml_file": "settings.yaml_file",
    "simulation.convert": "settings.convert",
    "files": "settings.files",
    "ranges": "settings.ranges",
    # sensors
    "gains": "sensors.beam_model",
    "turning": "sensors.turntable_motion",
    "beam_geometry": "sensors.beam_geometry",
    "fingerprint": "sensors.fingerprint",
    "sensors.log": "sensors.speed_log",
    # imu
    "clock": "imu.timestamps",
    "polynomials": "imu.polynomials",
    "signals": "imu.interpolation",
    "increments": "imu.increments",
    "preintegration": "imu.preintegration",
    "attitude": "imu.attitude_history",
    # io
    "io.foreign": "io.external_results",
    # baselines
    "kalman.__init__": "baselines.__init__",
    "kalman.beams": "baselines.beams",
    "kalman.coarse_alignment": "baselines.coarse_alignment",
    "kalman.feigned": "baselines.spurious_information",
    "kalman.least_squares": "baselines.least_squares",
    "kalman.navigation": "baselines.navigation",
    "kalman.nine_state": "baselines.nine_state",
    "kalman.point_set": "baselines.point_set_filter",
    "kalman.points": "baselines.point_sets",
    "kalman.run": "baselines.calibration",
    "kalman.single_beacon": "baselines.single_beacon",
    "kalman.sins": "baselines.ins_attitude",
    "kalman.sins_gnss": "baselines.ins_gnss",
    "kalman.star": "baselines.star_filter",
    "kalman.star_run": "baselines.star_calibration",
    "kalman.steps": "baselines.strapdown",
    "kalman.summary": "baselines.summary",
    "kalman.wahba": "baselines.wahba",
    # ranging
    "planar.__init__": "ranging.__init__",
    "planar.elimination": "ranging.elimination",
    "planar.evidence": "ranging.hypothesis_weights",
    "planar.hypotheses": "ranging.hypotheses",
    "planar.model": "ranging.model",
    "planar.problem": "ranging.problem",
    "planar.ridge": "ranging.weakest_direction",
    "planar.search": "ranging.search",
    "planar.smoother": "ranging.smoother",
    "planar.solve": "ranging.planar_solution",
    "planar.track": "ranging.reckoned_track",
    "planar.sanity": "quality.plausibility_planar",
    "anchoring": "ranging.position_from_ranges",
    # initialization
    "alignment": "initialization.in_motion_alignment",
    "attitude_alignment": "initialization.attitude_sensors",
    "mounting": "initialization.dvl_mounting",
    "arcs": "initialization.dead_reckoned_spans",
    # graph
    "keys": "graph.keys",
    "chain": "graph.inertial_chain",
    "priors": "graph.priors",
    "graph": "graph.problem",
    "replay.factor": "graph.sensor_factor",
    # statistics
    "information": "statistics.information_history",
    "solvers.feigned": "statistics.spurious_information",
    "analysis.consistency": "analysis.error_statistics",
    # solvers
    "solvers.covariance": "solvers.posterior",
    # quality
    "analysis.finding": "quality.finding",
    "analysis.sanity": "quality.plausibility",
    "analysis.beam_sanity": "quality.plausibility_beams",
    "analysis.star_sanity": "quality.plausibility_star",
    "analysis.records": "quality.records",
    "analysis.survey": "quality.survey",
    "analysis.planar_survey": "quality.survey_planar",
    # analysis
    "analysis.crosscheck": "analysis.comparison.crosscheck",
    "analysis.calibration_difference": "analysis.comparison.calibration_difference",
    "analysis.motion_difference": "analysis.comparison.motion_difference",
    "analysis.explanation": "analysis.comparison.explanation",
    "analysis.observability": "analysis.information.observability",
    "analysis.pwcs": "analysis.information.segment_singular_values",
    "analysis.point_set": "analysis.information.linearization",
    "analysis.marginals": "analysis.information.marginals",
    "analysis.information_shares": "analysis.information.shares",
    "analysis.manoeuvres": "analysis.information.manoeuvres",
    "analysis.dead_reckoning": "analysis.dead_reckoning.integration",
    "analysis.before_after": "analysis.dead_reckoning.before_after",
    "analysis.track_score": "analysis.dead_reckoning.track_error",
    "analysis.instrument": "analysis.instrument_terms",
    # report
    "report.beam_figures": "report.figures.beams",
    "report.calibration_figures": "report.figures.calibration",
    "report.convergence_figures": "report.figures.convergence",
    "report.crosscheck_figures": "report.figures.crosscheck",
    "report.dead_reckoning_figures": "report.figures.dead_reckoning",
    "report.observability_figures": "report.figures.observability",
    "report.residual_figures": "report.figures.residuals",
    "report.trajectory_figures": "report.figures.trajectory",
    "report.drawing": "report.figures.drawing",
    "report.figures": "report.figures.solution",
    "report.convergence_file": "report.files.convergence",
    "report.crosscheck_files": "report.files.crosscheck",
    "report.dead_reckoning_files": "report.files.dead_reckoning",
    "report.observability_files": "report.files.observability",
    "report.plan_files": "report.files.plan",
    "report.instrument_text": "report.files.instrument",
    "report.crosscheck_tables": "report.terminal.crosscheck",
    "report.observability_tables": "report.terminal.observability",
    "report.tables": "report.terminal.tables",
    "report.live": "report.terminal.live",
}
# Test modules go beside what they test, without `test_` and `.py`.
TESTS = {
    "alignment": "initialization/in_motion_alignment",
    "batch": "solvers/batch",
    "beacon": "sensors/beacon",
    "beacon_dive": "trials/beacon_dive",
    "beam_monte_carlo": "trials/beam_monte_carlo",
    "beams": "sensors/dvl_beams",
    "cli": "cli/app",
    "consistency": "analysis/error_statistics",
    "covariance": "solvers/posterior",
    "crosscheck": "analysis/comparison/crosscheck",
    "dead_reckoning": "analysis/dead_reckoning/before_after",
    "depth": "sensors/depth",
    "dive": "trials/dive",
    "edges": "trials/edges",
    "examples": "docs/examples",
    "figures": "report/figures/solution",
    "benchmarks": "docs/benchmarks",
    "documents": "docs/documents",
    "fingerprint": "sensors/fingerprint",
    "fuzz": "io/fuzz",
    "ranges": "settings/ranges",
    "streams": "cli/streams",
    "outputs": "io/folders",
    "plausibility": "cli/plausibility",
    "replay_clocks": "replay/clock_rates",
    "graph": "graph/problem",
    "increments": "imu/increments",
    "information_history": "solvers/information_history",
    "instrument": "analysis/instrument_terms",
    "joint_prior": "graph/priors",
    "kalman": "baselines/calibration",
    "manoeuvres": "analysis/information/manoeuvres",
    "marginals": "analysis/information/marginals",
    "monte_carlo": "trials/monte_carlo",
    "mounting": "initialization/dvl_mounting",
    "observability_command": "cli/observability",
    "observations": "sensors/velocities",
    "plan": "planning/prediction",
    "plan_monte_carlo": "trials/plan_monte_carlo",
    "planar": "ranging/planar_solution",
    "point_set": "analysis/information/linearization",
    "preintegration": "imu/preintegration",
    "pwcs": "analysis/information/segment_singular_values",
    "real_data": "trials/real_data",
    "replay": "replay/session",
    "replay_monte_carlo": "trials/replay_monte_carlo",
    "replay_parts": "replay/parts",
    "replay_sensors": "replay/sensors",
    "simulate": "simulation/measurements",
    "solution_folder": "io/solution_folder",
    "star": "sensors/star",
    "survey": "quality/survey",
    "tables": "report/terminal/tables",
    "trial_folder": "io/trial_folder",
    "yaml_file": "settings/yaml_file",
}
# Names that leave their module for one that only they make.
UNITS = (
    *("DEG", "HOUR", "DEG_PER_HOUR", "DEG_PER_SQRT_HOUR", "STANDARD_GRAVITY", "MICRO_G"),
    "GEODETIC_SI",
)
VECTORS = ("Array", "skew", "cross", "rotate")
NAMES = {("conventions", name): "geometry.units" for name in UNITS}
NAMES |= {("conventions", name): "geometry.vectors" for name in VECTORS}

# Names with several homes, or of no one's field: where a name is defined, what it becomes.
RENAMED = {
    ("kalman.coarse_alignment", "Attitude"): "CoarseAttitude",
    ("attitude", "Attitude"): "AttitudeHistory",
    ("replay.estimate", "Calibration"): "CalibrationEstimate",
    ("planar.model", "Evaluation"): "RangingEvaluation",
    ("kalman.star", "Filtered"): "FilteredDrift",
    ("kalman.star", "Course"): "AttitudeTrack",
    ("kalman.star", "Seen"): "StarAttitudes",
    ("kalman.star", "seen_by_stars"): "star_attitudes",
    ("simulation.instruments", "Instrument"): "SimulatedInstrument",
    ("analysis.instrument", "Instrument"): "InstrumentTerms",
    ("kalman.navigation", "Motion"): "NavigationMotion",
    ("simulation.motion", "Motion"): "TrueMotion",
    ("simulation.motion", "State"): "TrueState",
    ("analysis.pwcs", "Mounting"): "MountingModel",
    ("analysis.dead_reckoning", "Mounting"): "DvlMounting",
    ("analysis.dead_reckoning", "Track"): "DeadReckonedTrack",
    ("planar.problem", "Plan"): "RangingTrial",
    ("planar.track", "Track"): "ReckonedTrack",
    ("replay.recorded", "Record"): "ReplayRecord",
    ("replay", "Record"): "ReplayRecord",
    ("sensors.protocol", "Record"): "SensorRecord",
    ("kalman.steps", "Samples"): "StrapdownSamples",
    ("replay.samples", "Samples"): "SampleBuffer",
    ("cli.replay", "Smoother"): "SmootherKind",
    ("replay.start", "Start"): "ReplayStart",
    ("simulation.scenario", "Start"): "StartSettings",
    ("alignment", "Start"): "AlignedStates",
    ("kalman.sins_gnss", "State"): "FilterState",
    ("kalman.sins_gnss", "Track"): "FilteredTrack",
    ("priors", "pull"): "linear_prior",
    ("priors", "joint_pull"): "joint_linear_prior",
    ("priors", "away"): "local_coordinates",
    ("preintegration", "slid"): "extrapolated",
    ("anchoring", "anchored"): "positions_from_ranges",
    ("anchoring", "Anchors"): "StartPositions",
    ("arcs", "Arc"): "DeadReckonedSpan",
    ("signals", "as_it_is"): "unsmoothed",
    ("solution", "doubts"): "consistency_warnings",
    ("turning", "Turning"): "TurntableMotion",
    ("planar.sanity", "implausible"): "planar_findings",
}
# Names that mean one thing wherever they stand, also after a dot.
EVERYWHERE = {
    "told_of": "data_information",
    "Told": "DataInformation",
    "directions_not_told": "undetermined_directions",
    "not_told": "undetermined",
    "_not_told": "_undetermined",
    "feigned_information": "spurious_information",
    "feigned": "spurious",
    "_feigned": "_spurious",
    "_feigned_at": "_spurious_at",
    "largest_feigned_share": "largest_spurious_share",
    "feigned_by": "spurious_by",
    "without_feigned": "without_spurious_information",
    "without_feigned_beams": "without_spurious_information_of_beams",
    "_FEIGNED_EVERY": "_SPURIOUS_EVERY",
    "FEIGNED": "SPURIOUS",
    "strayed": "needs_rebinding",
    "misweighed": "needs_reweighting",
    "doubts": "consistency_warnings",
    "anchors": "start_positions",
    "HELD_DIRECTION": "FIXED_DIRECTION_STD",
    "lean": "bias_jacobian",
}

# Functions that a package offers under the name of the module which defines them.
FUNCTIONS = ("kalman.sins",)

WORD = re.compile(rf"\b{PACKAGE}((?:\.\w+)+)")


def module_path(dotted: str) -> Path:
    return ROOT / PACKAGE / (dotted.replace(".", "/") + ".py")


def is_module(dotted: str) -> bool:
    return dotted in MOVES or f"{dotted}.__init__" in MOVES


def new_name(dotted: str) -> str:
    return MOVES.get(dotted) or MOVES.get(f"{dotted}.__init__", dotted + ".__init__").removesuffix(
        ".__init__"
    )


def moved_text(match: re.Match[str]) -> str:
    """Rewrite a dotted name in a string or in prose by its longest part that moved."""
    parts = match.group(1)[1:].split(".")
    for size in range(len(parts), 0, -1):
        head = ".".join(parts[:size])
        if size < len(parts) and (head, parts[size]) in NAMES:
            return ".".join([PACKAGE, NAMES[head, parts[size]], *parts[size:]])
        if is_module(head):
            return ".".join([PACKAGE, new_name(head), *parts[size:]])
    return match.group(0)


def rewritten_import(node: ast.ImportFrom) -> str | None:
    """Return new statements for an import of the package's, None if nothing changes."""
    if not node.module or not node.module.split(".")[0] == PACKAGE:
        return None
    source = node.module.removeprefix(PACKAGE).removeprefix(".")
    out: dict[str, list[str]] = {}
    for alias in node.names:
        whole = f"{source}.{alias.name}".removeprefix(".")
        name, target = alias.name, source
        if is_module(whole) and whole not in FUNCTIONS:
            target, _, leaf = new_name(whole).rpartition(".")
            if leaf != name and alias.asname is None:
                print(f"  module {name} is now {leaf}: rename its uses")
            name = leaf
        elif (source, alias.name) in NAMES:
            target = NAMES[source, alias.name]
        elif is_module(source):
            target = new_name(source)
        name = RENAMED.get((source, alias.name), name)
        name = EVERYWHERE.get(name, name)
        asname = EVERYWHERE.get(alias.asname or "", alias.asname)
        written = f"{name} as {asname}" if asname else name
        out.setdefault(f"{PACKAGE}.{target}".rstrip("."), []).append(written)
    return "\n".join(f"from {module} import {', '.join(names)}" for module, names in out.items())


def renames_in(path: Path, tree: ast.Module) -> dict[str, str]:
    """Return the names of a file that change: what it defines or imports."""
    own = ".".join(path.relative_to(ROOT).with_suffix("").parts).removeprefix(f"{PACKAGE}.")
    out = {old: new for (module, old), new in RENAMED.items() if module == own}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(PACKAGE):
            source = node.module.removeprefix(PACKAGE).removeprefix(".")
            for alias in node.names:
                new = RENAMED.get((source, alias.name))
                if new and alias.asname is None:
                    out[alias.name] = new
    return out


def renamed_tokens(text: str, own: dict[str, str]) -> str:
    """Rewrite names, and what comments and docstrings put between backticks."""
    offsets = [0]
    for line in text.split("\n"):
        offsets.append(offsets[-1] + len(line) + 1)
    edits = []
    imports = {
        row
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE)
        for row in range(node.lineno, node.end_lineno + 1)
    }
    before = ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        start = offsets[token.start[0] - 1] + token.start[1]
        end = offsets[token.end[0] - 1] + token.end[1]
        new = token.string
        if token.type == tokenize.NAME:
            if token.start[0] not in imports:
                fallback = new if before == "." else own.get(new, new)
                new = EVERYWHERE.get(new, fallback)
        elif token.type == tokenize.COMMENT:
            new = ticked(new, own)
        elif token.type == tokenize.STRING:
            new = in_string(ticked(new, own), own)
        if new != token.string:
            edits.append((start, end, new))
        before = token.string
    for start, end, new in reversed(edits):
        text = text[:start] + new + text[end:]
    return text


def ticked(text: str, own: dict[str, str]) -> str:
    for old, new in {**own, **EVERYWHERE}.items():
        text = re.sub(rf"`((?:\w+\.)*){old}`", rf"`\1{new}`", text)
    return text


def in_string(text: str, own: dict[str, str]) -> str:
    """Rewrite names in the braces of an f-string, in parameter sections and in `__all__`."""
    names = {**own, **EVERYWHERE}
    word = re.compile(r"(?<![.\w])(" + "|".join(map(re.escape, names)) + r")\b")

    def swap(match: re.Match[str]) -> str:
        return word.sub(lambda m: names[m.group(1)], match.group(0))

    if text[1:-1] in names:
        return text[0] + names[text[1:-1]] + text[-1]
    if text.startswith("f"):
        return re.sub(r"\{[^{}]*\}", swap, text)
    if text.startswith('"""'):
        return re.sub(r"(?m)^ +\w+(?:, \w+)* :", swap, text)
    return text


def rewrite_python(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    text = renamed_tokens(text, renames_in(path, ast.parse(text)))
    lines = text.split("\n")
    imports = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            imports.append(node)
    inside = set()
    edits = []
    for node in imports:
        inside.update(range(node.lineno, node.end_lineno + 1))
        new = rewritten_import(node)
        if new is not None:
            edits.append((node.lineno, node.end_lineno, node.col_offset, new))
    for i, line in enumerate(lines, 1):
        if i not in inside:
            lines[i - 1] = WORD.sub(moved_text, line)
    for first, last, indent, new in sorted(edits, reverse=True):
        lines[first - 1 : last] = [" " * indent + part for part in new.split("\n")]
    path.write_text("\n".join(lines), encoding="utf-8")


def split_conventions() -> None:
    """Divide the old module of conventions into units, vectors and rotations."""
    path = module_path("conventions")
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    lines = text.split("\n")
    parts: dict[str, list[str]] = {"units": [], "vectors": [], "rotations": []}
    at = None
    for node in tree.body:
        if isinstance(node, (ast.Import, ast.ImportFrom)) or (
            at is None and isinstance(node, ast.Expr)
        ):
            at = node.end_lineno
            continue
        name = getattr(node, "name", None)
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            name = target.id
        home = "units" if name in UNITS else "vectors" if name in VECTORS else "rotations"
        chunk = "\n".join(lines[at : node.end_lineno])
        parts[home].append(chunk)
        at = node.end_lineno
    heads = {
        "units": '"""Units of files and people in SI."""\n\nfrom __future__ import annotations\n\nimport numpy as np\n',
        "vectors": '"""Vectors in arrays: products of many at once."""\n\nfrom __future__ import annotations\n\n'
        "import numpy as np\nfrom numpy.typing import ArrayLike, NDArray\n",
        "rotations": '"""Rotations: exponential map, Euler angles, body axes."""\n\nfrom __future__ import annotations\n\n'
        "from typing import Literal, TypeVar\n\nimport numpy as np\nfrom numpy.typing import ArrayLike\n"
        "from scipy.spatial.transform import Rotation\n\n"
        f"from {PACKAGE}.geometry.vectors import Array, skew\nfrom {PACKAGE}.geometry.units import DEG\n",
    }
    folder = ROOT / PACKAGE / "geometry"
    for name in ("units", "vectors"):
        (folder / f"{name}.py").write_text(
            heads[name] + "\n".join(parts[name]) + "\n", encoding="utf-8"
        )
    path.write_text(heads["rotations"] + "\n".join(parts["rotations"]) + "\n", encoding="utf-8")


def main() -> None:
    files = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    python = [ROOT / f for f in files if f.endswith(".py") and Path(f).name != Path(__file__).name]
    for path in python:
        rewrite_python(path)
    for name in files:
        if name.endswith((".md", ".toml", ".yaml")) or name == ".ci/run":
            path = ROOT / name
            text = path.read_text(encoding="utf-8")
            path.write_text(WORD.sub(moved_text, text), encoding="utf-8")
    for target in MOVES.values():
        folder = module_path(target).parent
        while folder != ROOT / PACKAGE:
            folder.mkdir(parents=True, exist_ok=True)
            folder = folder.parent
    split_conventions()
    # First everything aside, so that a name which is both old and new does not matter.
    for old in MOVES:
        subprocess.run(
            ["git", "mv", module_path(old), f"{module_path(old)}.moving"], cwd=ROOT, check=True
        )
    for old, new in MOVES.items():
        subprocess.run(
            ["git", "mv", f"{module_path(old)}.moving", module_path(new)], cwd=ROOT, check=True
        )
    for old, new in TESTS.items():
        move_test(old, new)
    for folder in sorted({module_path(n).parent for n in MOVES.values()}):
        face = folder / "__init__.py"
        if not face.exists() and folder != ROOT / PACKAGE:
            face.write_text(f'"""{FACES[folder.name]}"""\n', encoding="utf-8")


def move_test(old: str, new: str) -> None:
    """Move a test module, and mend the paths that start from its own."""
    path = ROOT / "tests" / f"test_{old}.py"
    folder, _, name = new.rpartition("/")
    if not path.exists():
        print(f"  there is no {path}")
        return
    deeper = len(Path(folder).parts)

    def mended(match: re.Match[str]) -> str:
        up = int(match.group(3)) if match.group(3) else match.group(2).count(".parent") - 1
        return f"Path(__file__).resolve().parents[{up + deeper}]"

    text = path.read_text(encoding="utf-8")
    pattern = r"Path\(__file__\)(\.resolve\(\))?((?:\.parent(?!s))+|\.parents\[(\d)\])"
    path.write_text(re.sub(pattern, mended, text), encoding="utf-8")
    target = ROOT / "tests" / folder / f"test_{name}.py"
    target.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(["git", "mv", path, target], cwd=ROOT, check=True)


FACES = {
    "geometry": "Units, vectors, rotations, the Earth and the sky.",
    "settings": "YAML files as typed settings.",
    "sensors": "One module per sensor: its settings, its record, its parameters and its equation.",
    "imu": "Samples of the IMU to increments, preintegrated segments and motion at any time.",
    "ranging": "Position from ranges to beacons.",
    "initialization": "Start values from the data alone.",
    "graph": "A trial as a factor graph.",
    "statistics": "What residuals and information say of an estimate.",
    "quality": "What is wrong with a trial, before and after it is solved.",
    "comparison": "Two results of one trial against each other and against the truth.",
    "information": "What the data of a trial can determine.",
    "dead_reckoning": "What a calibration is worth in dead reckoning.",
    "figures": "Figures, as files.",
    "files": "Results as JSON, CSV and YAML.",
    "terminal": "Results as tables and lines for the terminal.",
    "io": "Files to trials and solutions, and back.",
    "analysis": "What trials and solutions say.",
    "solvers": "Minimisation, covariance and summary.",
    "report": "Rendering of results.",
    "baselines": "",
}

if __name__ == "__main__":
    main()
