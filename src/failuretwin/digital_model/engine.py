"""Engines: from what the motors are told and what hampers them to the angles they take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.holding import hold
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import sag
from failuretwin.digital_model.twin import DigitalTwin

SAG_ROUNDS = 2
"""Rounds in which sag and pose settle together; each takes off all but a few hundredths."""


@dataclass(frozen=True)
class Drive:
    """What the motors of many runs are told, and what hampers them. Angles in the log's sense.

    Attributes:
        reference: Angles that the servo loops follow, (run, time, motor) [rad].
        held: When a motor is held by its gear, (run, time, motor); None: never.
        weakness: Share of its stiffness that a motor has lost, (run, time, motor) in [0, 1); None:
            none.
        compliance: How far each motor gives way under load, (run, motor) [rad/(N m)]; an engine
            with a stiffness of its own leaves it aside. None: rigid.
        payload: Mass carried at the tool point, (run,) [kg]; None: none.
    """

    reference: FloatArray
    held: BoolArray | None = None
    weakness: FloatArray | None = None
    compliance: FloatArray | None = None
    payload: FloatArray | None = None


class Engine(Protocol):
    """Moves a robot: the interface of the servo engine and of the physics engine."""

    @property
    def name(self) -> str:
        """What the engine is called on the command line."""
        ...

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles that the motors take, (run, time, motor) [rad], log's sense.

        The arm is at rest at the first reference when the run begins.

        Args:
            drive: What the motors are told, and what hampers them.
            time: Uniform grid, (time,) [s].
        """
        ...


@dataclass(frozen=True)
class ServoEngine:
    """The published twin: exact servo loops, rigid links; motors give way as far as they are told.

    Gravity pulls at the pose that the arm is really in, and a motor that is held does not give way.
    """

    robot: Robot
    name: str = "servo"

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles that the motors take, (run, time, motor) [rad], log's sense."""
        free = DigitalTwin(self.robot).respond(drive.reference, time)
        position = self._hold(free, drive, time)
        if drive.compliance is None:
            return position
        payload = 0.0 if drive.payload is None else drive.payload[:, None]
        for _ in range(SAG_ROUNDS):
            yielding = sag(self.robot, position, drive.compliance[:, None], payload)
            if drive.weakness is not None:
                yielding /= 1.0 - drive.weakness
            position = self._hold(free + yielding, drive, time)
        return position

    def _hold(self, position: FloatArray, drive: Drive, time: FloatArray) -> FloatArray:
        if drive.held is None:
            return position
        limits = np.array([motor.speed_limit for motor in self.robot.motors])
        return hold(position, drive.held, time, limits)
