"""The layout of the package: what may import what, and the map of it in CONTRIBUTING."""

from __future__ import annotations

import ast
import os
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import package_map
import pytest
from importlinter.cli import lint_imports

import factorgraph_dvl
from factorgraph_dvl.sensors.catalogue import AIDS
from factorgraph_dvl.sensors.imu import Imu

PACKAGE = Path(factorgraph_dvl.__file__).parent
ROOT = PACKAGE.parent
# Data classes of the sensors: no measurement equation is among them.
SENSOR_DATA = (
    *("Imu", "ImuSettings", "Gnss", "Ins", "Dvl", "Star", "Aid", "Motion"),
    *("Heading", "SpeedLog", "Depth", "Beacons"),
    *("Parameter", "SPEC"),
)
# GTSAM, SciPy and Matplotlib take most of a second to load: only what needs none of them may
# be imported where the command line starts.
LIGHT = ("errors", "settings", "cli")
# Each takes half a second to load; `scipy.special` has distributions, `imu.interpolation` filters.
SLOW_TO_LOAD = ("scipy.signal", "scipy.stats")
# What modules may take from `threading`: threads of a user's program may call them at once.
LOCKS = {"Lock", "RLock", "get_ident"}
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


def test_contracts_of_imports_are_kept(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports(config_filename="pyproject.toml", no_cache=True) == os.EX_OK


def importers_and_imported():
    """Yield modules with what each imports, wherever in it: also in functions, also for types.

    The public names of the package are left out: they are loaded when they are used.
    """
    names = {".".join(part for part in parts if part != "__init__") for parts in MODULES}
    for parts in MODULES:
        module = ".".join(part for part in parts if part != "__init__")
        for name in imported(read(parts)):
            target = name if name in names else name.rpartition(".")[0]
            if target in names and target != module:
                yield module, target


def test_imports_make_no_circle():
    for of in (lambda module: module, layer_of):
        graph = {}
        for module, target in importers_and_imported():
            if of(module) != of(target):
                graph.setdefault(of(module), set()).add(of(target))
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as circle:
            raise AssertionError(" -> ".join(circle.args[1])) from None


def test_a_circle_within_functions_would_be_seen():
    source = "def f():\n    from factorgraph_dvl.solution import Solution\n"
    assert imported(ast.parse(source)) == ["solution.Solution"]
    with pytest.raises(CycleError):
        TopologicalSorter({"solution": {"files"}, "files": {"solution"}}).prepare()


def test_no_import_goes_up():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    assert not any("ignore_imports" in contract for contract in contracts)
    (layers,) = (each["layers"] for each in contracts if each["type"] == "layers")
    floor = {name: number for number, names in enumerate(layers) for name in names.split(" | ")}
    wrong = [
        f"{module} imports {target}"
        for module, target in importers_and_imported()
        if layer_of(module) != layer_of(target)
        and floor[layer_of(module)] >= floor[layer_of(target)]
    ]
    assert not wrong, "\n".join(wrong)


def test_the_map_of_the_package_is_that_of_the_tree():
    assert package_map.written() == package_map.drawn(), "run python tests/package_map.py"


def test_the_top_holds_no_module_without_a_home():
    loose = {parts[0] for parts in MODULES if len(parts) == 1}
    assert loose == {"errors", "estimates", "message", "solution", "trial"}


def test_no_solver_loads_what_takes_longer_than_a_short_trial():
    for parts in MODULES:
        if parts[0] != "reproduce":
            text = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
            names = {
                node.module if isinstance(node, ast.ImportFrom) else alias.name
                for node in ast.walk(ast.parse(text))
                if isinstance(node, ast.Import | ast.ImportFrom)
                for alias in node.names
            }
            assert not names.intersection(SLOW_TO_LOAD), parts


def test_no_module_starts_threads_or_copies_of_its_process():
    """GTSAM, Arrow and BLAS bear neither well; C is called where Python has no call."""
    for parts in MODULES:
        source = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
        names = {
            layer_of(name)
            for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.Import | ast.ImportFrom)
            for name in (
                [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
            )
            if name != "threading" or not {a.name for a in node.names} <= LOCKS
        }
        assert not names & {"threading", "_thread", "multiprocessing", "concurrent"}, parts
        assert "ctypes" not in names or parts == ("files", "folders"), parts
        assert not any(word in source for word in ("fork(", "preexec_fn", "Executor(")), parts


def test_no_package_hides_a_public_function():
    packages = {part for parts in MODULES for part in parts[:-1]}
    assert not packages & set(factorgraph_dvl.__all__)


def test_simulation_takes_no_measurement_model_from_the_sensors():
    records = {kind.__name__ for kind in (Imu, *AIDS)}
    settings = {kind.section_type.__name__ for kind in (Imu, *AIDS)}
    plain = {
        "Aid",
        "BeaconPosition",
        "check_epoch",
        "NoiseModel",
        "NonNegative",
        "Positive",
        "Section",
        "SensorSection",
        "Sigma3",
        "Vector3",
    }
    plain |= {"Depth", "DepthSettings", "Ship", "ShipSettings"}
    for parts in MODULES:
        if parts[0] == "simulation":
            for name in imported(read(parts)):
                if name.startswith("sensors."):
                    last = name.rpartition(".")[2]
                    where = f"{'.'.join(parts)} imports {name}"
                    assert last in records | settings | plain | {"AIDS", "PLANAR"}, where


def test_kalman_shares_no_measurement_equation_with_the_factors():
    for parts in MODULES:
        if parts[0] == "baselines":
            for name in imported(read(parts)):
                if name.startswith("sensors."):
                    assert name.endswith(SENSOR_DATA), f"{'.'.join(parts)} imports {name}"
            source = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
            assert "gtsam" not in source.lower(), parts


def test_the_command_line_and_the_package_load_lazily():
    for parts in [*(p for p in MODULES if p[0] == "cli"), ("__init__",)]:
        at_the_top = ast.Module(
            [node for node in read(parts).body if isinstance(node, (ast.Import, ast.ImportFrom))],
            [],
        )
        eager = set(map(layer_of, imported(at_the_top)))
        assert eager <= {*LIGHT, "__version__"}, parts


def test_only_keys_makes_symbols():
    for parts in MODULES:
        source = PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8")
        # Examples in docstrings are scripts of a user's own.
        code = "\n".join(line for line in source.splitlines() if ">>>" not in line)
        if parts != ("graph", "keys"):
            assert "symbol" not in code.replace("no symbol", ""), parts
