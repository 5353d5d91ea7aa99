"""The page of a robot: the arm, the verdict and why, probabilities, residuals, runs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from nicegui import ui

from failuretwin.app.console import draw, parts, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.arm import ArmScene
from failuretwin.app.console.charts import Charts
from failuretwin.app.console.layout import Visit, page
from failuretwin.app.console.live import LiveRobot
from failuretwin.app.console.state import LiveView, Tile
from failuretwin.core.foreign import printable
from failuretwin.data_knowledge.records.overview import StoredRun
from failuretwin.decision.acting.reach import Reach, reach, workspace
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import percent

FRAME_S, CHART_S = 0.1, 1.0
"""Time between two pictures of the arm, and of the charts [s]."""
CHARTED_S = 60.0
"""Time that live charts show [s]."""
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
        else:
            draw.badges(tile.states)
            draw.text(visit.words(tile.said, robot))
            draw.text(visit.time(tile.heard)).classes("soft")
            _stored_arm(visit, tile, known)
        _runs(visit, name, robot)
        if known is not None:
            ReachPart(visit, known)
        life = texts.LIFE, texts.ASK_LIFE
        parts.asked(visit, robot, life, lambda: desk.remaining_life(name), texts.LIFE_NOTE)


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
        if not Path(one.log).exists():
            return texts.NO_LOG
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
    draw.table((texts.WHEN, texts.RUN, texts.VERDICT, texts.PLAY, texts.REPORT), rows)


class ReachPart:
    """What the arm can still reach if a motor is held, as a share and as points in a scene."""

    def __init__(self, visit: Visit, known: CalibratedRobot) -> None:
        self._visit, self._known = visit, known
        self._scene: ArmScene | None = None
        draw.heading(texts.REACH)
        with ui.row().classes("items-end gap-4"):
            self._motor = draw.Choice(["", *known.robot.motor_names], "", texts.MOTOR)
            words = texts.ANGLE.format(unit=visit.unit_of(known.robot))
            start = visit.angle(0.0, known.robot, 0).split()[0]
            self._angle = ui.number(words, value=float(start)).classes("short")
            draw.button(texts.ASK_REACH, self._ask)
        self._line = draw.text("").props('role="status"')
        self._place = ui.element("div")

    async def _ask(self) -> None:
        robot, motor = self._known.robot, self._motor.value
        held = None
        if motor in robot.motor_names:
            at = robot.motor_names.index(motor)
            held = motor, self._visit.held(float(self._angle.value or 0.0), robot, at)
        found = await draw.worked(_reach, self._known, held)
        if found is None:
            return
        said = texts.ALL_REACHED.format(share=found.share)
        if held is not None:
            told = self._visit.angle(held[1], robot, robot.motor_names.index(motor))
            said = texts.REACHED.format(share=found.share, motor=motor, angle=told)
        self._line.set_text(said)
        if self._scene is None:
            with self._place:
                self._scene = ArmScene(robot, texts.REACH)
            self._scene.show(robot.resting_pose, robot.resting_pose, {})
        self._scene.points(found.points, found.reached)


def _reach(known: CalibratedRobot, held: tuple[str, float] | None) -> Reach:
    return reach(known.robot, workspace(known.robot, REACH_POINTS), held)


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
            self._verdict = ui.element("section").props('aria-live="polite"')
            with ui.element("section"):
                self._charts = Charts(self._known, with_posterior=True)
            with ui.element("section"):
                draw.heading(texts.CHANGES)
                self._changes = ui.element("div")
                parts.asked(
                    visit,
                    robot,
                    (texts.BLIND, texts.ASK_BLIND),
                    lambda: visit.desk.blind_spots(live.trace(), self._known),
                )
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
        pose = shown.seen_pose(self._arm, sample.command, sample.tool, suspects)
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
        view, tile = self._live.view, self._live.tile
        said = (tile.state, tile.said, view.diagnosis, len(view.changes))
        if said == self._said:
            return
        self._said, words, robot = said, self._visit.words, self._known.robot
        self._verdict.clear()
        with self._verdict:
            draw.heading(texts.VERDICT)
            draw.badges(tile.states)
            draw.text(words(tile.said, robot))
            self._say_alarm(view)
            if view.diagnosis is not None:
                trace = self._live.trace()
                parts.reasons(self._visit, view.diagnosis, trace, robot, self._link)
            if view.diagnosis is not None or tile.state == shown.STALE:
                parts.next_steps(self._visit, robot, tile, view.diagnosis)
            draw.heading(texts.MOTORS)
            rows = [
                [
                    one.name,
                    one.state,
                    percent(float(one.values.get("probability", 0))),
                    words(one.message, robot),
                ]
                for one in view.statuses[1:]
            ]
            draw.table((texts.MOTOR, texts.STATE, texts.PROBABILITY, texts.SAYS), rows)
        self._changes.clear()
        with self._changes:
            for change in reversed(view.changes):
                draw.text(words(str(change), robot))

    def _say_alarm(self, view: LiveView) -> None:
        episode, sample = view.alarm.episode, view.sample
        if episode is None or episode.cleared_s is not None or sample is None:
            return
        raised = datetime.fromtimestamp(sample.read - (sample.time - episode.raised_s), UTC)
        when = self._visit.time(raised, seconds=True)
        draw.text(texts.ALARM_SINCE.format(time=when, number=episode.number))

    def _link(self, reason: str, at: float) -> None:
        """Draw a link to a time [s]: unlike a button, it works while all is drawn anew."""
        address = draw.link_to("replay", name=self._live.settings.name, run=0, at=f"{at:.2f}")
        ui.link(printable(reason), address).classes("reason")
