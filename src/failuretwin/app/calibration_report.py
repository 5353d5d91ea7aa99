"""One self-contained HTML page from which an engineer judges a calibration. Needs `plots`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin import __version__
from failuretwin.app.calibration_tables import (
    beats_uncalibrated,
    channels,
    held_out_table,
    left_out_line,
    parameter_groups,
    verdict_line,
)
from failuretwin.app.plots import BLUE, GREY, RED, clean, figure_class, png, render_page
from failuretwin.app.tables import Table
from failuretwin.connection.calibration.cross_validation import (
    ExampleTransient,
    Predictions,
    example_transient,
    predict,
    settling_of,
)
from failuretwin.connection.calibration.result import Calibration, HeldOut
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Pictures of a calibration: what it expects, what is left, and how a ramp fits.

MOST_COLUMNS = 4
PANEL_IN = 3.2
WIDTH_IN = 11.6
DIRECTIONS = ((1.0, BLUE, "towards larger angles"), (-1.0, RED, "towards smaller angles"))
LOAD_FLOOR_NM = 1e-3
"""Load torque below which a motor counts as unloaded in the pictures [N m]."""


def _panels(names: list[str]) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each channel, to be handed to `finish`."""
    count = len(names)
    columns = min(count, MOST_COLUMNS)
    rows = -(-count // columns)
    figure = figure_class()(figsize=(WIDTH_IN, PANEL_IN * rows + 0.4), layout="constrained")
    panels = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    for panel, name in zip(panels, names, strict=True):
        panel.set_title(name, fontsize=10)
    return figure, panels


def finish(figure: Figure, panels: Sequence[Axes], below: str = "", beside: str = "") -> Figure:
    """Return a figure with its axes labelled and one legend for all panels."""
    for panel in panels:
        if below:
            panel.set_xlabel(below, fontsize=9)
        panel.tick_params(labelsize=8)
        clean(panel)
    panels[0].set_ylabel(beside)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9
    )
    return figure


def load_figure(seen: Predictions, settling: Settling, robot: Robot) -> Figure:
    """Return the settled error of each motor against its load, with the fitted lines."""
    names, scale, unit = channels(robot, True)
    figure, panels = _panels(names)
    for k, panel in enumerate(panels):
        torque = seen.torque[:, k]
        loaded = bool(np.abs(torque).max(initial=0.0) > LOAD_FLOOR_NM)
        x = torque if loaded else np.rad2deg(seen.target[:, k])
        for sign, colour, label in DIRECTIONS:
            chosen = seen.counts[:, k] & (seen.direction[:, k] == sign)
            panel.plot(x[chosen], scale * seen.error[chosen, k], ".", ms=5, color=colour, alpha=0.6)
            ends = np.array([x.min(), x.max()]) if len(x) else np.zeros(2)
            slope = settling.compliance[k] if loaded else 0.0
            line = settling.bias[k] - settling.friction[k] * sign + slope * ends
            panel.plot(ends, scale * line, color=colour, lw=1.8, label=label)
        panel.axhline(0.0, color=GREY, lw=0.8, zorder=0)
        panel.set_xlabel("load torque [N m]" if loaded else "target [deg], no load", fontsize=9)
    return finish(figure, panels, beside=f"settled error [{unit}]")


def expected_figure(seen: Predictions, robot: Robot) -> Figure:
    """Return settled errors against what was expected of them, each channel a panel."""
    names, scale, unit = channels(robot, seen.of_motors)
    figure, panels = _panels(names)
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        kept = seen.counts[:, k]
        expected, error = (scale * e[kept, k] for e in (seen.expected, seen.error))
        reach = _reach(expected, error)
        panel.plot([-reach, reach], [0.0, 0.0], color=GREY, lw=1.5, label="uncalibrated twin")
        panel.plot([-reach, reach], [-reach, reach], color=BLUE, lw=1.5, label="calibrated twin")
        panel.plot(expected, error, ".", ms=5, color="black", alpha=0.45, label="settled movement")
        panel.set_xlim(-reach, reach)
        panel.set_ylim(-reach, reach)
        panel.set_box_aspect(1.0)
        beyond = int(np.sum(np.abs(error) > reach))
        if beyond:
            panel.annotate(f"{beyond} beyond", (0.03, 0.94), xycoords="axes fraction", fontsize=8)
        before, after = (1.4826 * float(np.median(np.abs(e))) for e in (error, error - expected))
        panel.set_title(f"{name}: {before:.2f} to {after:.2f} {unit}", fontsize=10)
    return finish(figure, panels, f"expected error [{unit}]", f"settled error [{unit}]")


def _reach(expected: FloatArray, error: FloatArray) -> float:
    """Return the limit of a square panel that a few outliers do not squeeze."""
    usual = float(np.quantile(np.abs(error), 0.975)) if len(error) else 0.0
    return 1.08 * max(1.5 * usual, float(np.abs(expected).max(initial=1e-9)))


def quantile_figure(seen: Predictions, dof: float, robot: Robot) -> Figure:
    """Return quantiles of what is left against those of the fitted Student t distribution."""
    from scipy.stats import beta, t

    figure, panels = _panels(channels(robot, seen.of_motors)[0])
    for k, panel in enumerate(panels):
        kept = seen.counts[:, k]
        left = np.sort((seen.error - seen.expected)[kept, k] / seen.scale[kept, k])
        order = np.arange(1, len(left) + 1)
        theory = t.ppf((order - 0.5) / len(left), dof)
        low, high = (t.ppf(beta.ppf(p, order, order[::-1]), dof) for p in (0.025, 0.975))
        panel.fill_between(theory, low, high, color=GREY, alpha=0.35, lw=0, label="95 % band")
        panel.plot(theory, theory, color=BLUE, lw=1.2, label="as the calibration says")
        panel.plot(theory, left, ".", ms=4, color="black", alpha=0.7, label="settled movement")
        reach = 1.08 * float(np.abs(np.concatenate([left, theory, [1.0]])).max())
        panel.set_ylim(-reach, reach)
    return finish(figure, panels, "expected quantile [scales]", "what is left [scales]")


def ramp_figure(ramp: ExampleTransient, robot: Robot) -> Figure:
    """Return one movement: command, twin before and after calibration, and readings."""
    names, scale, unit = channels(robot, ramp.of_motors)
    figure, panels = _panels(names)
    lines: tuple[tuple[FloatArray, dict[str, Any]], ...] = (
        (ramp.command, {"color": GREY, "lw": 2.2, "label": "command"}),
        (ramp.plain, {"color": RED, "lw": 1.2, "ls": "--", "label": "uncalibrated"}),
        (ramp.calibrated, {"color": BLUE, "lw": 1.4, "label": "calibrated"}),
        (ramp.reading, {"color": "black", "ls": "", "marker": ".", "ms": 6, "label": "readings"}),
    )
    for k, panel in enumerate(panels):
        for values, style in lines:
            panel.plot(ramp.time, scale * values[:, k], **style)
    what = "angle" if ramp.of_motors else "position"
    return finish(figure, panels, "time since the command [s]", f"{what} [{unit}]")


def session_figure(held_out: Sequence[HeldOut], robot: Robot, of_motors: bool) -> Figure:
    """Return the size of the settled error of each unseen session, before and after."""
    names, scale, unit = channels(robot, of_motors)
    height = max(1.9, 0.34 * len(held_out) + 1.2)
    figure = figure_class()(figsize=(WIDTH_IN, height), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    rows = np.arange(len(held_out))[::-1]
    bars = (
        (0.19, GREY, "uncalibrated", [entry.before for entry in held_out]),
        (-0.19, BLUE, "calibrated", [entry.after for entry in held_out]),
    )
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        for shift, colour, label, sizes in bars:
            size = scale * np.array(sizes)[:, k]
            panel.barh(rows + shift, size, 0.36, color=colour, label=label)
        panel.set_title(name, fontsize=10)
        panel.set_yticks(rows, [entry.session for entry in held_out], fontsize=8)
        panel.tick_params(axis="y", length=0)
        panel.set_ylim(-0.6, len(held_out) - 0.4)
    return finish(figure, panels, f"settled error [{unit}]")


# The page.


def write_calibration_page(
    found: Calibration, runs: xr.Dataset, robot: Robot, folder: Path
) -> None:
    """Write `index.html` into an existing folder; the runs are those learned from or judged on."""
    units, better = robot.profile.servo_units, beats_uncalibrated(found)
    left_out = [(e.run, str(e.movement or "all"), f"{e.motor} {e.reason}") for e in found.left_out]
    seen, settling = predict(found, runs, robot), settling_of(found, robot)
    ramp = example_transient(found, runs, robot)
    text = render_page(
        "calibration.html.j2",
        {
            "found": found,
            "robot": robot.name,
            "verdict": verdict_line(found).rstrip("."),
            "grade": "unknown" if better is None else "good" if better else "bad",
            "facts": _facts(found, settling),
            "sessions": held_out_table(found, robot),
            "groups": parameter_groups(found, robot),
            "count_deg": None if units is None else units.deg_per_count,
            "left_out": Table(("run", "movement", "why"), left_out),
            "left_out_line": left_out_line(found),
            "pictures": _pictures(found, seen, settling, ramp, robot),
            "unseen": seen.unseen,
            "dof": settling.tail_dof,
            "ramp": ramp,
        },
    )
    (folder / "index.html").write_text(text, encoding="utf-8")


def _facts(found: Calibration, settling: Settling) -> Table:
    way = "the motors' own readings" if found.used_readings else "the tool path alone"
    payload, protocol = settling.payload, found.imperfections.protocol
    rows = [
        ("learned from", found.imperfections.source),
        ("sessions", f"{len(found.sessions)}: {', '.join(found.sessions)}"),
        ("that is", f"{found.movements} settled movements of {found.runs} runs, by {way}"),
        ("protocol", f"{protocol}: healthy logs only, no recorded failure"),
        ("payload", f"{payload} kg at the tool point" if payload else "none assumed"),
        ("made by", f"failuretwin {__version__}"),
    ]
    return Table(("", ""), rows, header=False)


def _pictures(
    found: Calibration,
    seen: Predictions,
    settling: Settling,
    ramp: ExampleTransient | None,
    robot: Robot,
) -> dict[str, str]:
    """Return those pictures that there is something to show in, by name."""
    figures = {}
    if found.held_out:
        figures["sessions"] = session_figure(found.held_out, robot, found.used_readings)
    if seen.counts.any():
        figures["expected"] = expected_figure(seen, robot)
        figures["quantiles"] = quantile_figure(seen, settling.tail_dof, robot)
        if seen.of_motors:
            figures["load"] = load_figure(seen, settling, robot)
    if ramp is not None:
        figures["ramp"] = ramp_figure(ramp, robot)
    return {name: png(figure) for name, figure in figures.items()}
