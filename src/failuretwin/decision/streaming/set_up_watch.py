"""Whether what a watch sees fits the profile, asked of the stream as `doctor` asks it of a log.

The stream is cut into runs of five movements. The first of them and the latest are weighed by
`SeenRuns.set_ups`, now and then at first, and before any motor is blamed.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import RAISED, Alarm, Hypothesis
from failuretwin.core.runs import concatenate, time_step
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.timed_log import Samples, TimedLog, timed_run
from failuretwin.decision.streaming.tracking import References
from failuretwin.decision.streaming.trouble import rests_throughout
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import plain_name
from failuretwin.inference.observation.rounding import Rounding, tool_rounding
from failuretwin.inference.seen_runs import SURE, TOLD, set_up_finding, set_up_remark
from failuretwin.inference.set_up_posterior import SetUpPosterior
from failuretwin.inference.set_up_weighing import FEW
from failuretwin.inference.set_ups.wrong_setup import MISFITS

if TYPE_CHECKING:
    import xarray as xr

RUN = 5
"""Movements of a run: as many as a run of the paper has."""
KEPT = FEW // 2
"""First runs that are kept, and latest ones: what was so from the beginning and what is so now."""
LONGEST_RUN_S = 60.0
"""A run that lasts longer is cut, whatever was commanded [s]."""
ASKED_AT = (10, 20, 40, 80, 160)
"""Movements after which the set-up is looked at though nobody is blamed."""
PROOF = 10
"""Movements before which an error is not blamed on a motor: zeros that are off look like it."""
CHANGES = 2
"""An alarm that has named another motor so often is none of a motor."""
AGAIN = 1.5
"""By what factor movements grow until an alarm that stands makes one look at the set-up again."""


@dataclass
class StreamRuns:
    """Cuts a stream into runs, each from the rest before its first movement on.

    Attributes:
        begun: Movements that have begun so far.
    """

    begun: int = 0
    _first: list[list[tuple[float, FloatArray, FloatArray]]] = field(default_factory=list)
    _latest: deque[list[tuple[float, FloatArray, FloatArray]]] = field(
        default_factory=lambda: deque(maxlen=KEPT)
    )
    _rows: list[tuple[float, FloatArray, FloatArray]] = field(default_factory=list)
    _in_run: int = 0
    _reference: References | None = None

    def add(self, time: float, command: FloatArray | None, point: FloatArray | None) -> None:
        """Take a sample.

        The reference is (motor,) [rad], None: not known; the point is (axis,) [m], None: no
        reading.
        """
        known = command is not None and bool(np.isfinite(command).all())
        if known and command is not None:
            self._follow(time, command)
        if self._reference is None:  # nothing was commanded yet
            return
        told = command if known and command is not None else np.nan * self._reference.last[0]
        self._rows.append((time, told, np.full(3, np.nan) if point is None else point))

    @property
    def points(self) -> FloatArray:
        """Tool positions that are kept, (reading, axis) [m]."""
        return np.array([row[2] for run in self._kept for row in run]).reshape(-1, 3)

    @property
    def _kept(self) -> list[list[tuple[float, FloatArray, FloatArray]]]:
        return [*self._first, *self._latest, self._rows]

    def _follow(self, time: float, command: FloatArray) -> None:
        """Note whether a movement begins, and where a run is over."""
        if self._reference is None:
            self._reference = References.empty(run=1, motor=len(command))
        moved = self._reference.moved
        moves = bool(moved[0])
        moved[self._reference.see(np.array([time]), command[None])] = False
        if self._reference.still[0] > 0:  # it does not turn
            return
        begins = bool(moved[0]) and not moves
        long = bool(self._rows) and time - self._rows[0][0] > LONGEST_RUN_S
        if (begins and self._in_run >= RUN) or long:
            self._cut()
        self.begun += begins
        self._in_run += begins

    def _cut(self) -> None:
        """End a run; the next one begins where this one rests."""
        known = [row for row in self._rows if np.isfinite(row[1]).all()]
        (self._first if len(self._first) < KEPT else self._latest).append(self._rows)
        self._rows, self._in_run = known[-1:], 0

    def runs(self, robot: Robot) -> xr.Dataset | None:
        """Return the first runs and the latest as a run set; None: there is nothing yet."""
        parts = []
        for number, rows in enumerate(self._kept):
            try:
                parts.append(timed_run(_log(f"run_{number + 1}", rows), robot).to_dataset())
            except InputError:  # too short, or its clock jumped
                continue
        if not parts:
            return None
        step = time_step(parts[0])
        return concatenate([part for part in parts if np.isclose(time_step(part), step)])


def _log(name: str, rows: list[tuple[float, FloatArray, FloatArray]]) -> TimedLog:
    """Return samples in the order of their times as a log."""
    rows = sorted(rows, key=lambda row: row[0])
    if not rows:
        raise InputError(f"{name}: holds no sample. Expected one at least.")
    time, command, point = (np.array(column) for column in zip(*rows, strict=True))
    time = time - time[0]
    told, seen = (np.isfinite(values).all(axis=1) for values in (command, point))
    return TimedLog(name, Samples(time[told], command[told]), Samples(time[seen], point[seen]))


class SetUpWatch:
    """Watches whether one robot is set up as its profile says.

    Attributes:
        rounding: How coarsely tool positions are rounded; None: it does not matter.
    """

    def __init__(self, diagnoser: BayesDiagnoser) -> None:
        self._diagnoser = diagnoser
        self.rounding: Rounding | None = None
        self._runs = StreamRuns()
        self._asked_at = 0
        self._fitted = False
        self._found: SetUpPosterior | None = None
        self._elsewhere = ""
        self._episode = 0
        self._proven = False
        self._blamed: list[str] = []

    @property
    def movements(self) -> int:
        """Movements that have begun so far."""
        return self._runs.begun

    @property
    def finding(self) -> str:
        """What is to be said of the set-up; empty: it fits, or nobody has looked yet.

        Where the log has fitted once, what nothing explains is not a matter of the set-up.
        """
        if self._found is None:
            return ""
        said = set_up_remark(self._found) if self._fitted else set_up_finding(self._found)
        elsewhere = f"{MISFITS}: {self._elsewhere}"
        return said or (elsewhere if self._elsewhere else "")

    @property
    def looked(self) -> bool:
        """Whether anybody has looked yet."""
        return self._found is not None

    def see(self, time: float, command: FloatArray | None, point: FloatArray | None) -> None:
        """Take a sample of the stream, and look at the set-up where that is due."""
        before = self._runs.begun
        self._runs.add(time, command, point)
        begins, model = self._runs.begun > before, self._diagnoser.healthy_model
        if begins and self.movements <= ASKED_AT[-1] and model.sensors.tool_alone:
            self.rounding = self.rounding or tool_rounding(self._runs.points, model)
        # A movement is over when the next one begins.
        due = begins and self._runs.begun - 1 in ASKED_AT
        if due and not self._episode:  # else it is looked at with the alarm
            self._ask()

    def against(self, alarm: Alarm) -> str:
        """Return why no motor may be blamed, whatever the alarm says; empty: it may."""
        if alarm.state == RAISED and alarm.episode is not None:
            return self._against_raised(alarm)
        self._episode, self._blamed = 0, []
        found = self._found
        if found is None or not self.finding:
            return ""
        sure = found.wrong >= SURE or not found.fits or bool(self._elsewhere)
        # What a calibration is for: it need not be wrong.
        return self.finding if sure and found.best.set_up.kind != "zero" else ""

    def _against_raised(self, alarm: Alarm) -> str:
        """Return why no motor may be blamed though there is an alarm."""
        assert alarm.episode is not None
        new = alarm.episode.number != self._episode
        if new:
            self._episode, motor = alarm.episode.number, alarm.cause.partition(":")[0]
            if motor not in self._blamed[-1:]:
                self._blamed.append(motor)
        young = self.movements <= PROOF
        eager = young and not is_held(alarm.cause)
        again = self.movements if eager else AGAIN * self._asked_at
        self._proven = self._proven and not new
        if new or not (young or self._proven) or self._asked_at < self.movements >= again:
            self._ask(thorough=new or not young)
            self._proven = not young
        if self.finding and not (is_held(alarm.cause) and self._may_be_a_zero):
            return self.finding
        if len(self._blamed) > CHANGES:
            named = " and ".join(m.replace("_", " ") for m in dict.fromkeys(self._blamed))
            if self._fitted:
                return (
                    f"{named} are blamed in turn: two faults at once look like this, and so does "
                    "a sensor that was moved"
                )
            return (
                f"{MISFITS}: the motor that is blamed changes ({named}), "
                "and no mistake that is known explains it"
            )
        if young and not is_held(alarm.cause):
            fault = plain_name(Hypothesis.parse(alarm.cause))
            return f"{fault}, or {MISFITS}: a few movements more tell"
        return ""

    @property
    def _may_be_a_zero(self) -> bool:
        """Whether nothing but a zero may be wrong, and need not be: no zero holds a motor."""
        found = self._found
        if found is None or found.wrong >= SURE or not found.fits:
            return False
        if self._elsewhere:
            return False
        pairs = zip(found.found, found.probability, strict=True)
        others = sum(share for one, share in pairs if one.set_up.kind not in ("", "zero"))
        return bool(others < TOLD)

    def _ask(self, thorough: bool = False) -> None:
        """Weigh the set-ups by the runs so far; see `SeenRuns.set_ups`.

        One that was found wrong before is not taken to be right because a fault fits as well.
        """
        self._asked_at = self.movements
        runs = self._runs.runs(self._diagnoser.twin.robot)
        if runs is None:
            return
        try:
            seen = self._diagnoser.seen(runs)
            evidence = seen.sample.evidence
            if not evidence.usable.any() or rests_throughout(evidence, seen.model.settings):
                return
            self._found = seen.set_ups(thorough or bool(self.finding))
        except InputError:  # no movement in it yet
            return
        as_told = self._found.fits and not self._found.best.set_up.what
        self._elsewhere = seen.elsewhere() if as_told else ""
        best = self._found.best
        self._fitted |= best.fits and not best.set_up.what and self.movements >= PROOF


def is_held(cause: str) -> bool:
    """Return whether a fault holds its motor, which no set-up does."""
    return all(
        MODES[fault.mode].signature is Signature.HELD for fault in Hypothesis.parse(cause).faults
    )
