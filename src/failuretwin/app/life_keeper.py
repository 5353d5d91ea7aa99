"""The life of a robot in the store: the posterior of yesterday is the prior of today.

The random walk of the life filter is one a run, not one a day: a motor wears as it works, and no
records exist from which a walk over idle time could be stated. So what is stored is what the next
run begins with.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np

from failuretwin.app.remembering import RobotRecord
from failuretwin.app.terminal import tell
from failuretwin.connection.calibration.result import SETTLING_UNITS
from failuretwin.connection.tracked_diagnosis import History, start_of
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.records.beliefs import Belief, BeliefLine
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.rows import Basis
from failuretwin.inference.together.life_filter import OFFSETS, LifeFilter

KEEP_EVERY_S = 300.0
"""Time between two states that a watch stores while it learns [s]."""


class LifeKeeper:
    """Keeps what is believed of a robot from command to command.

    Args:
        stored: The robot in the store.
        follower: The command that follows it: ``diagnose`` or ``watch``.
    """

    def __init__(self, stored: RobotRecord, follower: str) -> None:
        self._stored = stored
        self._follower = follower
        self._line = BeliefLine(follower, "")
        self._after: int | None = None
        self._keys: tuple[str, ...] = ()
        self._runs = self._stored_runs = 0
        self._due_s = -np.inf

    def resumed(self, start: LifeFilter) -> LifeFilter:
        """Return what the last command believed; where there is none, `start`.

        Raises:
            InputError: If it is damaged.
        """
        record = self._stored
        self._line = BeliefLine(self._follower, json.dumps(start_of(start), sort_keys=True))
        found, unused = record.store.belief(record.name, self._line)
        if unused:
            text = f"what {record.store.name} holds of {record.name} is not used: {unused}"
            tell(f"{text}. Beginning anew", err=True)
        if found is None:
            return start
        self._runs = self._stored_runs = found.runs
        self._after, self._keys = found.number, tuple(str(row.get("key", "")) for row in found.rows)
        try:
            return start.resumed(found.arrays)
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{record.store.name}: belief {found.number} is damaged ({error!r}). Restore the "
                "store from a copy."
            ) from error

    def history(self, start: LifeFilter, cold: bool) -> History:
        """Return what has been seen of the robot before."""
        life = self.resumed(start)
        return History(life, cold, keys=self._keys)

    def keep(
        self, life: LifeFilter, rows: Sequence[Mapping[str, Any]], at: datetime | None
    ) -> None:
        """Store what is believed after new runs, the last of which is of a time (UTC; None: now).

        Raises:
            OutputError: If it could not be stored, or another command went on meanwhile.
        """
        if not rows:
            return
        record, begun = self._stored, life.begun
        basis = Basis("track", record.calibration_number, f"begun with {begun.name}", "P1")
        belief = Belief(life.arrived, life.to_arrays(), rows, self._after)
        found = _offsets(life)
        self._after = record.store.keep_belief(
            record.name,
            basis,
            self._line,
            belief,
            at or datetime.now(UTC),
            found,
            profile=record.profile,
        )

    def keep_watch(self, life: LifeFilter | None) -> str:
        """Store what a watch has learned, and return what was stored, in a line.

        Raises:
            OutputError: If it could not be stored, or another command went on meanwhile.
        """
        known = f"{self._runs} runs of movements known before"
        if life is None or life.arrived <= self._runs:
            return f"tracked: nothing new to learn; {known}"
        self._keep_new(life)
        return f"tracked: {life.arrived - self._runs} runs of movements learned; {known}"

    def learned(self, life: LifeFilter) -> None:
        """Store what a watch has learned so far, every `KEEP_EVERY_S`.

        A watch goes on where that fails; `keep_watch` stores all at its end.
        """
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + KEEP_EVERY_S
            with suppress(OutputError):
                self._keep_new(life)

    def _keep_new(self, life: LifeFilter) -> None:
        new = life.arrived - self._stored_runs
        if new > 0:
            self.keep(life, [{"runs": new, "movements": life.movements}], None)
            self._stored_runs = life.arrived


def _offsets(life: LifeFilter) -> list[MotorOffset]:
    """Return mean and deviation of theta, motor by motor."""
    mean, deviation = life.offsets
    return [
        MotorOffset(motor, name, float(mean[k, i]), float(deviation[k, i]), SETTLING_UNITS[name])
        for i, motor in enumerate(life.model.motor_names)
        for k, name in enumerate(OFFSETS)
        if np.isfinite(deviation[k, i])
    ]
