"""Imports go down the layers only, never up: the order is stated here, as data."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import factorgraph_dvl
from factorgraph_dvl.sensors.catalogue import AIDS
from factorgraph_dvl.sensors.imu import Imu

PACKAGE = Path(factorgraph_dvl.__file__).parent

# Each line may import from the lines before it, and from its own line only within one
# package. `a.b` stands for a module or a whole package.
LAYERS = (
    ("conventions", "errors"),
    ("files", "ranges"),
    ("earth", "celestial", "yaml_file", "directions", "turning"),
    ("gains",),
    ("sensors",),
    ("beam_geometry", "fingerprint"),
    ("trial", "solution", "information"),
    ("io", "simulation"),
    ("clock", "polynomials", "signals"),
    ("increments",),
    ("kalman",),
    ("planar",),
    ("preintegration",),
    ("attitude",),
    ("keys",),
    ("chain",),
    ("priors",),
    ("arcs",),
    ("attitude_alignment",),
    ("alignment", "mounting", "anchoring"),
    ("graph",),
    ("solvers",),
    ("replay",),
    ("analysis",),
    ("planning",),
    ("report",),
    ("cli",),
)
# On top of the order: what must not know of each other.
FORBIDDEN = {
    "io": ("simulation", "increments"),
    "simulation": ("io", "increments", "preintegration", "graph", "solvers", "analysis"),
    "kalman": ("io", "simulation", "gains"),
    "solvers": ("io", "simulation", "analysis", "report"),
    "replay": ("io", "simulation", "analysis", "report"),
    "analysis": (
        *("replay", "solvers", "graph", "keys", "preintegration", "increments"),
        *("simulation", "io"),
    ),
    "planning": ("kalman", "io", "replay"),
    "report": ("replay", "solvers", "graph", "keys", "preintegration", "simulation", "io"),
    "alignment": ("mounting", "anchoring", "graph", "keys"),
    "anchoring": ("alignment", "mounting", "graph", "keys", "kalman"),
    "planar": (
        *("kalman", "io", "simulation", "clock", "polynomials", "signals", "increments"),
        "replay",
    ),
    "mounting": ("alignment", "graph", "keys", "preintegration"),
    "preintegration": ("keys",),
    "attitude": ("io", "simulation"),
    "information": ("sensors", "earth"),
}
# What is held against the factor graph shares nothing with it: the cross-check and all
# that would use it know only its solutions.
FORBIDDEN |= {
    name: (*FORBIDDEN.get(name, ()), "kalman")
    for name in (
        *("preintegration", "keys", "chain", "arcs", "attitude_alignment", "alignment"),
        *("mounting", "graph", "solvers", "replay", "attitude", "priors"),
        *("analysis", "report"),
    )
}
# Data classes of the sensors: no measurement equation is among them.
SENSOR_DATA = ("Imu", "ImuSettings", "Gnss", "Dvl", "Star", "Aid", "Parameter", "Motion")
# The graph asks every sensor through the protocol and knows none but the IMU by name.
NAMELESS = ("graph", "priors", "chain", "preintegration", "keys", "solvers", "replay")
# Only where they are used: GTSAM, SciPy and Matplotlib take most of a second to load.
LAZY_FOR_CLI = tuple(layer for line in LAYERS[2:-1] for layer in line)

LEVEL = {name: i for i, line in enumerate(LAYERS) for name in line}
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("").parts
    for path in PACKAGE.rglob("*.py")
    if path != PACKAGE / "__init__.py"
)


def read(parts):
    path = PACKAGE.joinpath(*parts).with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(tree):
    """Names within the package that a module imports, dotted, wherever in it."""
    out = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        out += [
            n.removeprefix("factorgraph_dvl.") for n in names if n.startswith("factorgraph_dvl.")
        ]
    return out


def layer_of(name):
    return name.split(".")[0]


def test_every_module_has_a_layer():
    assert {parts[0] for parts in MODULES} == set(LEVEL)


@pytest.mark.parametrize("parts", MODULES, ids=".".join)
def test_imports_go_down(parts):
    own = parts[0]
    for name in imported(read(parts)):
        other = layer_of(name)
        if other == "__version__":
            continue
        where = f"{'.'.join(parts)} imports {name}"
        assert other in LEVEL, where
        assert other == own or LEVEL[other] < LEVEL[own], where
        assert other not in FORBIDDEN.get(own, ()), where
        if own in NAMELESS and other == "sensors":
            assert name.startswith(("sensors.protocol.", "sensors.imu.")), where


def test_sensors_know_only_the_protocol():
    for parts in MODULES:
        if parts[0] == "sensors" and parts[1] != "catalogue":
            others = [n for n in imported(read(parts)) if layer_of(n) == "sensors"]
            assert all(n.startswith("sensors.protocol.") for n in others), parts


def test_simulation_takes_no_measurement_model_from_the_sensors():
    records = {kind.__name__ for kind in (Imu, *AIDS)}
    settings = {kind.section_type.__name__ for kind in (Imu, *AIDS)}
    plain = {
        "Aid",
        "BeaconPosition",
        "check_epoch",
        "Heading",
        "HeadingSettings",
        "LogSettings",
        "NonNegative",
        "Positive",
        "Section",
        "SensorSection",
        "Sigma3",
        "SpeedLog",
        "Vector3",
    }
    plain |= {"Depth", "DepthSettings"}
    for parts in MODULES:
        if parts[0] == "simulation":
            for name in imported(read(parts)):
                if name.startswith("sensors."):
                    last = name.rpartition(".")[2]
                    where = f"{'.'.join(parts)} imports {name}"
                    assert last in records | settings | plain | {"AIDS"}, where


def test_kalman_shares_no_measurement_equation_with_the_factors():
    for parts in MODULES:
        if parts[0] == "kalman":
            for name in imported(read(parts)):
                if name.startswith("sensors."):
                    assert name.endswith(SENSOR_DATA), f"{'.'.join(parts)} imports {name}"
            source = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
            assert "gtsam" not in source.lower(), parts


def test_nothing_but_the_command_line_imports_it():
    for parts in [*MODULES, ("__init__",)]:
        if parts[0] != "cli":
            assert "cli" not in map(layer_of, imported(read(parts))), parts


def test_the_command_line_and_the_package_load_lazily():
    for parts in [*(p for p in MODULES if p[0] == "cli"), ("__init__",)]:
        at_the_top = ast.Module(
            [node for node in read(parts).body if isinstance(node, (ast.Import, ast.ImportFrom))],
            [],
        )
        eager = set(map(layer_of, imported(at_the_top)))
        assert not eager & set(LAZY_FOR_CLI), parts


def test_only_keys_makes_symbols():
    for parts in MODULES:
        source = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
        if parts != ("keys",):
            assert "symbol" not in source.replace("no symbol", ""), parts
