"""The public names: listed, documented, each with an example that runs."""

from __future__ import annotations

import doctest
import functools
import inspect
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import factorgraph_dvl as fd

ROOT = Path(__file__).resolve().parents[1]


def remembered(function):
    """Return a function that is called once for arguments that are the same things."""
    kept = {}

    @functools.wraps(function)
    def call(*args, **options):
        key = (*(a if isinstance(a, str) else id(a) for a in args), *sorted(options.items()))
        if key not in kept:
            kept[key] = args, function(*args, **options)
        return kept[key][1]

    return call


@pytest.fixture(scope="module", autouse=True)
def once():
    """Simulate and solve each trial of the examples once, in the root of the repository."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        for name in ("simulate", "solve", "solved_problems", "kalman"):
            patch.setattr(fd, name, remembered(getattr(fd, name)), raising=False)
        yield


@pytest.mark.parametrize("name", fd.__all__)
def test_the_example_runs(name):
    thing = inspect.unwrap(getattr(fd, name))
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    text = inspect.getdoc(thing)
    examples = doctest.DocTestParser().get_doctest(text, {}, name, None, 0)
    assert examples.examples, f"{name} has no example"
    out = []
    doctest.DocTestRunner(optionflags=flags).run(examples, out=out.append)
    assert not out, "".join(out)


def test_dir_lists_the_public_names_and_no_tools():
    assert set(fd.__all__) <= set(dir(fd))
    assert not {"import_module", "annotations", "TYPE_CHECKING", "Any"} & set(dir(fd))
    assert list(fd.__all__) == sorted(fd.__all__)


def test_help_shows_the_public_names():
    text = pydoc.plain(pydoc.render_doc(fd))
    for name in ("solve(trial", "class Replay", "preintegrate(imu", "class ConfigError"):
        assert name in text


def test_types_are_those_of_the_lazy_names():
    source = (ROOT / "factorgraph_dvl" / "__init__.py").read_text(encoding="utf-8")
    for name, module in fd._PUBLIC.items():
        assert name in fd.__all__
        imported = re.search(
            rf"from factorgraph_dvl\.{re.escape(module)} import [^)]*?\b{name}\b", source
        )
        assert imported, name


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, factorgraph_dvl; dir(factorgraph_dvl); print(*sys.modules)"
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert not {"numpy", "gtsam", "scipy", "matplotlib", "pandas"} & set(out.stdout.split())
