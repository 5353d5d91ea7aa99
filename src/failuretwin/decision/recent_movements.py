"""Diagnosis of the last few movements of a stream, each time by the batch method anew."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.connection.links.values import OK, STALE, Answer
from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.runs import RunTable
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.decision.bayes import BayesDiagnoser

MOVEMENTS = 5
"""Movements that are looked at, the present one included."""
EVERY_S = 0.5
"""Time between two diagnoses [s]."""
REST_S = 0.25
"""Time after the end of a ramp from which the tool may be at rest [s]; before it nothing is new."""
SILENCE_S = 5.0
"""Without a reading for so long the answer is stale [s]; the bus of the ArmPi stalls for 4 s."""
STEP_S = 0.01
TURN_RAD = 1e-6
"""A reference that changes by more than this between two samples moves [rad]."""


class RecentMovements:
    """Looks at the last movements only, so that old faults and repairs are forgotten.

    Args:
        diagnoser: The batch method.
    """

    def __init__(self, diagnoser: BayesDiagnoser) -> None:
        self._diagnoser = diagnoser
        self._commands: list[tuple[float, FloatArray]] = []
        self._readings: list[tuple[float, FloatArray]] = []
        self._starts: deque[float] = deque(maxlen=MOVEMENTS)
        self._still = True
        self._still_from = -np.inf
        self._answer = Answer(0.0, STALE, None)
        self._next_s = -np.inf

    def update(
        self,
        time: float,
        command: Mapping[str, float] | ArrayLike | None,
        measured: ArrayLike | None,
    ) -> Answer:
        """Take what is known at a time and return what is believed then.

        Args:
            time: Time of the stream [s].
            command: Reference of every motor, by name or (motor,) [rad]; None: not known.
            measured: Tool position, (axis,) [m]; None: no reading.
        """
        if command is not None:
            self._add_command(time, command)
        if measured is not None and self._commands:
            self._readings.append((time, as_floats(measured)))
        newest = self._readings[-1][0] if self._readings else -np.inf
        state = STALE if time - newest > SILENCE_S else OK
        diagnosis = self._answer.diagnosis
        at_rest = self._still and time >= self._still_from + REST_S
        if measured is not None and self._starts and at_rest and time >= self._next_s:
            diagnosis = self._diagnose(time)
            self._next_s = time + EVERY_S
        self._answer = Answer(time, state, diagnosis)
        return self._answer

    def _add_command(self, time: float, command: Mapping[str, float] | ArrayLike) -> None:
        names = self._diagnoser.twin.robot.motor_names
        value = (
            as_floats([command[name] for name in names])
            if isinstance(command, Mapping)
            else as_floats(command)
        )
        if self._commands:
            before = self._commands[-1]
            still = bool(np.abs(value - before[1]).max() < TURN_RAD)
            if self._still and not still:
                self._starts.append(before[0])
                self._forget(self._starts[0])
            if not still:
                self._still_from = time
            self._still = still
        self._commands.append((time, value))

    def _forget(self, time: float) -> None:
        """Forget what lies before a time [s], but for the command that then stood."""
        later = [i for i, (at, _) in enumerate(self._commands) if at >= time]
        self._commands = self._commands[later[0] if later else -1 :]
        self._readings = [row for row in self._readings if row[0] >= time]

    def _diagnose(self, time: float) -> Diagnosis:
        begin = self._commands[0][0]
        grid = as_floats(np.arange(max(2, round((time - begin) / STEP_S) + 1)) * STEP_S)
        at, value = np.array([t for t, _ in self._commands]) - begin, self._commands
        command = np.stack(
            [np.interp(grid, at, [v[k] for _, v in value]) for k in range(len(value[0][1]))], axis=1
        )
        measured = np.full((len(grid), 3), np.nan)
        times = np.array([t for t, _ in self._readings]) - begin
        place = np.clip(np.rint(times / STEP_S).astype(int), 0, len(grid) - 1)
        measured[place] = [point for _, point in self._readings]
        rate = 1.0 / float(np.median(np.diff(times))) if len(times) > 1 else 1.0 / STEP_S
        names = self._diagnoser.twin.robot.motor_names
        table = RunTable(["stream"], names, grid, command[None], measured[None], rate)
        (diagnosis,) = self._diagnoser.diagnose(table.to_dataset())
        onset = diagnosis.onset_s
        return replace(diagnosis, onset_s=None if onset is None else onset + begin)
