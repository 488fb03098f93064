"""Numbers and names as they are shown to the reader, in tables and in figures."""

from __future__ import annotations

import math

from factorgraph_dvl.sensors.parameters import UNITS

# Chosen: fewer than the digits of a double.
_MAX_DECIMALS = 12
# Words of names that are written in capitals.
_ACRONYMS = {"gnss": "GNSS", "dvl": "DVL", "ins": "INS"}


def split_unit(component: str) -> tuple[str, str]:
    """Split `lever_arm_x_m` into `lever_arm_x` and a unit to show, empty if there is none."""
    parts = component.split("_")
    for i in range(1, len(parts)):
        unit = UNITS.get("_".join(parts[i:]))
        if unit is not None:
            return "_".join(parts[:i]), unit.text
    return component, ""


def in_words(name: str) -> str:
    """Return a name of the files as words: `gnss_lever_arm_x` is `GNSS lever arm x`."""
    return " ".join(_ACRONYMS.get(word, word) for word in name.split("_"))


def sentence(text: str) -> str:
    """Return a text with a full stop, unless it ends with a mark of its own."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def fixed(value: float, decimals: int, *, signed: bool = False) -> str:
    """Write a number with so many decimals, never as a negative zero."""
    return format(round(value, decimals) + 0.0, f"{'+' if signed else ''}.{decimals}f")


def at_precision(value: float, std: float) -> str:
    """Write a number to the second digit of its standard deviation."""
    if not (math.isfinite(std) and std > 0.0 and math.isfinite(value)):
        return f"{value + 0.0:.6g}"
    return fixed(value, min(max(1 - math.floor(math.log10(std)), 0), _MAX_DECIMALS))


def with_std(value: float, std: float) -> str:
    """Write a value and its standard deviation, to two digits of the latter."""
    return f"{at_precision(value, std)} ± {at_precision(std, std)}"
