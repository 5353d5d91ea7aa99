"""Report of `calibrate`: tables on the terminal, and one page.

Parameters with intervals, held-out sessions, what was left out. The page is self-contained HTML and
needs the extra `plots`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.app.reports.plots import BLUE, GREY, clean, new_figure, png, write_index
from failuretwin.app.reports.technician_page import Section
from failuretwin.app.terminal import Part, Table, figures_table
from failuretwin.connection.calibration.cross_validation import (
    Predictions,
    predict,
    settling_of,
)
from failuretwin.connection.calibration.result import Calibration, Parameter, mean_gain
from failuretwin.connection.self_calibration import SelfCalibration
from failuretwin.connection.tracked_diagnosis import Tracked
from failuretwin.core.errors import counted
from failuretwin.core.runs import AXES
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot, shown_unit
from failuretwin.inference.explanation import joint_names_in
from failuretwin.inference.together.wear_limits import wear_unit

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

# The picture: settled errors against expected ones.

MOST_COLUMNS, PANEL_IN, WIDTH_IN = 4, 3.2, 11.6


def channels(robot: Robot, of_motors: bool) -> tuple[list[str], float, str]:
    """Return the name of each motor or tool axis, factor and name of the unit that people read."""
    if not of_motors:
        return [f"tool {axis}" for axis in AXES], 1e3, "mm"
    scale, unit = shown_unit("rad", robot)
    return [name.replace("_", " ") for name in robot.motor_names], scale, unit


def expected_figure(seen: Predictions, robot: Robot) -> Figure:
    """Return settled errors against expected ones, each channel a panel."""
    names, scale, unit = channels(robot, seen.of_motors)
    columns = min(len(names), MOST_COLUMNS)
    rows = -(-len(names) // columns)
    figure = new_figure(WIDTH_IN, PANEL_IN * rows + 0.4)
    for k, name in enumerate(names):
        panel = figure.add_subplot(rows, columns, k + 1)
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
        panel.set_title(f"{name}: {before:.2f} to {after:.2f} {unit}", fontsize=10)
        panel.set_xlabel(f"expected error [{unit}]", fontsize=9)
        panel.tick_params(labelsize=8)
        clean(panel)
    figure.axes[0].set_ylabel(f"settled error [{unit}]")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9
    )
    return figure


def _reach(expected: FloatArray, error: FloatArray) -> float:
    """Return the limit of a square panel that a few outliers do not squeeze."""
    usual = float(np.quantile(np.abs(error), 0.975)) if len(error) else 0.0
    return 1.08 * max(1.5 * usual, float(np.abs(expected).max(initial=1e-9)))


# Sentences and tables.


def calibration_parts(found: Calibration, robot: Robot) -> list[Part]:
    """Return all learned parameters and their accuracy on unseen sessions."""
    way = "motor readings" if found.used_readings else "the tool path alone"
    parts: list[Part] = [
        f"{robot.name}: {found.extent}, {way}\n",
        parameter_table(found.parameters, robot),
        *(f"  {remark}" for remark in found.remarks),
    ]
    if found.left_out:
        parts.append(f"\nleft out: {left_out_line(found)}")
    if found.held_out:
        parts.append("\nsessions predicted by what the others say (settled error)\n")
        parts.append(held_out_table(found, robot))
    return [*parts, f"\n{verdict_line(found)}"]


def population_parts(found: Calibration, robot: Robot) -> list[Part]:
    """Return the mean and spread of a fleet's parameters."""
    fleet = found.sessions
    head = f"{robot.name}: population of {len(fleet)} robots: {', '.join(fleet)}\n"
    return [head, parameter_table(found.parameters, robot, "95 % of such robots")]


def parameter_table(
    parameters: Sequence[Parameter], robot: Robot | None, interval: str = "95 % interval"
) -> Table:
    """Return a row for each parameter: value, interval, unit, deviations from such robots, note.

    Angles are in the servo counts of the robot; None: in degrees.
    """
    compared = any(p.deviations is not None for p in parameters)
    rows = []
    for p in parameters:
        scale, unit = _unit(p, robot)
        value, low, high = (
            figure(scale * x, scale * (p.high - p.low)) for x in (p.value, p.low, p.high)
        )
        title = f"{p.name}, {p.motor}" if p.motor else p.name
        off = "" if p.deviations is None else f"{p.deviations + 0.0:+.1f} deviations"
        note = "" if p.identified else f"not identified: {p.note}"
        rows.append((title, value, f"{low} to {high}", unit, *[off] * compared, note))
    headings = ("parameter", "value", interval, "unit", *["from such robots"] * compared, "")
    return Table(headings, rows)


SHORT_S = 0.2
"""Times below this are shown in milliseconds [s]."""


def _unit(p: Parameter, robot: Robot | None) -> tuple[float, str]:
    """Return factor and name of the unit in which a parameter is shown."""
    shown = {"share": (100.0, "%"), "m": (1e3, "mm"), "-": (1.0, "")}
    if p.unit == "s" and max(abs(p.low), abs(p.high)) < SHORT_S:
        return 1e3, "ms"
    if p.unit == "rad" and robot is None:
        return float(np.rad2deg(1.0)), "deg"
    return shown.get(p.unit) or (shown_unit(p.unit, robot, p.motor) if robot else (1.0, p.unit))


def figure(value: float, width: float) -> str:
    """Return a value with as many digits as an interval of this width leaves meaning."""
    if width <= 0.0 or not np.isfinite(width):
        return f"{value:.3g}"
    decimals = int(np.clip(1 - np.floor(np.log10(width / 2.0)), 0, 6))
    return f"{value + 0.0:.{decimals}f}"


def held_out_table(found: Calibration, robot: Robot) -> Table:
    """Return the settled error of each unseen session, uncalibrated and predicted, and the gain."""
    names, scale, unit = channels(robot, found.used_readings)
    rows = []
    for entry in found.held_out:
        pairs = scale * np.array([entry.before, entry.after]).T
        cells = (f"{before:.2f} -> {after:.2f}" for before, after in pairs)
        gain = f"{entry.gain:+.2f} +- {1.96 * entry.gain_error:.2f}"
        rows.append((entry.session, str(entry.movements), *cells, gain))
    settled = (f"{name} [{unit}]" for name in names)
    return Table(("session", "movements", *settled, "gain [nats a movement]"), rows)


def left_out_line(found: Calibration) -> str:
    """Return how many runs and movements were left out and why, in one line."""
    kinds = Counter((entry.movement == 0, entry.motor, entry.reason) for entry in found.left_out)
    return "; ".join(
        f"{counted(count, 'run' if whole else 'movement')}: {f'{motor} ' * bool(motor)}{reason}"
        for (whole, motor, reason), count in kinds.most_common()
    )


def verdict_line(found: Calibration) -> str:
    """Return whether the fit beats the uncalibrated twin on sessions that it has not seen."""
    better = found.beats_uncalibrated
    if better is None:
        return (
            "not checked on unseen logs: it takes two sessions, each long enough to learn from. "
            "Record another day and calibrate on both."
        )
    gain, error = mean_gain(found.held_out)
    nats = f"{gain:+.2f} nats a movement (95 % interval {gain - error:+.2f} to {gain + error:+.2f})"
    if better:
        return f"on unseen sessions the calibrated twin beats the uncalibrated one: {nats}"
    return (
        f"on unseen sessions the calibration does NOT beat the uncalibrated twin: {nats}. Do not "
        "use it; record more healthy logs."
    )


# The page.


def write_calibration_page(
    found: Calibration, runs: xr.Dataset, robot: Robot, folder: Path
) -> None:
    """Write `index.html` into a folder; the runs are those learned from or judged on."""
    units, seen = robot.profile.servo_units, predict(found, runs, robot)
    write_index(
        "calibration.html.j2",
        {
            "found": found,
            "robot": robot.name,
            "verdict": verdict_line(found).rstrip("."),
            "payload": settling_of(found, robot).payload,
            "sessions": held_out_table(found, robot),
            "parameters": parameter_table(found.parameters, robot),
            "count_deg": None if units is None else units.deg_per_count,
            "left_out_line": left_out_line(found),
            "expected": png(expected_figure(seen, robot)) if seen.counts.any() else "",
            "unseen": seen.unseen,
        },
        folder,
    )


# Robot behaviour learned from runs by `diagnose --self-calibrate` and `--track`.


def taught_section(learned: SelfCalibration, robot: Robot) -> Section:
    """Return the parameters learned from runs, and the information that each run added."""
    found = learned.calibration
    by_run = [
        (diagnosis.run, f"{nats:.2f}")
        for diagnosis, nats in zip(learned.diagnoses, learned.taught, strict=True)
    ]
    return Section(
        "What the runs taught of the robot",
        [joint_names_in(line, robot) for line in found.remarks],
        [parameter_table(found.parameters, robot)],
        {"What each run taught": figures_table(("run", "taught [nats]"), by_run)},
    )


def tracking_line(tracked: Tracked) -> str:
    """Return the changes learned from the runs, in one line."""
    life, history = tracked.life, tracked.history
    parts = [f"{len(tracked.rows)} runs learned", f"{life.arrived} in all"]
    if tracked.known:
        parts.append(f"{tracked.known} known already")
    told = f"tracked: {', '.join(parts)}; {_largest_changes(tracked)}"
    if life.alarm:
        told += f"; learning is stopped: {life.alarm}"
    if tracked.mixed:
        told += f"; {tracked.mixed}"
    return told if history.path is None else f"{told}; history: {history.path}"


def _largest_changes(tracked: Tracked) -> str:
    """Return the largest changes of bias and of sag, with their deviations."""
    life = tracked.life
    unit = wear_unit(life.model).reshape(3, -1)
    share = np.divide(unit[0], unit[1], out=np.zeros_like(unit[0]), where=unit[1] > 0.0)
    in_angle = np.stack([np.ones_like(share), share])  # of a compliance: at the largest load
    (before, _), (after, doubt) = (one.offsets for one in (tracked.history.life, life))
    moved, doubt = in_angle * (after - before)[:2], in_angle * doubt[:2]
    told = []
    for kind, change, deviation in zip(("bias", "sag"), moved, doubt, strict=True):
        worst = int(np.argmax(np.abs(change)))
        degrees, error = np.rad2deg(change[worst]), np.rad2deg(deviation[worst])
        motor = life.model.motor_names[worst]
        told.append(f"{kind} of {motor} {degrees:+.2f} deg (deviation {error:.2f})")
    return f"largest changes: {', '.join(told)}"
