"""Phrases and names of parameters in Chinese, from `chinese.json`."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files

from factorgraph_dvl.report.text import split_unit


@cache
def dictionary(kind: str) -> dict[str, str]:
    """Return the Chinese of every English phrase, or of every stem of a parameter.

    Parameters
    ----------
    kind : {'phrases', 'parameters'}
        Which of them.
    """
    file = files("factorgraph_dvl.report") / "html" / "chinese.json"
    found: dict[str, str] = json.loads(file.read_text(encoding="utf-8"))[kind]
    return found


def chinese(english: str) -> str:
    """Return a phrase, or the name of a parameter, in Chinese; where there is none, as it is."""
    name = dictionary("parameters").get(english.replace(" ", "_"), english)
    return dictionary("phrases").get(english, name)


def component_names(component: str) -> tuple[str, str, str]:
    """Return the name of a component in English and in Chinese, and its unit.

    Parameters
    ----------
    component : str
        As in `covariance.order`, such as `lever_arm_x_m`.
    """
    stems = dictionary("parameters")
    name, unit = split_unit(component)
    for stem in sorted(stems, key=len, reverse=True):
        if name == stem or name.startswith(f"{stem}_"):
            own = f"{stems[stem]}{name[len(stem) :].replace('_', ' ')}"
            return name.replace("_", " "), own, unit
    return name.replace("_", " "), name.replace("_", " "), unit
