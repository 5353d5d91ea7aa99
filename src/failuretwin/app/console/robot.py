"""The page of a robot: the arm, the verdict and why, probabilities, residuals, runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from nicegui import ui

from failuretwin.app.console import draw, parts, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.arm import ArmScene
from failuretwin.app.console.charts import Charts
from failuretwin.app.console.desk import LOOK_S, has_log
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.live import LiveRobot
from failuretwin.app.console.state import LiveView, Tile
from failuretwin.connection.links.base import OK
from failuretwin.core.errors import InputError
from failuretwin.core.foreign import printable
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.records.queries import StoredRun
from failuretwin.decision.acting.reach import Reach, reach, workspace
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import percent

FRAME_S, CHART_S = 0.1, 1.0
"""Time between two pictures of the arm, and of the charts [s]."""
CHARTED_S = 60.0
"""Time that live charts show [s]."""
ROUNDED = 0.01
"""Angles beyond the travel of a motor that are still taken, since ends are rounded [rad, m]."""
STUCK_AT = r"[+-]?\d+(?:\.\d+)?"
"""Angle of a stuck motor in a verdict [deg]."""
REACH_POINTS = 150
"""Points of the workspace that are tried."""


def show(visit: Visit, name: str) -> None:
    """Draw the page of a robot."""
    desk = visit.desk
    live, tile = desk.live.get(name), desk.tile(name)
    with page(visit, name):
        if tile is None:
            draw.alert(texts.NO_ROBOT)
            return
        with ui.row().classes("items-center gap-4"):
            ui.link(texts.HISTORY, draw.link_to("history", name=name))
            ui.link(texts.CHECK, draw.link_to("check", name=name))
        known = desk.robot(name)
        robot = None if known is None else known.robot
        if live is not None:
            LivePage(visit, live)
        StoredPage(visit, name, known)
        if known is not None:
            ReachPart(visit, known, *_held_now(visit, name, known.robot))
        life = texts.LIFE, texts.ASK_LIFE
        parts.asked(visit, robot, life, lambda: desk.remaining_life(name), texts.LIFE_NOTE)


class StoredPage:
    """The part of a page that tells what is stored of a robot, drawn anew when that changes."""

    def __init__(self, visit: Visit, name: str, known: CalibratedRobot | None) -> None:
        self._visit, self._name, self._known = visit, name, known
        self._drawn: object = None
        self._place = ui.element("div")
        self._look()
        ui.timer(LOOK_S, self._look)

    def _look(self) -> None:
        desk, known = self._visit.desk, self._known
        live, tile = desk.live.get(self._name), desk.tile(self._name)
        if tile is None:
            return
        state = (tile.state, tile.mode) if live is None else ()
        told = desk.glance(self._name), state
        if told == self._drawn:
            return
        self._drawn = told
        self._place.clear()
        with self._place:
            robot = None if known is None else known.robot
            if live is None:
                draw.badges(tile.states)
                draw.text(self._visit.words(tile.said, robot))
                draw.text(self._visit.time(tile.heard)).classes("soft")
                _stored_arm(self._visit, tile, known)
            _runs(self._visit, self._name, robot)


def _stored_arm(visit: Visit, tile: Tile, known: CalibratedRobot | None) -> None:
    """Draw the arm at rest, coloured by the last diagnosis and open episodes, and what to do."""
    if known is None:
        draw.text(texts.NO_PROFILE)
        return
    last, alarms = visit.desk.last_diagnosis(tile.name), visit.desk.open_faults(tile.name)
    with ui.element("div").classes("columns"):
        with ui.element("section"):
            draw.heading(texts.ARM_AT_REST)
            pose = known.robot.resting_pose
            shares = shown.motor_shares(known.robot.motor_names, last)
            shares |= {fault.partition(":")[0]: 1.0 for fault in alarms}
            ArmScene(known.robot, texts.ARM_AT_REST).show(pose, pose, shares)
        with ui.element("section"):
            if last is not None:
                parts.next_steps(visit, known.robot, tile, last, alarms)
                parts.motor_table(known.robot, last, alarms)


def _runs(visit: Visit, name: str, robot: Robot | None) -> None:
    """Draw the list of stored runs, each with its replay and its page for technicians."""
    runs = visit.desk.stored_runs(name)
    if not runs:
        return
    draw.heading(texts.RUNS)

    def link(words: str, page_name: str, one: StoredRun) -> draw.Cell:
        if not has_log(one):
            return ""
        address = draw.link_to(page_name, name=name, run=one.row)
        return lambda: ui.link(words, address).props(f'aria-label="{words}: {one.row}"')

    rows: list[list[draw.Cell]] = [
        [
            visit.time(one.at),
            one.name,
            visit.words(one.verdict, robot),
            link(texts.PLAY, "replay", one),
            link(texts.REPORT, "technician", one),
        ]
        for one in runs
    ]
    heads = (texts.WHEN, texts.RUN, texts.VERDICT, texts.PLAY, texts.REPORT)
    draw.table(heads if any(map(has_log, runs)) else heads[:3], rows)
    if not all(map(has_log, runs)):
        draw.text(texts.NO_LOGS).classes("soft")


class ReachPart:
    """What the arm can still reach if a motor is held, as a share and as points in a scene."""

    def __init__(self, visit: Visit, known: CalibratedRobot, motor: str, angle: float) -> None:
        self._visit, self._known = visit, known
        self._scene: ArmScene | None = None
        draw.heading(texts.REACH)
        with ui.row().classes("items-end gap-4"):
            motors = known.robot.motor_names
            self._motor = draw.Choice(["", *motors], motor, texts.MOTOR, words=_or_none)
            words = texts.ANGLE.format(unit=visit.unit_of(known.robot))
            at = motors.index(motor) if motor else 0
            start = visit.angle(angle, known.robot, at).split()[0]
            self._angle = ui.number(words, value=float(start)).classes("short")
            draw.button(texts.ASK_REACH, self._ask)
        self._line = draw.text("").props('role="status"')
        self._place = ui.element("div")

    async def _ask(self) -> None:
        robot, told = self._known.robot, (self._motor.value, self._angle.value)
        found = await draw.worked(_reach, self._visit, self._known, *told)
        if found is None:
            return
        said = texts.ALL_REACHED.format(share=found.share)
        if found.motor:
            words = self._visit.angle(found.angle, robot, robot.motor_names.index(found.motor))
            said = texts.REACHED.format(
                share=found.share, motor=draw.spoken(found.motor), angle=words
            )
        self._line.set_text(said)
        if self._scene is None:
            with self._place:
                self._scene = ArmScene(robot, texts.REACH)
            self._scene.show(robot.resting_pose, robot.resting_pose, {})
        self._scene.points(found.points, found.reached)


def _or_none(motor: str) -> str:
    return draw.spoken(motor) or texts.NO_MOTOR


def _reach(visit: Visit, known: CalibratedRobot, motor: str, told: float | None) -> Reach:
    held = (motor, held_angle(visit, known.robot, motor, told)) if motor else None
    return reach(known.robot, workspace(known.robot, REACH_POINTS), held)


def held_angle(visit: Visit, robot: Robot, motor: str, told: float | None) -> float:
    """Return the angle [rad] or place [m] that somebody filled in, in the unit of the reader.

    Raises:
        InputError: If it is empty, or the motor cannot stand there.
    """
    if told is None:
        label = texts.ANGLE.format(unit=visit.unit_of(robot))
        raise InputError(texts.FILL_IN.format(label=label))
    at = robot.motor_names.index(motor)
    angle, (low, high) = visit.held(float(told), robot, at), robot.travel[at].tolist()
    if not low - ROUNDED <= angle <= high + ROUNDED:
        ends = (visit.angle(end, robot, at) for end in (low, high))
        raise InputError(
            texts.OUT_OF_RANGE.format(motor=draw.spoken(motor), low=next(ends), high=next(ends))
        )
    return angle


def _held_now(visit: Visit, name: str, robot: Robot) -> tuple[str, float]:
    """Return the motor that is suspected most, empty: none, and where it stands [rad]."""
    desk = visit.desk
    live, runs = desk.live.get(name), desk.stored_runs(name)
    diagnosis = desk.last_diagnosis(name) if live is None else live.view.diagnosis
    said = live.tile.said if live is not None else runs[0].verdict if runs else ""
    return suspect_and_angle(robot, diagnosis, said)


def suspect_and_angle(robot: Robot, diagnosis: Diagnosis | None, said: str) -> tuple[str, float]:
    """Return the motor that is suspected most, and where a verdict says that it stands [rad].

    No motor is an empty name; an angle that the verdict does not tell is that at rest.
    """
    shares = shown.motor_shares(robot.motor_names, diagnosis)
    motor = max(shares, key=lambda one: shares[one])
    if shares[motor] < shown.SUSPECT:
        return "", 0.0
    found = re.search(
        rf"{motor.replace('_', ' ')}\b(?: \([^)]*\))? stuck at ({STUCK_AT}) deg", said
    )
    at = robot.motor_names.index(motor)
    return motor, float(np.deg2rad(float(found[1])) if found else robot.resting_pose[at])


class LivePage:
    """The part of a page that follows a live robot."""

    def __init__(self, visit: Visit, live: LiveRobot) -> None:
        self._visit, self._live = visit, live
        self._known = live.settings.known
        robot = self._known.robot
        self._arm = InverseKinematics.of(robot)
        self._said: object = None
        self._poses = (robot.resting_pose,) * 2
        with ui.element("div").classes("columns"):
            with ui.element("section"):
                draw.heading(texts.ARM)
                self._scene = ArmScene(robot, texts.ARM)
                draw.text(texts.ARM_NOTE).classes("soft")
                self._clock = draw.text("").classes("soft")
                self._angles = parts.Angles(visit, robot)
                ui.link(texts.REPLAY_LIVE, draw.link_to("replay", name=live.settings.name, run=0))
            with ui.element("section"):
                self._verdict = ui.element("div").props('aria-live="polite"')
                draw.heading(texts.CHANGES)
                self._changes = ui.element("div")
                parts.asked(
                    visit,
                    robot,
                    (texts.BLIND, texts.ASK_BLIND),
                    lambda: visit.desk.blind_spots(live.trace(), self._known),
                )
            with ui.element("section"):
                self._charts = Charts(self._known, with_posterior=True)
        self._say()
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
        held = shown.held_motor(motors, suspects, view.diagnosis)
        pose = shown.seen_pose(self._arm, sample.command, sample.tool, suspects, held)
        self._scene.show(pose, sample.command, shown.motor_shares(motors, view.diagnosis))
        self._poses = sample.command, pose
        read = datetime.fromtimestamp(sample.read, UTC)
        words = texts.READ_AT.format(time=self._visit.time(read, seconds=True))
        self._clock.set_text(words)
        self._clock.props(f'data-read="{sample.read:.3f}"')

    def _second(self) -> None:
        """Draw charts, and the verdict where it has changed."""
        trace = self._live.trace()
        if len(trace.time):
            self._charts.show(trace, float(trace.time[-1]) - CHARTED_S)
            self._angles.show(*self._poses)
        self._say()

    def _say(self) -> None:
        """Tell the verdict, unless it stands there."""
        view, desk = self._live.view, self._visit.desk
        tile = desk.tile(self._live.settings.name) or view.tile
        alarms = desk.open_faults(tile.name)
        said = (tile.state, tile.said, view.diagnosis, view.changes, alarms)
        if said == self._said:
            return
        self._said, words, robot = said, self._visit.words, self._known.robot
        self._verdict.clear()
        with self._verdict:
            draw.heading(texts.VERDICT)
            draw.badges(tile.states)
            draw.text(words(tile.said, robot))
            self._say_alarm(view)
            self._say_stored(alarms)
            if view.diagnosis is not None:
                trace = self._live.trace()
                parts.reasons(self._visit, view.diagnosis, trace, robot, self._link)
            if view.diagnosis is not None or tile.state == shown.STALE:
                parts.next_steps(self._visit, robot, tile, view.diagnosis, alarms)
            draw.heading(texts.MOTORS)
            rows = [
                [
                    draw.spoken(one.name),
                    texts.STATES[shown.STATES[one.state]],
                    percent(float(one.values.get("probability", 0))),
                    "" if one.state == OK else one.values.get("mode", "").replace("_", " "),
                ]
                for one in view.statuses[1:]
            ]
            draw.table((texts.MOTOR, texts.STATE, texts.PROBABILITY, texts.FAULT), rows)
        self._changes.clear()
        with self._changes:
            for change in reversed(view.changes):
                draw.text(words(change, robot))

    def _say_alarm(self, view: LiveView) -> None:
        episode = view.alarm.episode
        if episode is None or episode.cleared_s is not None:
            return
        told = texts.ALARM_SINCE.format(time=self._live.at(episode.raised_s), number=episode.number)
        draw.text(self._visit.words(told, self._known.robot))

    def _say_stored(self, alarms: Sequence[str]) -> None:
        """Tell the open episodes of the store, each with a link to the history."""
        name = self._live.settings.name
        for one in self._visit.desk.open_episodes(name) if alarms else []:
            when = self._visit.time(one.since, seconds=True)
            said = {"time": when, "fault": one.fault, "state": one.state, "number": one.number}
            address = draw.link_to("history", name=name)
            ui.link(texts.STORED_SINCE.format(**said), address).classes("reason")

    def _link(self, reason: str, at: float) -> None:
        """Draw a link to a time [s]: unlike a button, it works while all is drawn anew."""
        address = draw.link_to("replay", name=self._live.settings.name, run=0, at=f"{at:.2f}")
        link = ui.link(printable(reason), address).classes("reason")
        link.props(f'name="{reason.partition(":")[0]}"')  # kept in focus while its figures change
