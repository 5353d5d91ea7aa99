"""A diary of the work of an arm: what it did and why, for the terminal and the store."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from failuretwin.app.terminal import tell
from failuretwin.core.errors import InputError, counted
from failuretwin.decision.acting.session import AlarmChange
from failuretwin.decision.acting.task import TargetResult
from failuretwin.digital_model.calibrated_robot import CalibratedRobot

if TYPE_CHECKING:
    from failuretwin.app.keepers import WorkKeeper
    from failuretwin.app.remembering import RobotRecord


@dataclass(frozen=True)
class Diary:
    """What is said of the work of an arm, as it happens; calling it tells a line.

    Attributes:
        keeper: What stores the entries; None: nothing does.
    """

    keeper: WorkKeeper | None

    def __call__(self, text: str) -> None:
        """Tell a line and note it."""
        self.note(text)
        tell(text)

    def note(self, entry: str | AlarmChange | TargetResult) -> None:
        """Note a sentence, a change of the alarm, or what became of a target."""
        if self.keeper is not None:
            text = target_line(entry) if isinstance(entry, TargetResult) else entry
            self.keeper.keep(datetime.now(UTC), text)


@contextmanager
def noting(stored: RobotRecord | None, known: CalibratedRobot, method: str) -> Iterator[Diary]:
    """Give a diary, which is stored as a session of `act` as the work goes on.

    Where an error or Ctrl-C ends the work, it holds the reason.
    """
    keeper = None
    if stored is not None:
        from failuretwin.app.keepers import WorkKeeper  # needs the extra `store`

        keeper = WorkKeeper(stored, stored.basis("act", method, known))
    diary = Diary(keeper)
    try:
        yield diary
    except (InputError, KeyboardInterrupt) as error:
        diary.note(f"ended: {error or 'Ctrl-C'}")
        raise
    finally:
        for line in () if keeper is None else keeper.end():
            tell(line)


def target_line(result: TargetResult) -> str:
    """Return what became of a target, and why, in a line."""
    place = ", ".join(f"{axis:.3f}" for axis in result.target.position)
    end = "reached" if result.reached else f"given up, {result.why}"
    error = "not seen" if math.isnan(result.error_m) else f"{1e3 * result.error_m:.1f} mm off"
    believed = f"; believed {result.believed}" if result.believed else ""
    moves = counted(result.movements, "movement")
    return f"target ({place}) m: {end} after {moves}, {error}{believed}"
