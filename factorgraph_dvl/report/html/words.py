"""Phrases, names of parameters and findings in Chinese, from `chinese.json`."""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

from factorgraph_dvl.report.text import in_words, split_unit
from factorgraph_dvl.sensors.finding import Finding

# Beginnings of causes that name a measurement or a parameter, and what follows it in Chinese.
_CAUSES = {
    "noise of ": "噪声",
    "correlated noise of ": "相关噪声",
    "lasting errors of ": "的持续误差",
    "prior of ": "的先验",
    "random walk of ": "的随机游走",
}


@cache
def dictionary(kind: str) -> dict[str, Any]:
    """Return the Chinese of every English phrase, stem of a parameter, or code of a finding.

    Parameters
    ----------
    kind : {'phrases', 'parameters', 'findings'}
        Which of them. A finding has three texts: its meaning, why it matters, and the action.
    """
    file = files("factorgraph_dvl.report") / "html" / "chinese.json"
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))[kind]
    return found


def chinese(english: str) -> str:
    """Return a phrase, or the name of a parameter, in Chinese; where there is none, as it is."""
    name = dictionary("parameters").get(english.lower().replace(" ", "_"), english)
    return str(dictionary("phrases").get(english, name))


def chinese_cause(cause: str) -> str:
    """Return a cause of the error budget in Chinese; what is not known stays as it is."""
    for start, own in _CAUSES.items():
        if cause.startswith(start):
            name = split_unit(cause.removeprefix(start))[0]
            return f"{dictionary('parameters').get(name, chinese(name))}{own}"
    return chinese(cause)


def chinese_finding(finding: Finding) -> str:
    """Return a finding in Chinese; a text of another version behind what its code means."""
    if isinstance(finding.message, str):
        meaning, _, _ = dictionary("findings")[finding.code]
        return f"{meaning}（{finding}）"
    text = finding.message.text("zh")
    return f"{chinese(finding.sensor)}：{text}" if finding.sensor else text


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
            return in_words(name), own, unit
    return in_words(name), in_words(name), unit
