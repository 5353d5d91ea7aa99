"""Faults into runs, stage by stage: movements, reference, gear, stiffness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.fault_value import FaultGroup, FaultValue
from failuretwin.failure_behavior.modes.base import FaultMode, MotorMotion, MotorOrders


@dataclass(frozen=True)
class _Group:
    """Faults of one mode at one motor: who has them, and where they stand among a run's faults."""

    mode: FaultMode
    motor: int
    runs: IntArray
    places: Sequence[int]
    faults: FaultGroup

    def rows(self, values: FloatArray) -> FloatArray:
        """Return the group's part (run, ...) of `values` (run, ..., motor)."""
        return np.asarray(values[self.runs, :, self.motor])


@dataclass(frozen=True)
class Injection:
    """The faults of many runs, ready to act.

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
        """Return the movements that the motors are really told to make.

        Args:
            movements: As commanded.
            lost: Commands that do not arrive anyway, (run, movement, motor).

        Returns:
            Movements and lost commands; the given objects where no fault acts on them.
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
        """Return the reference that the servo loops follow.

        Args:
            reference: As the movements have it, (run, time, motor) [rad].
            time: Uniform grid, (time,) [s].

        Returns:
            (run, time, motor) [rad]: a new array, or the given one where no fault acts on it.
        """
        followed = reference
        for group in self._groups:
            before = group.rows(followed)
            after = group.mode.on_reference(group.faults, before, time)
            if after is before:
                continue
            if followed is reference:
                followed = reference.copy()
            followed[group.runs, :, group.motor] = after
        return followed

    def held(self, time: FloatArray) -> BoolArray | None:
        """Return when which motor is held by its gear.

        Args:
            time: Uniform grid, (time,) [s].

        Returns:
            (run, time, motor); None where none ever is.
        """
        held = None
        for group in self._groups:
            rows = group.mode.held(group.faults, time)
            if rows is None:
                continue
            if held is None:
                held = np.zeros((len(self.faults), len(time), len(self.motors)), dtype=bool)
            held[group.runs, :, group.motor] |= rows
        return held

    def weakness(self, time: FloatArray) -> FloatArray | None:
        """Return the share of stiffness that each motor has lost.

        Args:
            time: Uniform grid, (time,) [s].

        Returns:
            (run, time, motor) in [0, 1); None where none has lost any.
        """
        weakness = None
        for group in self._groups:
            rows = group.mode.weakness(group.faults, time)
            if rows is None:
                continue
            if weakness is None:
                weakness = np.zeros((len(self.faults), len(time), len(self.motors)))
            weakness[group.runs, :, group.motor] = rows
        return weakness

    def as_struck(
        self, position: FloatArray, time: FloatArray, start: FloatArray
    ) -> list[list[FaultValue]]:
        """Return the faults of each run with what only the motion tells, such as held angles.

        Args:
            position: Angles of the motors, (run, time, motor) [rad].
            time: Uniform grid, (time,) [s].
            start: When movements were commanded, (run, movement) [s].
        """
        struck = [list(values) for values in self.faults]
        for group in self._groups:
            motion = MotorMotion(group.rows(position), time, start[group.runs])
            told = group.mode.as_struck(group.faults, motion)
            if told is group.faults:
                continue
            for i, (run, place) in enumerate(zip(group.runs, group.places, strict=True)):
                struck[run][place] = replace(
                    struck[run][place],
                    magnitude=float(told.magnitude[i]),
                    per_movement={name: rows[i] for name, rows in told.per_movement.items()},
                )
        return struck
