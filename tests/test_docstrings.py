"""Docstrings of all public names are numpydoc, as its own validator has it."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator

import pytest
from numpydoc.docscrape import get_doc_object
from numpydoc.validate import Validator, validate

import factorgraph_dvl

# They ask for what types or one plain sentence already say: see also, examples, an extended
# summary, a section for every return value and argument, yields, text below the quotes.
NOT_CHECKED = {"SA01", "EX01", "ES01", "RT01", "PR01", "YD01", "GL01"}
MODULES = [
    module.name
    for module in pkgutil.walk_packages(factorgraph_dvl.__path__, "factorgraph_dvl.")
    if not module.name.endswith("__main__")
]
# A unit or type where a sentence should begin: it belongs to the type.
UNIT_FIRST = re.compile(r"^ +(?:S|M|M/s|Rad|Deg|Hz|Bool|Text)[,;.](?: .*|)$", re.MULTILINE)


class Docstring(Validator):
    """The docstring of a name; no comment in its file switches a check off."""

    source_file_name = None
    source_file_def_line = None

    def __init__(self, obj_name: str) -> None:
        super().__init__(get_doc_object(Validator._load_obj(obj_name)))


def public_names(module_name: str) -> Iterator[str]:
    """Yield a module, its public functions and classes, and their public methods."""
    yield module_name
    for name, thing in vars(importlib.import_module(module_name)).items():
        own = getattr(thing, "__module__", None) == module_name
        if name.startswith("_") or not own:
            continue
        if inspect.isfunction(thing):
            yield f"{module_name}.{name}"
        elif inspect.isclass(thing):
            yield f"{module_name}.{name}"
            for method, member in vars(thing).items():
                described = isinstance(member, property | classmethod | staticmethod)
                if not method.startswith("_") and (described or inspect.isfunction(member)):
                    yield f"{module_name}.{name}.{method}"


@pytest.mark.parametrize("module_name", MODULES)
def test_docstrings_are_numpydoc(module_name: str) -> None:
    found = []
    for name in public_names(module_name):
        result = validate(name, validator_cls=Docstring)
        found += [f"{name}: {code} {t}" for code, t in result["errors"] if code not in NOT_CHECKED]
        found += [f"{name}: {line.strip()}" for line in UNIT_FIRST.findall(result["docstring"])]
    assert not found, "\n".join(found)


def test_the_validator_finds_what_is_wrong() -> None:
    """A parameter without a description, in a function of this module."""
    errors = validate(f"{__name__}.wrong", validator_cls=Docstring)["errors"]
    assert {code for code, _ in errors} - NOT_CHECKED == {"PR07", "SS03"}


def wrong(value: float) -> None:
    """Do nothing

    Parameters
    ----------
    value : float
    """
