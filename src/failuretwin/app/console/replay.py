"""A run as it was, or the last minutes of a live robot, with a slider of time."""

from __future__ import annotations

import numpy as np
from nicegui import ui

from failuretwin.app.console import draw, parts, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.arm import ArmScene
from failuretwin.app.console.charts import Charts
from failuretwin.app.console.desk import trace_of
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.state import Trace
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.decision.robot_state import robot_state
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.inverse_kinematics import InverseKinematics

PLAY_S = 0.1
"""Time between two steps [s]."""
CHARTS_S = 0.5
"""Time between two marks in the charts while it plays [s]."""


async def show(visit: Visit, name: str, run: int, at: float) -> None:
    """Draw the replay of a stored run, or (run 0) of the last minutes of a live robot."""
    desk = visit.desk
    live, known = desk.live.get(name), desk.robot(name)
    with page(visit, f"{texts.REPLAY}: {name}"):
        ui.link(name, draw.link_to("robot", name=name))
        if known is None:
            draw.alert(texts.NO_ROBOT)
            return
        trace = live.trace() if live is not None and run == 0 else None
        if trace is None:
            trace = await draw.worked(lambda: trace_of(*desk.stored_log(name, run)))
        if trace is None or not len(trace.time):
            draw.alert(texts.NO_LOG)
            return
        Replay(visit, trace, known, at)


class Replay:
    """A trace with a slider of its time."""

    def __init__(self, visit: Visit, trace: Trace, known: CalibratedRobot, at: float) -> None:
        self._visit, self._trace, self._robot = visit, trace, known.robot
        self._arm = InverseKinematics.of(known.robot)
        diagnosis = trace.diagnosis
        low, high = float(trace.time[0]), float(trace.time[-1])
        with ui.element("div").classes("columns"):
            with ui.element("section"):
                draw.heading(texts.ARM)
                self._scene = ArmScene(known.robot, texts.ARM)
                self._clock = draw.text("").props('role="status"')
                start = min(max(at, low), high)
                self._slider = draw.Slider((low, high), 0.02, start, texts.SLIDER, self._move)
                self._timer = ui.timer(PLAY_S, self._step, active=False)
                self._play = draw.button(texts.PLAY, self._toggle)
                self._angles = parts.Angles(visit, known.robot)
            with ui.element("section"):
                if diagnosis is not None:
                    draw.heading(texts.VERDICT)
                    draw.text(visit.words(diagnosis.verdict, known.robot))
                    parts.reasons(visit, diagnosis, trace, known.robot, self._button)
                    draw.heading(texts.NEXT)
                    draw.text(visit.words(robot_state([diagnosis], known.robot).step, known.robot))
                    parts.motor_table(known.robot, diagnosis)
                blind = texts.BLIND, texts.ASK_BLIND
                parts.asked(visit, known.robot, blind, lambda: visit.desk.blind_spots(trace, known))
            with ui.element("section"):
                self._charts = Charts(known, with_posterior=bool(trace.posterior))
                draw.later(self._draw_charts)
        self._marked = -np.inf
        self._move()

    def _button(self, reason: str, at: float) -> None:
        button = draw.button(reason, lambda: self._slider.go_to(at))
        button.props("flat align=left").classes("reason")

    def _toggle(self) -> None:
        self._timer.active = not self._timer.active
        self._play.set_text(texts.PAUSE if self._timer.active else texts.PLAY)

    def _step(self) -> None:
        end = float(self._trace.time[-1])
        self._slider.go_to(self._slider.value + PLAY_S)
        if self._slider.value >= end:
            self._toggle()

    def _diagnosis_at(self, at: float) -> Diagnosis | None:
        """Return what was believed at a time [s], where it was followed; else of the whole run."""
        before = [posterior for time, posterior in self._trace.posterior if time <= at]
        return Diagnosis("", before[-1]) if before else self._trace.diagnosis

    def _move(self) -> None:
        """Draw the moment of the slider."""
        trace, at = self._trace, self._slider.value
        k = int(np.clip(np.searchsorted(trace.time, at), 0, len(trace.time) - 1))
        seen = np.flatnonzero(np.isfinite(trace.measured).all(axis=1))
        near = seen[np.argmin(np.abs(trace.time[seen] - at))] if len(seen) else k
        diagnosis, motors = self._diagnosis_at(at), self._robot.motor_names
        suspects = shown.suspected_motors(motors, diagnosis)
        held = shown.held_motor(motors, suspects, trace.diagnosis)
        seen_there = trace.command[near], trace.measured[near]
        pose = shown.seen_pose(self._arm, *seen_there, suspects, held)
        self._scene.show(pose, trace.command[k], shown.motor_shares(motors, diagnosis))
        self._angles.show(trace.command[k], pose)
        told = self._visit.words(shown.moment(trace.clock, at), None)
        self._clock.set_text(told)
        if abs(at - self._marked) >= CHARTS_S or not self._timer.active:
            self._mark()

    def _draw_charts(self) -> None:
        self._charts.show(self._trace, -np.inf)
        self._mark()

    def _mark(self) -> None:
        """Mark the moment in the charts."""
        self._marked = self._slider.value
        self._charts.mark(self._marked)
