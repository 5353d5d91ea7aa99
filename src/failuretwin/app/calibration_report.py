"""One self-contained HTML page from which an engineer judges a calibration. Needs `plots`."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin import __version__
from failuretwin.app.calibration_tables import (
    left_out_line,
    mean_gain,
    parameter_groups,
    verdict_line,
)
from failuretwin.app.plots import BLUE, GREY, RED, clean, environment, figure_class
from failuretwin.connection.calibration.cross_validation import (
    ExampleTransient,
    Predictions,
    example_transient,
    predict,
    settling_of,
)
from failuretwin.connection.calibration.result import Calibration, HeldOut
from failuretwin.core.runs import AXES
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot, shown_unit
from failuretwin.digital_model.settling import Settling

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Pictures of a calibration: what it expects, what is left, and how a ramp fits. Needs `plots`.

MOST_COLUMNS = 4
PANEL_IN = 3.2
WIDTH_IN = 11.6
DPI = 130
DIRECTIONS = ((1.0, BLUE, "towards larger angles"), (-1.0, RED, "towards smaller angles"))
LOAD_FLOOR_NM = 1e-3
"""Load torque below which a motor counts as unloaded in the pictures [N m]."""


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def channels(robot: Robot, of_motors: bool) -> tuple[list[str], float, str]:
    """Return name of each channel, factor and name of the unit that people read."""
    if not of_motors:
        return [f"tool {axis}" for axis in AXES], 1e3, "mm"
    scale, unit = shown_unit("rad", robot)
    return [name.replace("_", " ") for name in robot.motor_names], scale, unit


def _panels(count: int, height: float = PANEL_IN) -> tuple[Figure, list[Axes]]:
    columns = min(count, MOST_COLUMNS)
    rows = -(-count // columns)
    figure = figure_class()(figsize=(WIDTH_IN, height * rows + 0.4), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(count)]


def load_figure(seen: Predictions, settling: Settling, robot: Robot) -> Figure:
    """Return the settled error of each motor against its load, with the fitted lines.

    Args:
        seen: Settled errors of motors.
        settling: The calibration.
        robot: The robot.
    """
    names, scale, unit = channels(robot, True)
    figure, panels = _panels(len(names))
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
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
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("load torque [N m]" if loaded else "target [deg], no load", fontsize=9)
        _finish(panel)
    panels[0].set_ylabel(f"settled error [{unit}]")
    _legend(figure, panels[0])
    return figure


def expected_figure(seen: Predictions, robot: Robot) -> Figure:
    """Return settled errors against what was expected of them, each channel a panel."""
    names, scale, unit = channels(robot, seen.of_motors)
    figure, panels = _panels(len(names))
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        kept = seen.counts[:, k]
        expected, error = scale * seen.expected[kept, k], scale * seen.error[kept, k]
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
        panel.set_xlabel(f"expected error [{unit}]", fontsize=9)
        _finish(panel)
    panels[0].set_ylabel(f"settled error [{unit}]")
    _legend(figure, panels[0])
    return figure


def _reach(expected: FloatArray, error: FloatArray) -> float:
    """Return the limit of a square panel that a few outliers do not squeeze."""
    usual = float(np.quantile(np.abs(error), 0.975)) if len(error) else 0.0
    return 1.08 * max(1.5 * usual, float(np.abs(expected).max(initial=1e-9)))


def quantile_figure(seen: Predictions, dof: float, robot: Robot) -> Figure:
    """Return quantiles of what is left against those of the fitted Student t distribution."""
    from scipy.stats import beta, t

    names, _, _ = channels(robot, seen.of_motors)
    figure, panels = _panels(len(names))
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
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
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("expected quantile [scales]", fontsize=9)
        _finish(panel)
    panels[0].set_ylabel("what is left [scales]")
    _legend(figure, panels[0])
    return figure


def ramp_figure(ramp: ExampleTransient, robot: Robot) -> Figure:
    """Return one movement: command, twin before and after calibration, and readings."""
    names, scale, unit = channels(robot, ramp.of_motors)
    figure, panels = _panels(len(names), 3.2)
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        panel.plot(ramp.time, scale * ramp.command[:, k], color=GREY, lw=2.2, label="command")
        panel.plot(
            ramp.time, scale * ramp.plain[:, k], color=RED, lw=1.2, ls="--", label="uncalibrated"
        )
        panel.plot(ramp.time, scale * ramp.calibrated[:, k], color=BLUE, lw=1.4, label="calibrated")
        panel.plot(ramp.time, scale * ramp.reading[:, k], ".k", ms=6, label="readings")
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("time since the command [s]", fontsize=9)
        _finish(panel)
    panels[0].set_ylabel(f"{'angle' if ramp.of_motors else 'position'} [{unit}]")
    _legend(figure, panels[0])
    return figure


def session_figure(held_out: Sequence[HeldOut], robot: Robot, of_motors: bool) -> Figure:
    """Return the size of the settled error of each unseen session, before and after."""
    names, scale, unit = channels(robot, of_motors)
    columns = len(names)
    height = max(1.9, 0.34 * len(held_out) + 1.2)
    figure = figure_class()(figsize=(WIDTH_IN, height), layout="constrained")
    panels = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
    rows = np.arange(len(held_out))[::-1]
    before, after = (np.array([getattr(e, side) for e in held_out]) for side in ("before", "after"))
    for k, (panel, name) in enumerate(zip(panels, names, strict=True)):
        panel.barh(rows + 0.19, scale * before[:, k], 0.36, color=GREY, label="uncalibrated")
        panel.barh(rows - 0.19, scale * after[:, k], 0.36, color=BLUE, label="calibrated")
        panel.set_title(name, fontsize=10)
        panel.set_xlabel(f"settled error [{unit}]", fontsize=9)
        panel.set_yticks(rows, [entry.session for entry in held_out], fontsize=8)
        panel.tick_params(axis="y", length=0)
        panel.set_ylim(-0.6, len(held_out) - 0.4)
        _finish(panel)
    _legend(figure, panels[0])
    return figure


def _finish(panel: Axes) -> None:
    panel.tick_params(labelsize=8)
    clean(panel)


def _legend(figure: Figure, panel: Axes) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=9
    )


@dataclass(frozen=True)
class _Picture:
    """A picture with its words.

    Attributes:
        title: Heading.
        caption: How to read it.
        data: PNG file in base64.
    """

    title: str
    caption: str
    data: str


def write_calibration_page(
    found: Calibration, runs: xr.Dataset, robot: Robot, folder: Path
) -> None:
    """Write `index.html` with tables and pictures into `folder`.

    Args:
        found: The calibration.
        runs: The runs it was learned from or judged on.
        robot: The robot.
        folder: An existing folder.

    Raises:
        InputError: If jinja2 or matplotlib is missing.
    """
    template = (files("failuretwin.app") / "calibration.html.j2").read_text(encoding="utf-8")
    pictures = dict(_pictures(found, runs, robot))
    names, scale, unit = channels(robot, found.used_readings)
    page = environment().from_string(template)
    text = page.render(
        found=found,
        robot=robot.name,
        version=__version__,
        verdict=verdict_line(found).rstrip("."),
        grade=_grade(found),
        groups=parameter_groups(found, robot),
        count_deg=_count_degrees(robot),
        left_out=left_out_line(found),
        pictures=pictures,
        channels=names,
        unit=unit,
        scale=scale,
        payload=settling_of(found, robot).payload,
    )
    (folder / "index.html").write_text(text, encoding="utf-8")


def _grade(found: Calibration) -> str:
    """Return whether unseen sessions speak for the calibration: good, bad or unknown."""
    if not found.held_out:
        return "unknown"
    gain, half = mean_gain(found.held_out)
    return "good" if gain - half > 0.0 else "bad"


def _count_degrees(robot: Robot) -> float | None:
    """Return the size of a servo count [deg], positive if counts run against angles."""
    units = robot.profile.servo_units
    return None if units is None else units.deg_per_count


def _pictures(found: Calibration, runs: xr.Dataset, robot: Robot) -> Iterator[tuple[str, _Picture]]:
    seen, settling = predict(found, runs, robot), settling_of(found, robot)
    if found.held_out:
        yield (
            "sessions",
            _picture(
                png(session_figure(found.held_out, robot, found.used_readings)),
                "Size of the settled error by session",
                "1.48 times the median size of the error, the shorter the better.",
            ),
        )
    if seen.counts.any():
        yield (
            "expected",
            _picture(
                png(expected_figure(seen, robot)),
                "Settled error against prediction",
                "The uncalibrated twin expects no error at all (grey line); a perfect calibration "
                f"puts every point on the blue one. {_who_predicts(seen)} Above each panel: size "
                "of the error before and after.",
            ),
        )
        yield (
            "quantiles",
            _picture(
                png(quantile_figure(seen, settling.tail_dof, robot)),
                "Distribution of what is left",
                f"Against a Student t with {settling.tail_dof:.1f} degrees of freedom. Points that "
                "leave the band upwards on the right or downwards on the left are larger errors "
                f"than the calibration allows for. {_who_predicts(seen)}",
            ),
        )
    if seen.of_motors and seen.counts.any():
        yield (
            "load",
            _picture(
                png(load_figure(seen, settling, robot)),
                "What the arm's weight and friction do",
                "Settled error before calibration, one point a movement. The slope of the lines is "
                "the compliance, half their distance the friction, and their middle at no load the "
                "bias.",
            ),
        )
    ramp = example_transient(found, runs, robot)
    if ramp is not None:
        yield (
            "ramp",
            _picture(
                png(ramp_figure(ramp, robot)),
                f"A ramp: {ramp.run}, movement {ramp.movement}",
                "The movement with the median misfit of the longer half of all that began on time.",
            ),
        )


def _who_predicts(seen: Predictions) -> str:
    if seen.unseen:
        return "Each session is predicted by a fit that has not seen it."
    return "These movements are those that the fit has seen: there is no other session."


def _picture(data: bytes, title: str, caption: str) -> _Picture:
    return _Picture(title, caption, base64.b64encode(data).decode("ascii"))
