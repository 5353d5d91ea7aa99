"""Pictures of a calibration: expected errors, residuals, and a ramp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.reports.plots import BLUE, GREY, RED, clean, new_figure
from failuretwin.connection.calibration.cross_validation import ExampleTransient, Predictions
from failuretwin.core.runs import AXES
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot, shown_unit
from failuretwin.digital_model.settling import Settling

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_COLUMNS, PANEL_IN, WIDTH_IN = 4, 3.2, 11.6
DIRECTIONS = ((1.0, BLUE, "towards larger angles"), (-1.0, RED, "towards smaller angles"))
LOAD_FLOOR_NM = 1e-3
"""Load torque below which a motor counts as unloaded in the pictures [N m]."""


def channels(robot: Robot, of_motors: bool) -> tuple[list[str], float, str]:
    """Return the name of each motor or tool axis, factor and name of the unit that people read."""
    if not of_motors:
        return [f"tool {axis}" for axis in AXES], 1e3, "mm"
    scale, unit = shown_unit("rad", robot)
    return [name.replace("_", " ") for name in robot.motor_names], scale, unit


def _panels(names: list[str]) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each channel, to be handed to `_finish`."""
    columns = min(len(names), MOST_COLUMNS)
    rows = -(-len(names) // columns)
    figure = new_figure(WIDTH_IN, PANEL_IN * rows + 0.4)
    panels = [figure.add_subplot(rows, columns, i + 1, title=n) for i, n in enumerate(names)]
    return figure, panels


def _finish(figure: Figure, panels: Sequence[Axes], below: str = "", beside: str = "") -> Figure:
    """Return a figure with its axes labelled and one legend for all panels."""
    for panel in panels:
        if below:
            panel.set_xlabel(below, fontsize=9)
        panel.title.set_fontsize(10)
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
    return _finish(figure, panels, beside=f"settled error [{unit}]")


def expected_figure(seen: Predictions, robot: Robot) -> Figure:
    """Return settled errors against expected ones, each channel a panel."""
    names, scale, unit = channels(robot, seen.of_motors)
    figure, panels = _panels(names)
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        kept = seen.counts[:, k]
        expected, error = (scale * e[kept, k] for e in (seen.expected, seen.error))
        reach = _reach(expected, error)
        ends = [-reach, reach]
        panel.plot(ends, [0.0, 0.0], color=GREY, lw=1.5, label="uncalibrated twin")
        panel.plot(ends, ends, color=BLUE, lw=1.5, label="calibrated twin")
        panel.plot(expected, error, ".", ms=5, color="black", alpha=0.45, label="settled movement")
        panel.set(xlim=ends, ylim=ends, box_aspect=1.0)
        beyond = int(np.sum(np.abs(error) > reach))
        if beyond:
            panel.annotate(f"{beyond} beyond", (0.03, 0.94), xycoords="axes fraction", fontsize=8)
        before, after = (1.4826 * float(np.median(np.abs(e))) for e in (error, error - expected))
        panel.set_title(f"{name}: {before:.2f} to {after:.2f} {unit}")
    return _finish(figure, panels, f"expected error [{unit}]", f"settled error [{unit}]")


def _reach(expected: FloatArray, error: FloatArray) -> float:
    """Return the limit of a square panel that a few outliers do not squeeze."""
    usual = float(np.quantile(np.abs(error), 0.975)) if len(error) else 0.0
    return 1.08 * max(1.5 * usual, float(np.abs(expected).max(initial=1e-9)))


def quantile_figure(seen: Predictions, dof: float, robot: Robot) -> Figure:
    """Return quantiles of the residuals against those of the fitted Student t distribution."""
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
    return _finish(figure, panels, "expected quantile [scales]", "what is left [scales]")


def ramp_figure(ramp: ExampleTransient, robot: Robot) -> Figure:
    """Return one movement: command, twin before and after calibration, and readings."""
    names, scale, unit = channels(robot, ramp.of_motors)
    figure, panels = _panels(names)
    for k, panel in enumerate(panels):
        command, plain, calibrated, reading = (
            scale * values[:, k]
            for values in (ramp.command, ramp.plain, ramp.calibrated, ramp.reading)
        )
        panel.plot(ramp.time, command, color=GREY, lw=2.2, label="command")
        panel.plot(ramp.time, plain, "--", color=RED, lw=1.2, label="uncalibrated")
        panel.plot(ramp.time, calibrated, color=BLUE, lw=1.4, label="calibrated")
        panel.plot(ramp.time, reading, ".", color="black", ms=6, label="readings")
    what = "angle" if ramp.of_motors else "position"
    return _finish(figure, panels, "time since the command [s]", f"{what} [{unit}]")
