"""Pictures of the pages, drawn into docs/images.

    python docs/pictures.py [--reports]

`--reports` draws the reports of the shipped trial as well. Screenshots need chromium; without it
they stay as they are.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, FancyArrowPatch, Polygon

from factorgraph_dvl import load_scenario, load_trial, predict
from factorgraph_dvl.geometry.rotations import exp_so3
from factorgraph_dvl.geometry.units import DEG
from factorgraph_dvl.sensors.usbl import Usbl

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
SHIPPED = ROOT / "data" / "seed-a-phase-90"
# Okabe and Ito's colours, which colour-blind readers tell apart.
BODY, DVL, ANTENNA, NAVIGATION, PLAIN = "#0072b2", "#d55e00", "#009e73", "#555555", "#222222"


Place = Iterable[float]


def arrow(ax: Axes, start: Place, end: Place, colour: str, name: str, gap: float = 0.3) -> None:
    """Draw an arrow, and its name `gap` beyond its head."""
    a, b = np.array([*start]), np.array([*end])
    looks = {"arrowstyle": "-|>", "mutation_scale": 13, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    ax.add_patch(FancyArrowPatch(a, b, color=colour, **looks))
    place = b + gap * (b - a) / np.linalg.norm(b - a)
    ax.text(*place, name, color=colour, ha="center", va="center")


def between(ax: Axes, start: Place, end: Place, colour: str, name: str) -> None:
    """Draw a lever arm: dashed, with its name beside its middle."""
    a, b = np.array([*start]), np.array([*end])
    looks = {"arrowstyle": "-|>", "mutation_scale": 9, "lw": 1.2, "ls": (0, (4, 2)), "shrinkA": 4}
    ax.add_patch(FancyArrowPatch(a, b, color=colour, **looks))
    across = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
    ax.text(*((a + b) / 2 + 0.28 * across), name, color=colour, ha="center", va="center")


def panel(ax: Axes, title: str, width: float, low: float, high: float) -> None:
    """Make a panel without axes."""
    ax.set(xlim=(-width, width), ylim=(low, high), aspect="equal", title=title)
    ax.axis("off")


def frames() -> Figure:
    """Draw body, DVL, antenna and navigation axes: from above, from starboard, from astern."""
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    panels = figure.subplot_mosaic([["above", "side"], ["above", "astern"]], height_ratios=[5, 3])
    above, side, astern = panels["above"], panels["side"], panels["astern"]

    panel(above, "from above", 4.2, -5, 4.6)
    heading = 25 * DEG
    # Columns: starboard and bow, in east and north.
    hull_axes = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    outline = np.array([[-1.3, -3.6], [1.3, -3.6], [1.3, 2], [0, 4], [-1.3, 2]])
    above.add_patch(Polygon(outline @ hull_axes.T, fc="#eef3f7", ec=PLAIN))
    origin, north = np.zeros(2), np.array([-3.6, 2])
    arrow(above, north, north + np.array([0, 1.6]), NAVIGATION, "north")
    arrow(above, north, north + np.array([1.3, 0]), NAVIGATION, "east", 0.5)
    for name, axis in (("$x_b$", 0), ("$y_b$", 1)):
        arrow(above, origin, 1.7 * hull_axes[:, axis], BODY, name)
    # Rows of C_b^d are the axes of the DVL in body.
    dRb = exp_so3(np.array([0.0, 0.0, 30.0]) * DEG)
    lever_arm = hull_axes @ np.array([0.3, -2.6])
    for name, axis in (("$x_d$", 0), ("$y_d$", 1)):
        arrow(above, lever_arm, lever_arm + 1.5 * hull_axes @ dRb[axis, :2], DVL, name)
    between(above, origin, lever_arm, DVL, "$l$")
    antenna = hull_axes @ np.array([-0.7, 2.3])
    above.plot(*antenna, "o", color=ANTENNA)
    between(above, origin, antenna, ANTENNA, "$l_a$")
    along = lever_arm + 1.6 * hull_axes[:, 1]
    above.plot(*np.array([lever_arm, along]).T, ":", color=BODY)
    bow = 90 - 25
    above.add_patch(Arc(lever_arm, 2, 2, theta1=bow - 30, theta2=bow, color=DVL))
    above.annotate("$α_z$ > 0", (1.1, -2.0), color=DVL)

    panel(side, "from starboard", 4.2, -3.8, 3.4)
    pitch = 8 * DEG
    turn = np.array([[np.cos(pitch), -np.sin(pitch)], [np.sin(pitch), np.cos(pitch)]])
    outline = np.array([[-3, -0.7], [2.3, -0.7], [3.3, 0.8], [-3, 0.8]])
    side.add_patch(Polygon(outline @ turn.T, fc="#eef3f7", ec=PLAIN))
    side.axhline(0, color=NAVIGATION, lw=0.8, ls=":")
    arrow(side, origin, turn @ [1.9, 0], BODY, "$y_b$")
    arrow(side, origin, turn @ [0, 1.7], BODY, "$z_b$")
    place = turn @ np.array([-1.8, -0.7])
    between(side, origin, place, DVL, "$l$")
    side.add_patch(
        Polygon(
            np.array([[-0.3, 0], [0.3, 0], [0.2, -0.4], [-0.2, -0.4]]) @ turn.T + place, fc=DVL
        )
    )
    for slope in (-0.45, 0.45):
        foot = place + (-3.6 - place[1]) / -1.0 * np.array([slope, -1.0])
        side.plot(*np.array([place - [0, 0.35], foot]).T, color=DVL, lw=0.9, ls="--")
    side.axhline(-3.6, color=PLAIN)
    side.text(3.9, -3.5, "seabed", ha="right", va="bottom", color=PLAIN)
    mast = turn @ np.array([1.5, 2.6])
    side.plot(*np.array([turn @ [1.5, 0.8], mast]).T, color=PLAIN, lw=0.8)
    side.plot(*mast, "o", color=ANTENNA)
    between(side, origin, mast, ANTENNA, "")
    side.annotate("antenna", mast + np.array([0.25, 0.2]), color=ANTENNA)
    side.text(1.9, -1.4, "pitch > 0: bow up", ha="center", color=PLAIN, fontsize=9)

    panel(astern, "from astern", 4.2, -2.3, 2.6)
    roll = -10 * DEG
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    outline = np.array([[-1.7, 1], [-1.3, -0.5], [0, -1], [1.3, -0.5], [1.7, 1]])
    astern.add_patch(Polygon(outline @ turn.T, fc="#eef3f7", ec=PLAIN))
    astern.axhline(0, color=NAVIGATION, lw=0.8, ls=":")
    arrow(astern, origin, turn @ [2.4, 0], BODY, "$x_b$")
    arrow(astern, origin, turn @ [0, 1.9], BODY, "$z_b$")
    astern.text(0, -2.1, "roll > 0: starboard down", ha="center", color=PLAIN, fontsize=9)
    return figure


def run() -> Figure:
    """Draw the shipped trial's track, coloured by what the vessel does."""
    trial = load_trial(SHIPPED)
    assert trial.reference is not None
    time, place = trial.reference.time, trial.reference.geodetic
    east, north, _ = trial.frame().position(*place.T).T
    figure = Figure(figsize=(5.4, 4.4), layout="constrained")
    ax = figure.subplots()
    kinds = {
        "straight at a steady speed": [(0, 104), (149, 249), (299, 399)],
        "slow turn to port": [(104, 149)],
        "fast turns to starboard": [(249, 299), (399, 453)],
    }
    for colour, (name, spans) in zip((BODY, DVL, ANTENNA), kinds.items(), strict=True):
        for k, (first, last) in enumerate(spans):
            i = (time >= first) & (time <= last)
            ax.plot(east[i], north[i], color=colour, lw=2.4, label=name if k == 0 else None)
    ax.plot(east[0], north[0], "k^", label="start")
    ax.plot(east[-1], north[-1], "ks", label="end")
    ax.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    ax.grid(alpha=0.3)
    ax.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False)
    return figure


def box_in() -> Figure:
    """Draw the tracks of the plan `box-in` from above, and what it gives after each minute."""
    plan = predict(load_scenario(ROOT / "configs" / "plans" / "box-in.yaml"))
    trial = plan.trial
    usbl = trial.required(Usbl)
    assert usbl.ship is not None
    assert trial.reference is not None
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    above, gained = figure.subplots(1, 2)
    frame = trial.frame()
    for place, colour, name in (
        (usbl.ship.geodetic, BODY, "ship, sails a box"),
        (trial.reference.geodetic, DVL, "vehicle, at 25 and 40 m"),
    ):
        east, north, _ = frame.position(*place.T).T
        above.plot(east, north, color=colour, lw=1.6, label=name)
        above.plot(east[0], north[0], "^", color=colour)
    above.set(xlabel="east, m", ylabel="north, m", aspect="equal", title="from above")
    above.grid(alpha=0.3)
    above.margins(y=0.2)
    above.legend(frameon=False, loc="upper left", fontsize=9)
    minutes = plan.history.time / 60.0
    for name, colour, text in (
        ("misalignment_z_deg", DVL, "DVL misalignment z"),
        ("misalignment_y_deg", ANTENNA, "DVL misalignment y"),
        ("usbl_misalignment_z_deg", BODY, "USBL misalignment z"),
    ):
        gained.semilogy(
            minutes, plan.history.std[:, plan.history.names.index(name)], color=colour, label=text
        )
    gained.axhline(0.1, color=NAVIGATION, lw=0.8, ls=":")
    gained.set(xlabel="minutes", ylabel="σ, deg", title="what so many minutes give")
    gained.set(xlim=(0.0, minutes[-1]), ylim=(0.005, 3.0))
    gained.grid(alpha=0.3, which="both")
    gained.legend(frameon=False, fontsize=9)
    return figure


def screenshot(page: Path, name: str, language: str) -> None:
    """Write the head of a report as a picture, in `en` or `zh`."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print(f"{name} stays as it is: chromium is not installed", file=sys.stderr)
        return
    switches = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    switches += [f"--lang={language}", f"--accept-lang={language}"]
    size = "--window-size=900,720"
    target = f"--screenshot={IMAGES / name}"
    subprocess.run(
        [chromium, *switches, size, target, page.as_uri()],
        check=True,
        capture_output=True,
    )


def reports() -> None:
    """Show the reports of the shipped trial and of one whose DVL is stamped 0.1 s late."""
    program = [sys.executable, "-m", "factorgraph_dvl.cli"]
    with tempfile.TemporaryDirectory() as folder:
        late, out = Path(folder) / "late", Path(folder) / "out"
        config = ROOT / "configs" / "dvl-late.yaml"
        subprocess.run([*program, "simulate", config, "--out", late, "--seed", "1"], check=True)
        for trial, name in ((SHIPPED, "good"), (late, "late")):
            options = ["--out", out, "--force", "--quiet"]
            subprocess.run([*program, "solve", trial, *options], check=True)
            screenshot(out / "report.html", f"report-{name}.png", "en")
            screenshot(out / "report.html", f"report-{name}.zh.png", "zh")
            if trial == SHIPPED:
                shutil.copy(out / "figures" / "calibration.png", IMAGES)


def main() -> None:
    """Draw all pictures."""
    mpl.rcParams |= {"svg.hashsalt": "factorgraph-dvl", "font.size": 10}
    for name, figure in (("frames", frames()), ("run", run()), ("box-in", box_in())):
        figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})
    if "--reports" in sys.argv:
        reports()


if __name__ == "__main__":
    main()
