"""What the page of a robot and a replay share: reasons, motors, angles, what is asked for."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

from nicegui import run, ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.layout import Visit
from failuretwin.app.console.state import Tile, Trace
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.robot_state import SET_UP_STEP, robot_state
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.registry import plain_fault
from failuretwin.inference.advice import NOTHING_TO_DO, STEP
from failuretwin.inference.explanation import joint_names_in, percent, plain_name

MOVEMENT = re.compile(r"movement (\d+)\b")
"""Begin of a reason that a movement gives."""


def reasons(
    visit: Visit,
    diagnosis: Diagnosis,
    trace: Trace,
    robot: Robot,
    movement: Callable[[str, float], object],
) -> None:
    """Draw why; `movement` draws a reason that leads to the end of its movement [s]."""
    draw.heading(texts.WHY)
    for line in diagnosis.explanation:
        found = MOVEMENT.match(line)
        at = trace.end_of(int(found[1])) if found else None
        if at is not None:
            movement(visit.words(line, robot), at)
        elif not line.startswith(STEP):
            draw.text(visit.words(line, robot))


def next_steps(
    visit: Visit, robot: Robot, tile: Tile, diagnosis: Diagnosis | None, alarms: Sequence[str] = ()
) -> None:
    """Draw what to do now about a robot: its silence and open alarms first; see `step_lines`."""
    draw.heading(texts.NEXT)
    for line in step_lines(robot, tile, visit.time(tile.heard), diagnosis, alarms):
        draw.text(visit.words(line, robot))


def step_lines(
    robot: Robot, tile: Tile, heard: str, diagnosis: Diagnosis | None, alarms: Sequence[str]
) -> list[str]:
    """Return what to do now, a line each.

    Args:
        robot: The robot.
        tile: It on the wall.
        heard: When it was last heard, in words.
        diagnosis: Its last diagnosis; None: none.
        alarms: Faults of its open episodes, ``MOTOR:MODE``.
    """
    lines = [texts.SILENT.format(time=heard)] if tile.state == shown.STALE else []
    if diagnosis is None:
        return lines
    if diagnosis.undecided and tile.set_up:
        return [*lines, SET_UP_STEP.format(doubt=tile.set_up)]
    doubted = replace(diagnosis, quality=(*diagnosis.quality, tile.set_up))
    found = robot_state([doubted], robot)
    for alarm in map(Hypothesis.parse, alarms):
        if alarm.faults[0].motor not in found.state.motors:  # the last run does not show it
            told = texts.OPEN_ALARM.format(fault=plain_name(alarm))
            lines.append(joint_names_in(told, robot))
    return lines if lines and found.step == NOTHING_TO_DO else [*lines, found.step]


def motor_table(robot: Robot, diagnosis: Diagnosis, alarms: Sequence[str] | None = None) -> None:
    """Draw the probability of a fault of each motor, and its open episodes if they are given."""
    draw.heading(texts.MOTORS)
    shares = shown.motor_shares(robot.motor_names, diagnosis)
    rows = [[draw.spoken(motor), percent(share)] for motor, share in shares.items()]
    heads: tuple[str, ...] = (texts.MOTOR, texts.PROBABILITY)
    if alarms is not None:
        heads = (*heads, texts.OPEN_EPISODES)
        faults = [fault for one in alarms for fault in Hypothesis.parse(one).faults]
        for row, motor in zip(rows, shares, strict=True):
            row.append(", ".join(plain_fault(fault) for fault in faults if fault.motor == motor))
    draw.table(heads, rows)


def asked(
    visit: Visit,
    robot: Robot | None,
    heads: tuple[str, str],
    work: Callable[[], list[str]],
    note: str = "",
) -> None:
    """Draw a section whose lines are worked out when they are asked for.

    Args:
        visit: The page.
        robot: The robot that the lines are of; None: its profile is not known.
        heads: Its heading, and the words of its button.
        work: Returns the lines.
        note: What to know first; empty: nothing.
    """
    draw.heading(heads[0])
    if note:
        draw.text(note).classes("soft")
    lines = ui.element("div").props('role="status"')

    async def ask() -> None:
        lines.clear()
        with lines:
            draw.text(texts.WORKING)
        try:
            found = await run.io_bound(work)
        except FailureTwinError as error:
            found = [str(error)]
        lines.clear()
        with lines:
            for line in found or [texts.NOTHING]:
                draw.text(visit.words(line, robot))

    draw.button(heads[1], ask)


class Angles:
    """Angles of the motors as told and as drawn, in the unit of the reader."""

    def __init__(self, visit: Visit, robot: Robot) -> None:
        self._visit, self._robot = visit, robot
        self._cells: list[ui.label] = []

        def cell() -> None:
            self._cells.append(draw.text("", "span"))

        rows: list[list[draw.Cell]] = [
            [draw.spoken(name), cell, cell] for name in robot.motor_names
        ]
        draw.table((texts.ANGLES, texts.TOLD, texts.DRAWN), rows)

    def show(self, command: FloatArray, pose: FloatArray) -> None:
        """Write the angles of two poses, (motor,) [rad]."""
        for k, cell in enumerate(self._cells):
            value = (command, pose)[k % 2][k // 2]
            cell.set_text(self._visit.angle(float(value), self._robot, k // 2))
