"""Charts over time: probabilities, residuals by motor, tool path."""

from __future__ import annotations

from typing import Any

import numpy as np
from nicegui import ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.state import Clock, Trace
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.inference.explanation import plain_name

MOST_POINTS = 600
"""Points of a chart."""
RESIDUAL_POINTS = 60
"""Points of the chart of residuals: each is solved for."""
GAP = 10.0
"""A sensor that is silent for so many times its usual distance of readings leaves a gap."""
MOST_LINES = 6
"""Hypotheses of the chart of probabilities."""
INTERESTING = 0.01
COLOURS = ("#2f7fd0", "#b3261e", "#1b8a4b", "#8a5a00", "#7a55b8", "#0f8a8a")
LABEL, GRID = "#7d8790", "#7d879055"
"""Colours of letters and of lines of the grid, on light and on dark pages."""

Line = tuple[str, FloatArray, FloatArray]
"""Name, times [s] and values; NaN is a gap. The second line of a name is dashed."""


def posterior_lines(trace: Trace, since_s: float) -> list[Line]:
    """Return the probabilities over time of the hypotheses that ever mattered."""
    kept = [(at, posterior) for at, posterior in trace.posterior if at >= since_s]
    most: dict[str, float] = {}
    for _, posterior in kept:
        for name, probability in posterior.items():
            most[name] = max(most.get(name, 0.0), probability)
    names = [name for name in sorted(most, key=lambda n: -most[n]) if most[name] >= INTERESTING]
    time = np.array([at for at, _ in kept])
    return [
        (
            plain_name(Hypothesis.parse(name)),
            time,
            np.array([posterior.get(name, np.nan) for _, posterior in kept]),
        )
        for name in names[:MOST_LINES]
    ]


def silences(time: FloatArray) -> FloatArray:
    """Return the middles of the gaps between readings, given the times of readings [s]."""
    if len(time) < 2:
        return np.zeros(0)
    distance = np.diff(time)
    long = distance > GAP * np.median(distance)
    return np.asarray(time[:-1][long] + 0.5 * distance[long])


def _broken(line: Line, silent: FloatArray) -> Line:
    """Return a line that is not drawn across times [s] at which the sensor was silent."""
    name, time, value = line
    at = np.searchsorted(time, silent)
    return name, np.insert(time, at, silent), np.insert(value, at, np.nan)


def residual_lines(trace: Trace, arm: InverseKinematics, since_s: float) -> list[Line]:
    """Return what remains of the tool error with each motor, over time [mm]."""
    rows = np.flatnonzero((trace.time >= since_s) & np.isfinite(trace.measured).all(axis=1))
    silent = silences(trace.time[rows])
    rows = rows[:: max(1, len(rows) // RESIDUAL_POINTS)]
    value = 1e3 * shown.residuals(arm, trace.command[rows], trace.measured[rows])
    names = [*map(draw.spoken, arm.robot.motor_names), texts.TOTAL]
    lines = [(name, trace.time[rows], one) for name, one in zip(names, value.T, strict=True)]
    return [_broken(line, silent) for line in lines]


def tool_lines(trace: Trace, known: CalibratedRobot, since_s: float) -> list[Line]:
    """Return the tool path as measured and as commanded [mm]."""
    rows = trace.time >= since_s
    seen = rows & np.isfinite(trace.measured).all(axis=1)
    path, lines = known.twin.path(trace.command[rows]), list[Line]()
    silent = silences(trace.time[seen])
    for k, axis in enumerate("xyz"):
        measured = axis, trace.time[seen], 1e3 * trace.measured[seen, k]
        lines.append(_broken(measured, silent))
        lines.append((axis, trace.time[rows], 1e3 * path[:, k]))
    return lines


class Chart:
    """A chart that is loaded once the page is shown.

    Args:
        title: What it shows, and the unit.
        note: How to read it; empty: it is plain.
        axis: Settings of the vertical axis.
    """

    def __init__(self, title: str, note: str = "", **axis: float) -> None:
        draw.heading(title)
        if note:
            draw.text(note).classes("soft")
        self._title, self._axis = title, axis
        self._clock: Clock | None = None
        self._chart: ui.echart | None = None
        self._place = ui.element("div").classes("chart")
        draw.later(self._load)

    def _load(self) -> None:
        grid = {"lineStyle": {"color": GRID}}
        label = {
            "axisLabel": {"color": LABEL, "hideOverlap": True},
            "splitLine": grid,
            "axisLine": grid,
        }
        axis: dict[str, Any] = {"type": "value", "scale": True, **label}
        options = {
            "animation": False,
            "color": COLOURS,
            "legend": {"top": 0, "itemWidth": 14, "itemGap": 8, "textStyle": {"color": LABEL}},
            "grid": {"left": 45, "right": 25, "top": 50, "bottom": 25},
            "xAxis": {**axis, "name": "s"},
            "yAxis": {**axis, **self._axis},
            "series": [],
        }
        with self._place:
            chart = ui.echart(options).classes("full")
        self._chart = chart.props(f'role="img" aria-label="{self._title}"')

    def show(self, lines: list[Line], clock: Clock | None) -> None:
        """Draw lines, over the time of day where it is known."""
        self._clock = clock
        if self._chart is not None:
            if clock is not None:
                self._chart.options["xAxis"] |= {"type": "time", "name": ""}
            self._chart.options["series"] = _series([
                (name, self._across(time), value) for name, time, value in lines
            ])  # fmt: skip

    def _across(self, time: FloatArray) -> FloatArray:
        """Return times [s] as they are drawn: seconds, or milliseconds since 1970."""
        clock = self._clock
        return time if clock is None else 1e3 * (clock.start + clock.pace * time)

    def mark(self, at: float) -> None:
        """Mark a time [s] with a line."""
        across = round(float(self._across(np.array(at))), 2)
        line = {"silent": True, "symbol": "none", "label": {"show": False}, "animation": False}
        told = {"series": [{"markLine": {**line, "data": [{"xAxis": across}]}}]}
        if self._chart is not None:
            self._chart.run_chart_method("setOption", told)


def _series(lines: list[Line]) -> list[dict[str, Any]]:
    names = list(dict.fromkeys(name for name, _, _ in lines))
    made: list[dict[str, Any]] = []
    for name, time, value in lines:
        drawn = np.arange(len(time)) % max(1, len(time) // MOST_POINTS) == 0
        drawn |= np.isnan(value)
        style = {"color": COLOURS[names.index(name) % len(COLOURS)]}
        if any(one["name"] == name for one in made):
            style["type"] = "dashed"
        made.append({
            "type": "line",
            "name": name,
            "showSymbol": False,
            "lineStyle": style,
            "itemStyle": {"color": style["color"]},
            "data": [
                [round(t, 2), None if np.isnan(v) else round(v, 4)]
                for t, v in zip(time[drawn].tolist(), value[drawn].tolist(), strict=True)
            ],
        })  # fmt: skip
    return made


class Charts:
    """Residuals and tool path of a trace, and its probabilities where they are known."""

    def __init__(self, known: CalibratedRobot, with_posterior: bool) -> None:
        self._known, self._arm = known, InverseKinematics.of(known.robot)
        self._posterior = Chart(texts.POSTERIOR, min=0.0, max=1.0) if with_posterior else None
        self._residuals = Chart(texts.RESIDUALS, texts.RESIDUAL_NOTE)
        self._tool = Chart(texts.TOOL, texts.TOOL_NOTE)

    def show(self, trace: Trace, since_s: float) -> None:
        """Draw a trace from a time on."""
        self._residuals.show(residual_lines(trace, self._arm, since_s), trace.clock)
        self._tool.show(tool_lines(trace, self._known, since_s), trace.clock)
        if self._posterior is not None:
            self._posterior.show(posterior_lines(trace, since_s), trace.clock)

    def mark(self, at: float) -> None:
        """Mark a time [s]."""
        for chart in (self._posterior, self._residuals, self._tool):
            if chart is not None:
                chart.mark(at)
