"""One robot, live or as it was: the arm, the verdict and why, probabilities, residuals, replays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from failuretwin.app.console import state as shown
from failuretwin.app.console import texts
from failuretwin.app.console.arm import ArmScene
from failuretwin.app.console.layout import (
    Cell,
    Choice,
    Visit,
    button,
    heading,
    link_to,
    page,
    state_badge,
    table,
    text,
    worked,
)
from failuretwin.app.console.live import LiveRobot
from failuretwin.app.console.state import LiveView, Trace
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.reach import Reach, reach, workspace
from failuretwin.decision.robot_state import robot_state
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import percent

FRAME_S, CHART_S = 0.1, 1.0
"""Time between two pictures of the arm, and of the charts [s]."""
CHARTED_S = 60.0
"""Time that live charts show [s]."""
MOST_POINTS = 600
"""Points of a chart."""
RESIDUAL_POINTS = 60
"""Points of the chart of residuals: each is solved for."""
MOST_LINES = 6
"""Hypotheses of the chart of probabilities."""
INTERESTING = 0.01
REACH_POINTS = 150
"""Points of the workspace that are tried."""
COLOURS = ["#2f7fd0", "#b3261e", "#1b8a4b", "#8a5a00", "#7a55b8", "#0f8a8a", "#c2477f", "#5a6470"]
PLAY_S = 0.1
"""Time between two steps of a replay [s]."""


def show(visit: Visit, name: str) -> None:
    """Draw the page of a robot."""
    desk = visit.desk
    live, tile = desk.live.get(name), desk.tile(name)
    with page(visit, name):
        if tile is None:
            text(texts.NO_ROBOT).props('role="alert"')
            return
        with ui.row().classes("items-center gap-4"):
            ui.link(texts.HISTORY, link_to("history", name=name))
            ui.link(texts.CHECK, link_to("check", name=name))
        known = desk.robot(name)
        if live is not None:
            LivePage(visit, live)
        else:
            state_badge(tile.state)
            text(tile.said)
            text(visit.time(tile.heard)).classes("soft")
            _stored_arm(visit, name, known)
        _runs(visit, name)
        if known is not None:
            ReachPart(visit, known, None)
        _asked(texts.LIFE, texts.ASK_LIFE, lambda: desk.remaining_life(name), texts.LIFE_NOTE)


def _stored_arm(visit: Visit, name: str, known: CalibratedRobot | None) -> None:
    """Draw the arm at rest, coloured by the last diagnosis, and what to do."""
    runs = visit.desk.stored_runs(name)
    if known is None:
        text(texts.NO_PROFILE)
        return
    last = Diagnosis("", runs[0].posterior) if runs else None
    with ui.element("div").classes("columns"):
        with ui.element("section"):
            heading(texts.ARM)
            pose = known.robot.resting_pose
            shares = shown.motor_shares(known.robot.motor_names, last)
            ArmScene(known.robot, texts.ARM).show(pose, pose, shares)
        with ui.element("section"):
            if last is not None:
                heading(texts.NEXT)
                text(robot_state([last], known.robot).step)
                _motor_table(known, last)


def _motor_table(known: CalibratedRobot, diagnosis: Diagnosis) -> None:
    shares = shown.motor_shares(known.robot.motor_names, diagnosis)
    rows = [[motor, percent(share)] for motor, share in shares.items()]
    heading(texts.MOTORS)
    table((texts.MOTOR, texts.PROBABILITY), rows)


def _runs(visit: Visit, name: str) -> None:
    """Draw the list of stored runs, each with its replay."""
    runs = visit.desk.stored_runs(name)
    if not runs:
        return
    heading(texts.RUNS)

    def play(row: int, log: str) -> Callable[[], object]:
        if not Path(log).exists():
            return lambda: text(texts.NO_LOG, "span").classes("soft")
        address = link_to("replay", name=name, run=row)
        return lambda: ui.link(texts.PLAY, address).props(f'aria-label="{texts.PLAY} {row}"')

    rows: list[list[Cell]] = [
        [visit.time(one.at), one.name, one.verdict, play(one.row, one.log)] for one in runs
    ]
    table((texts.WHEN, texts.RUN, texts.VERDICT, texts.PLAY), rows)


def _asked(title: str, words: str, work: Callable[[], list[str]], note: str = "") -> None:
    """Draw a section whose lines are worked out when they are asked for."""
    heading(title)
    if note:
        text(note).classes("soft")
    lines = ui.element("div").props('role="status"')

    async def ask() -> None:
        lines.clear()
        with lines:
            text(texts.WORKING)
        found = await worked(work)
        lines.clear()
        with lines:
            for line in found or [texts.NOTHING]:
                text(line)

    button(words, ask)


class ReachPart:
    """What the arm can still reach, as a share and as points in a scene.

    Args:
        visit: The page.
        known: The robot.
        scene: Where points are drawn; None: in a scene of their own.
    """

    def __init__(self, visit: Visit, known: CalibratedRobot, scene: ArmScene | None) -> None:
        self._visit, self._known, self._scene = visit, known, scene
        heading(texts.REACH)
        names = known.robot.motor_names
        self._motor = Choice(["", *names], "", texts.MOTOR)
        self._angle = ui.number("deg", value=0.0).classes("w-28")
        self._line = text("").props('role="status"')
        self._place = ui.element("div")
        button(texts.ASK_REACH, self._ask)

    async def _ask(self) -> None:
        robot, motor = self._known.robot, self._motor.value
        angle = float(np.deg2rad(float(self._angle.value or 0.0)))
        held = (motor, angle) if motor in robot.motor_names else None
        found = await worked(_reach, self._known, held)
        if found is None:
            return
        said = texts.ALL_REACHED.format(share=found.share)
        if held is not None:
            told = self._visit.angle(angle, robot, robot.motor_names.index(motor))
            said = texts.REACHED.format(share=found.share, motor=motor, angle=told)
        self._line.set_text(said)
        if self._scene is None:
            with self._place:
                self._scene = ArmScene(robot, texts.REACH)
                self._scene.show(robot.resting_pose, robot.resting_pose, {})
        self._scene.points(found.points, found.reached)


def _reach(known: CalibratedRobot, held: tuple[str, float] | None) -> Reach:
    return reach(known.robot, workspace(known.robot, REACH_POINTS), held)


# Charts.


def chart(label: str, unit: str) -> ui.echart:
    """Draw an empty chart of lines over time."""
    axis: dict[str, Any] = {"type": "value", "scale": True}
    options = {
        "animation": False,
        "color": COLOURS,
        "legend": {"type": "scroll", "top": 0, "textStyle": {"color": "#7d8790"}},
        "grid": {"left": 55, "right": 15, "top": 45, "bottom": 30},
        "xAxis": {**axis, "min": "dataMin", "max": "dataMax"},
        "yAxis": {**axis, "name": unit},
        "series": [],
    }
    made = ui.echart(options).classes("w-full h-56")
    return made.props(f'role="img" aria-label="{label}"')


def lines_of(
    series: Mapping[str, tuple[FloatArray, FloatArray]], mark: float | None = None, dash: str = ""
) -> list[dict[str, Any]]:
    """Return the series of a chart: times [s] and values by name; NaN is a gap."""
    made = []
    for k, (name, (time, value)) in enumerate(series.items()):
        step = max(1, len(time) // MOST_POINTS)
        points = [
            [round(t, 2), None if np.isnan(v) else round(v, 4)]
            for t, v in zip(time[::step].tolist(), value[::step].tolist(), strict=True)
        ]
        style = {"type": "dashed"} if dash and dash in name else {}
        one = {
            "type": "line",
            "name": name,
            "data": points,
            "showSymbol": False,
            "lineStyle": style,
        }
        if k == 0 and mark is not None:
            line = {"silent": True, "symbol": "none", "label": {"show": False}}
            one["markLine"] = {**line, "data": [{"xAxis": round(mark, 2)}], "animation": False}
        made.append(one)
    return made


def posterior_lines(trace: Trace, since_s: float) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the probabilities over time of the hypotheses that ever mattered."""
    kept = [(at, posterior) for at, posterior in trace.posterior if at >= since_s]
    most: dict[str, float] = {}
    for _, posterior in kept:
        for name, probability in posterior.items():
            most[name] = max(most.get(name, 0.0), probability)
    names = [name for name in sorted(most, key=lambda n: -most[n]) if most[name] >= INTERESTING]
    time = np.array([at for at, _ in kept])
    return {
        name: (time, np.array([posterior.get(name, np.nan) for _, posterior in kept]))
        for name in names[:MOST_LINES]
    }


def residual_lines(
    trace: Trace, arm: InverseKinematics, since_s: float
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return what remains of the tool error with each motor, over time [mm]."""
    rows = np.flatnonzero((trace.time >= since_s) & np.isfinite(trace.measured).all(axis=1))
    rows = rows[:: max(1, len(rows) // RESIDUAL_POINTS)]
    value = shown.residuals(arm, trace.command[rows], trace.measured[rows])
    names = [*arm.robot.motor_names, texts.TOTAL]
    return {name: (trace.time[rows], 1e3 * value[:, k]) for k, name in enumerate(names)}


def tool_lines(
    trace: Trace, known: CalibratedRobot, since_s: float
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the tool path as commanded and as measured [mm]."""
    rows = trace.time >= since_s
    seen = rows & np.isfinite(trace.measured).all(axis=1)
    path, found = known.twin.path(trace.command[rows]), {}
    for k, axis in enumerate("xyz"):
        found[f"{axis} {texts.MEASURED}"] = trace.time[seen], 1e3 * trace.measured[seen, k]
        found[f"{axis} {texts.COMMANDED}"] = trace.time[rows], 1e3 * path[:, k]
    return found


class Charts:
    """Residuals and tool path of a trace, and its probabilities where they are known."""

    def __init__(self, known: CalibratedRobot, with_posterior: bool) -> None:
        self._known, self._arm = known, InverseKinematics.of(known.robot)
        self._posterior: ui.echart | None = None
        if with_posterior:
            heading(texts.POSTERIOR)
            self._posterior = chart(texts.POSTERIOR, "")
            self._posterior.options["yAxis"] |= {"min": 0.0, "max": 1.0}
        heading(texts.RESIDUALS)
        text(texts.RESIDUAL_NOTE).classes("soft")
        self._residuals = chart(texts.RESIDUALS, "mm")
        heading(texts.TOOL)
        self._tool = chart(texts.TOOL, "mm")

    def show(self, trace: Trace, since_s: float, mark: float | None = None) -> None:
        """Draw a trace from a time on; `mark` is where a replay is [s]."""
        if not len(trace.time):
            return
        found = residual_lines(trace, self._arm, since_s)
        self._residuals.options["series"] = lines_of(found, mark)
        self._tool.options["series"] = lines_of(
            tool_lines(trace, self._known, since_s), mark, texts.COMMANDED
        )
        if self._posterior is not None:
            lines = lines_of(posterior_lines(trace, since_s), mark)
            self._posterior.options["series"] = lines


# Why: the verdict and the movements behind it.


def why(diagnosis: Diagnosis, trace: Trace, go_to: Callable[[float], None]) -> None:
    """Draw the reasons of a diagnosis; a click on a movement goes to its time [s]."""
    for line in diagnosis.explanation:
        text(line)
    starts = dict(enumerate(trace.movements.tolist(), start=trace.first))
    with ui.row().classes("gap-2"):
        for one in diagnosis.evidence:
            at = starts.get(one.movement, one.time_s)
            if at is not None:
                words = texts.MOVEMENT_BUTTON.format(number=one.movement, nats=one.nats)
                button(words, lambda at=at: go_to(at)).props("outline")


class Angles:
    """Angles of the motors as told and as drawn, in the unit of the reader."""

    def __init__(self, visit: Visit, robot: Robot) -> None:
        self._visit, self._robot = visit, robot
        self._cells: list[ui.label] = []

        def cell() -> None:
            self._cells.append(text("", "span"))

        rows: list[list[Cell]] = [[name, cell, cell] for name in robot.motor_names]
        table((texts.ANGLES, texts.TOLD, texts.DRAWN), rows)

    def show(self, command: FloatArray, pose: FloatArray) -> None:
        """Write the angles of two poses, (motor,) [rad]."""
        for k, cell in enumerate(self._cells):
            value = (command, pose)[k % 2][k // 2]
            cell.set_text(self._visit.angle(float(value), self._robot, k // 2))


class LivePage:
    """The part of a page that follows a live robot."""

    def __init__(self, visit: Visit, live: LiveRobot) -> None:
        self._visit, self._live = visit, live
        self._known = live.settings.known
        self._arm = InverseKinematics.of(self._known.robot)
        self._said: object = None
        self._poses = (self._known.robot.resting_pose,) * 2
        with ui.element("div").classes("columns"):
            with ui.element("section"):
                heading(texts.ARM)
                self._scene = ArmScene(self._known.robot, texts.ARM)
                text(texts.ARM_NOTE).classes("soft")
                self._clock = text("").classes("soft")
                self._angles = Angles(visit, self._known.robot)
                ui.link(texts.REPLAY_LIVE, link_to("replay", name=live.settings.name, run=0))
            self._verdict = ui.element("section").props('aria-live="polite"')
            with ui.element("section"):
                self._charts = Charts(self._known, with_posterior=True)
            with ui.element("section"):
                heading(texts.CHANGES)
                self._changes = ui.element("div")
                _asked(
                    texts.BLIND,
                    texts.ASK_BLIND,
                    lambda: visit.desk.blind_spots(live.trace(), self._known),
                )
        ui.timer(FRAME_S, self._frame)
        ui.timer(CHART_S, self._second)

    def _frame(self) -> None:
        """Draw the arm as of the last reading."""
        view = self._live.view
        sample = view.sample
        if sample is None or sample.command is None:
            return
        motors = self._known.robot.motor_names
        suspects = shown.suspected_motors(motors, view.diagnosis)
        pose = shown.seen_pose(self._arm, sample.command, sample.tool, suspects)
        self._scene.show(pose, sample.command, shown.motor_shares(motors, view.diagnosis))
        self._poses = sample.command, pose
        read = datetime.fromtimestamp(sample.read, UTC)
        words = texts.READ_AT.format(time=self._visit.time(read, seconds=True))
        self._clock.set_text(words)
        self._clock.props(f'data-read="{sample.read:.3f}"')

    def _second(self) -> None:
        """Draw charts, and the verdict where it has changed."""
        view, trace = self._live.view, self._live.trace()
        if len(trace.time):
            self._charts.show(trace, float(trace.time[-1]) - CHARTED_S)
            self._angles.show(*self._poses)
        said = (view.tile.state, view.tile.said, view.diagnosis, len(view.changes))
        if said != self._said:
            self._said = said
            self._say(view, trace)

    def _say(self, view: LiveView, trace: Trace) -> None:
        self._verdict.clear()
        with self._verdict:
            heading(texts.VERDICT)
            state_badge(view.tile.state)
            text(view.tile.said)
            self._say_alarm(view)
            if view.diagnosis is not None:
                heading(texts.WHY)
                why(view.diagnosis, trace, self._go_to)
                heading(texts.NEXT)
                text(robot_state([view.diagnosis], self._known.robot).step)
            heading(texts.MOTORS)
            rows: Sequence[Sequence[str]] = [
                [one.name, one.state, percent(float(one.values.get("probability", 0))), one.message]
                for one in view.statuses[1:]
            ]
            table((texts.MOTOR, texts.STATE, texts.PROBABILITY, texts.SAYS), rows)
        self._changes.clear()
        with self._changes:
            for change in reversed(view.changes):
                text(str(change))

    def _say_alarm(self, view: LiveView) -> None:
        episode, diagnosis = view.alarm.episode, view.diagnosis
        if episode is not None and episode.cleared_s is None:
            heading(texts.SINCE)
            ago = view.stream_time - episode.raised_s
            at = datetime.fromtimestamp(datetime.now(UTC).timestamp() - ago, UTC)
            when = self._visit.time(at, seconds=True)
            text(texts.ALARM_SINCE.format(time=when, number=episode.number))
        if diagnosis is not None and diagnosis.probability is not None:
            heading(texts.HOW_SURE)
            text(f"{diagnosis.diagnosis}: {percent(diagnosis.probability)}")

    def _go_to(self, at: float) -> None:
        ui.navigate.to(link_to("replay", name=self._live.settings.name, run=0, at=f"{at:.2f}"))


# Replays.


async def replay(visit: Visit, name: str, run: int, at: float) -> None:
    """Draw the replay of a stored run, or (run 0) of the last minutes of a live robot."""
    desk = visit.desk
    live, known = desk.live.get(name), desk.robot(name)
    with page(visit, f"{texts.REPLAY}: {name}"):
        ui.link(name, link_to("robot", name=name))
        if known is None:
            text(texts.NO_ROBOT).props('role="alert"')
            return
        trace = live.trace() if live is not None and run == 0 else None
        if trace is None:
            trace = await worked(desk.stored_trace, name, run)
        if trace is None or not len(trace.time):
            text(texts.NO_LOG).props('role="alert"')
            return
        Replay(visit, trace, known, at)


class Replay:
    """A trace with a slider of its time."""

    def __init__(self, visit: Visit, trace: Trace, known: CalibratedRobot, at: float) -> None:
        self._visit, self._trace, self._known = visit, trace, known
        self._arm = InverseKinematics.of(known.robot)
        diagnosis = trace.diagnosis
        low, high = float(trace.time[0]), float(trace.time[-1])
        with ui.element("div").classes("columns"):
            with ui.element("section"):
                heading(texts.ARM)
                self._scene = ArmScene(known.robot, texts.ARM)
                self._clock = text("").props('role="status"')
                start = min(max(at, low), high)
                self._slider = ui.slider(
                    min=low, max=high, step=0.02, value=start, on_change=self._move
                )
                self._slider.props(f'aria-label="{texts.SLIDER}"')
                self._timer = ui.timer(PLAY_S, self._step, active=False)
                self._play = button(texts.PLAY, self._toggle)
                self._angles = Angles(visit, known.robot)
            with ui.element("section"):
                if diagnosis is not None:
                    heading(texts.VERDICT)
                    text(diagnosis.verdict)
                    heading(texts.WHY)
                    why(diagnosis, trace, self._go_to)
                    _motor_table(known, diagnosis)
                _asked(
                    texts.BLIND,
                    texts.ASK_BLIND,
                    lambda: visit.desk.blind_spots(trace, known),
                )
            with ui.element("section"):
                self._charts = Charts(known, with_posterior=bool(trace.posterior))
        self._charts_at = -np.inf
        self._move()

    def _go_to(self, at: float) -> None:
        self._slider.set_value(at)

    def _toggle(self) -> None:
        self._timer.active = not self._timer.active
        self._play.set_text(texts.PAUSE if self._timer.active else texts.PLAY)

    def _step(self) -> None:
        end = float(self._trace.time[-1])
        self._slider.set_value(min(float(self._slider.value) + PLAY_S, end))
        if float(self._slider.value) >= end:
            self._toggle()

    def _diagnosis_at(self, at: float) -> Diagnosis | None:
        """Return what was believed at a time [s], where it was followed; else of the whole run."""
        before = [posterior for time, posterior in self._trace.posterior if time <= at]
        return Diagnosis("", before[-1]) if before else self._trace.diagnosis

    def _move(self) -> None:
        """Draw the moment of the slider."""
        trace, at = self._trace, float(self._slider.value)
        k = int(np.clip(np.searchsorted(trace.time, at), 0, len(trace.time) - 1))
        seen = np.flatnonzero(np.isfinite(trace.measured).all(axis=1))
        near = seen[np.argmin(np.abs(trace.time[seen] - at))] if len(seen) else k
        diagnosis, motors = self._diagnosis_at(at), self._known.robot.motor_names
        suspects = shown.suspected_motors(motors, diagnosis)
        pose = shown.seen_pose(self._arm, trace.command[k], trace.measured[near], suspects)
        self._scene.show(pose, trace.command[k], shown.motor_shares(motors, diagnosis))
        self._angles.show(trace.command[k], pose)
        self._clock.set_text(texts.STREAM_TIME.format(time=at))
        if abs(at - self._charts_at) >= 0.5 or not self._timer.active:
            self._charts_at = at
            self._charts.show(trace, -np.inf, at)
