"""Injection of faults into runs, stage by stage: movements, reference, gear, stiffness."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.fault import (
    INTERMITTENT,
    STEP,
    Course,
    FaultGroup,
    FaultValue,
    MotorMotion,
    MotorOrders,
    PerMovement,
)
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import CHANCE, LOST, OFFSET
from failuretwin.failure_behavior.registry import MODES


@dataclass(frozen=True)
class _Group:
    """Faults of one mode at one motor: their runs, and their places among a run's faults."""

    mode: FaultMode
    motor: int
    runs: IntArray
    places: Sequence[int]
    faults: FaultGroup

    def rows(self, values: FloatArray) -> FloatArray:
        """Return the part (run, ...) of `values` (run, ..., motor) for this group."""
        return np.asarray(values[self.runs, :, self.motor])


@dataclass(frozen=True)
class Injection:
    """The faults of many runs.

    Attributes:
        faults: Faults of each run.
        motors: Names of the motors in chain order.
        modes: The modes by id.
    """

    faults: Sequence[Sequence[FaultValue]]
    motors: Sequence[str]
    modes: Mapping[str, FaultMode]

    @cached_property
    def _groups(self) -> list[_Group]:
        members: dict[tuple[str, str], list[tuple[int, int]]] = {}
        for run, values in enumerate(self.faults):
            for place, value in enumerate(values):
                members.setdefault((value.fault.motor, value.fault.mode), []).append((run, place))
        return [
            _Group(
                mode=self.modes[mode],
                motor=self.motors.index(motor),
                runs=np.array([run for run, _ in found]),
                places=[place for _, place in found],
                faults=FaultGroup.of([self.faults[run][place] for run, place in found]),
            )
            for (motor, mode), found in members.items()
        ]

    def on_movements(self, movements: Movements, lost: BoolArray) -> tuple[Movements, BoolArray]:
        """Return the movements and lost commands with faults; the given objects without any.

        Args:
            movements: As commanded.
            lost: Commands lost in any case, (run, movement, motor).
        """
        target, ramp, gone = movements.target.copy(), movements.ramp_duration.copy(), lost.copy()
        acted = False
        for group in self._groups:
            orders = MotorOrders(
                target=group.rows(target),
                ramp_duration=group.rows(ramp),
                start=movements.start[group.runs],
                lost=gone[group.runs, :, group.motor],
            )
            followed = group.mode.on_movements(group.faults, orders)
            if followed is orders:
                continue
            acted = True
            target[group.runs, :, group.motor] = followed.target
            ramp[group.runs, :, group.motor] = followed.ramp_duration
            gone[group.runs, :, group.motor] = followed.lost
        if not acted:
            return movements, lost
        return replace(movements, target=target, ramp_duration=ramp), gone

    def on_reference(self, reference: FloatArray, time: FloatArray) -> FloatArray:
        """Return the reference of the servo loops, (run, time, motor) [rad].

        Args:
            reference: Reference of the movements, (run, time, motor) [rad]; returned unchanged
            where no
                fault acts on it.
            time: Uniform grid, (time,) [s].
        """
        followed = reference
        for group in self._groups:
            before = group.rows(followed)
            after = group.mode.on_reference(group.faults, before, time)
            if after is before:
                continue
            if np.shape(after) != before.shape or not np.isfinite(after).all():
                raise InputError(
                    f"fault mode {group.mode.mode!r}: on_reference gave {after!r:.60}. Expected "
                    f"finite angles [rad] of shape {before.shape}, (run, time)."
                )
            if followed is reference:
                followed = reference.copy()
            followed[group.runs, :, group.motor] = after
        return followed

    def held(self, time: FloatArray) -> BoolArray | None:
        """Return whether each motor is held by its gear, (run, time, motor); None: never."""
        return self._over_time(lambda mode, faults: mode.held(faults, time), time, bool)

    def weakness(self, time: FloatArray) -> FloatArray | None:
        """Return the lost share of stiffness, (run, time, motor) in [0, 1); None: none."""
        return self._over_time(lambda mode, faults: mode.weakness(faults, time), time, float)

    def _over_time(
        self,
        stage: Callable[[FaultMode, FaultGroup], np.ndarray | None],
        time: FloatArray,
        dtype: type,
    ) -> np.ndarray | None:
        """Return a stage's values of all faults, (run, time, motor); None without any."""
        merged: np.ndarray | None = None
        for group in self._groups:
            rows = stage(group.mode, group.faults)
            if rows is None:
                continue
            if merged is None:
                merged = np.zeros((len(self.faults), len(time), len(self.motors)), dtype=dtype)
            before = merged[group.runs, :, group.motor]
            merged[group.runs, :, group.motor] = np.maximum(before, rows)
        return merged

    def as_struck(
        self, position: FloatArray, time: FloatArray, start: FloatArray
    ) -> list[list[FaultValue]]:
        """Return the faults of each run with values from the motion, such as held angles.

        Args:
            position: Angles of the motors, (run, time, motor) [rad].
            time: Uniform grid, (time,) [s].
            start: Commanded start of each movement, (run, movement) [s].
        """
        struck = [list(values) for values in self.faults]
        for group in self._groups:
            motion = MotorMotion(group.rows(position), time, start[group.runs])
            observed = group.mode.as_struck(group.faults, motion)
            if observed is group.faults:
                continue
            for i, (run, place) in enumerate(zip(group.runs, group.places, strict=True)):
                struck[run][place] = replace(
                    struck[run][place],
                    magnitude=float(observed.magnitude[i]),
                    per_movement={name: rows[i] for name, rows in observed.per_movement.items()},
                )
        return struck


# Scheduled faults: motor, mode, start and repair.

FORM = "MOTOR:MODE@START or MOTOR:MODE@START-END with times in seconds, such as motor_3:stuck@40-80"


@dataclass(frozen=True)
class ScheduledFault:
    """A fault with a start and, where it is repaired, an end.

    Attributes:
        fault: Motor and mode.
        start_s: Its start [s].
        end_s: Its repair [s]; infinity: never.
    """

    fault: Fault
    start_s: float
    end_s: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < self.end_s:
            raise InputError(
                f"fault {self.fault} lasts from {self.start_s:g} to {self.end_s:g} s, expected a "
                "start of 0 or more and an end after it."
            )

    @property
    def course(self) -> Course:
        """Its severity over time: 0 or 1."""
        if math.isinf(self.end_s):
            return Course(STEP, self.start_s)
        return Course(INTERMITTENT, self.start_s, episodes=((self.start_s, self.end_s),))

    def overlaps(self, begin_s: float, end_s: float) -> bool:
        """Return whether it is present at any time in an interval [s]."""
        return self.start_s < end_s and begin_s < self.end_s

    @classmethod
    def parse(cls, text: str, motors: Sequence[str]) -> ScheduledFault:
        """Return the fault of a text form such as ``motor_3:stuck@40-80``.

        Args:
            text: The text.
            motors: Names of the robot's motors in chain order.

        Raises:
            InputError: If the text does not follow the form or names an unknown motor or mode.
        """
        match = re.fullmatch(r"([^@]+)@([\d.]+)(?:-([\d.]+))?", text.strip())
        try:
            name, *times = match.groups() if match else ()
            start, end = (math.inf if value is None else float(value) for value in times)
        except ValueError:
            raise InputError(f"fault {text!r} is not of the form {FORM}.") from None
        hypothesis = Hypothesis.parse(name, motors)
        if len(hypothesis.faults) != 1:
            raise InputError(f"fault {text!r} names no single fault. Expected {FORM}.")
        MODES.find(hypothesis.faults[0].mode)
        return cls(hypothesis.faults[0], start, end)


def state_at(schedule: Iterable[ScheduledFault], time_s: float, motors: Sequence[str]) -> str:
    """Return the true hypothesis at a time [s], as text."""
    there = [f.fault for f in schedule if f.start_s <= time_s < f.end_s]
    return str(Hypothesis(tuple(sorted(there, key=lambda fault: motors.index(fault.motor)))))


# Faults recorded in a run set.

_SURE, _NEVER = -1.0, 2.0
"""Chances below and above any share of lost commands."""


def replayed(detail: Mapping[str, Any]) -> FaultValue:
    """Return the fault that a run set's `FaultValue.detail` records."""
    magnitude, profile = detail["magnitude"], detail["profile"]
    course = Course(
        profile["shape"],
        detail["onset_s"],
        rise_s=profile.get("rise_s", 0.0),
        episodes=tuple((start, end) for start, end in profile.get("episodes_s", ())),
    )
    drawn: dict[str, PerMovement] = {}
    if LOST in detail:
        drawn[CHANCE] = np.where(detail[LOST], _SURE, _NEVER)
    if OFFSET in detail:  # as severe as they were: not to be made severe twice
        drawn[OFFSET] = np.asarray(detail[OFFSET], dtype=np.float64)
        course = Course(STEP, 0.0)
    return FaultValue(
        fault=Fault(detail["motor"], detail["mode"]),
        magnitude=np.nan if magnitude is None else float(magnitude),
        course=course,
        per_movement=drawn,
    )
