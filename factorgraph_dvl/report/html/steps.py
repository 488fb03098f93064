"""The objective over the steps of the solver, as SVG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph_dvl.report.html.markup import Html, labels, tspans

# Size of the drawing and its margins, in its own units.
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 640.0, 220.0, 70.0, 40.0, 14.0
# What is left to fall when the solver ends, in -2 log of the likelihood. Chosen: less than counts.
_LEAST = 0.01
_TITLE = "Objective above its last value"


def steps_drawing(objective: Sequence[float]) -> Html:
    """Return how far the objective is above its last value, on a logarithmic axis.

    Parameters
    ----------
    objective : sequence of float
        Value after each of the steps, the start first.
    """
    above = np.log10(np.maximum(np.asarray(objective) - objective[-1], _LEAST))
    low, high = np.log10(_LEAST), max(float(np.ceil(above.max())), np.log10(_LEAST) + 1.0)
    x = np.linspace(_LEFT + 10.0, _WIDTH - 20.0, above.size) if above.size > 1 else [_LEFT + 10.0]
    y = _TOP + (high - above) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)
    given = " ".join(f'{k.replace("_", "-")}="{v}"' for k, v in labels(_TITLE).items())
    parts = [f'<svg class="history" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" {given}>']
    for power in range(int(np.ceil(low)), int(high) + 1):
        at = _TOP + (high - power) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)
        parts.append(
            f'<line class="grid" x1="{_LEFT:g}" x2="{_WIDTH:g}" y1="{at:.1f}" y2="{at:.1f}"/>'
            f'<text x="{_LEFT - 6:g}" y="{at + 4:.1f}" text-anchor="end">{10.0**power:g}</text>'
        )
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    parts.append(f'<polyline class="joint" points="{points}"/>')
    parts += [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5"/>'
        f'<text x="{a:.1f}" y="{_HEIGHT - 24:g}" text-anchor="middle">{k}</text>'
        for k, (a, b) in enumerate(zip(x, y, strict=True))
    ]
    parts.append(
        f'<text x="{0.5 * (_LEFT + _WIDTH):g}" y="{_HEIGHT - 6:g}" text-anchor="middle">'
        f"{tspans('round')}</text>"
        f'<text transform="translate(12 {0.5 * _HEIGHT:g}) rotate(-90)" text-anchor="middle">'
        f"{tspans(_TITLE)}</text></svg>"
    )
    return Html("".join(parts))
