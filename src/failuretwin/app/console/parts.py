"""What the page of a robot and a replay share: reasons, motors, angles, what is asked for."""

from __future__ import annotations

import re
from collections.abc import Callable

from nicegui import run, ui

from failuretwin.app.console import draw, texts
from failuretwin.app.console import state as shown
from failuretwin.app.console.layout import Visit
from failuretwin.app.console.state import Trace
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import FloatArray
from failuretwin.decision.robot_state import robot_state
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.advice import STEP
from failuretwin.inference.explanation import percent

MOVEMENT = re.compile(r"movement (\d+)\b")
"""Begin of a reason that a movement gives."""


def reasons(
    visit: Visit,
    diagnosis: Diagnosis,
    trace: Trace,
    robot: Robot,
    movement: Callable[[str, float], object],
) -> None:
    """Draw why, and what to do now; `movement` draws a reason that leads to its time [s]."""
    draw.heading(texts.WHY)
    starts = dict(enumerate(trace.movements.tolist(), start=trace.first))
    for line in diagnosis.explanation:
        found = MOVEMENT.match(line)
        at = starts.get(int(found[1])) if found else None
        if at is not None:
            movement(visit.words(line, robot), at)
        elif not line.startswith(STEP):
            draw.text(visit.words(line, robot))
    draw.heading(texts.NEXT)
    draw.text(visit.words(robot_state([diagnosis], robot).step, robot))


def motor_table(robot: Robot, diagnosis: Diagnosis) -> None:
    """Draw the probability of a fault of each motor."""
    draw.heading(texts.MOTORS)
    shares = shown.motor_shares(robot.motor_names, diagnosis)
    rows = [[motor, percent(share)] for motor, share in shares.items()]
    draw.table((texts.MOTOR, texts.PROBABILITY), rows)


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

        rows: list[list[draw.Cell]] = [[name, cell, cell] for name in robot.motor_names]
        draw.table((texts.ANGLES, texts.TOLD, texts.DRAWN), rows)

    def show(self, command: FloatArray, pose: FloatArray) -> None:
        """Write the angles of two poses, (motor,) [rad]."""
        for k, cell in enumerate(self._cells):
            value = (command, pose)[k % 2][k // 2]
            cell.set_text(self._visit.angle(float(value), self._robot, k // 2))
