"""A diary of the work of an arm: what it did and why, for the terminal and the store."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from failuretwin.app.terminal import tell
from failuretwin.core.errors import InputError, counted
from failuretwin.decision.acting.session import AlarmChange
from failuretwin.decision.acting.task import TargetResult
from failuretwin.digital_model.calibrated_robot import CalibratedRobot

if TYPE_CHECKING:
    from failuretwin.app.remembering import RobotRecord


@dataclass
class Diary:
    """Entries about the work of an arm, in their order; calling it tells a line.

    Attributes:
        entries: The entries so far: when (UTC), and a sentence or a change of the alarm.
    """

    entries: list[tuple[datetime, str | AlarmChange]] = field(default_factory=list)

    def __call__(self, text: str) -> None:
        """Tell a line and note it."""
        self.note(text)
        tell(text)

    def note(self, *entries: str | AlarmChange) -> None:
        """Note entries."""
        self.entries += [(datetime.now(UTC), entry) for entry in entries]


@contextmanager
def noting(
    stored: RobotRecord | None, command: str, known: CalibratedRobot, method: str
) -> Iterator[Diary]:
    """Give a diary, which is stored as a session when the work is over.

    It is stored too where an error or Ctrl-C ends the work, with the reason. An arm never waits
    for the store.
    """
    diary = Diary()
    try:
        yield diary
    except (InputError, KeyboardInterrupt) as error:
        diary.note(f"ended: {error or 'Ctrl-C'}")
        raise
    finally:
        if stored is not None:
            for line in stored.remember_work(command, known, method, diary.entries):
                tell(line)


def target_line(result: TargetResult) -> str:
    """Return what became of a target, and why, in a line."""
    place = ", ".join(f"{axis:.3f}" for axis in result.target.position)
    end = "reached" if result.reached else f"given up, {result.why}"
    error = "not seen" if math.isnan(result.error_m) else f"{1e3 * result.error_m:.1f} mm off"
    believed = f"; believed {result.believed}" if result.believed else ""
    moves = counted(result.movements, "movement")
    return f"target ({place}) m: {end} after {moves}, {error}{believed}"
