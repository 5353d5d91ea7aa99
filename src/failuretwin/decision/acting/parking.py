"""Where to park a motor that still goes where it is told, before it stops where that helps least.

    angle* = argmax over angles of how many of the next targets the other motors reach with it there

Of angles that are as good, the one nearest to where it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.decision.acting.reach import ANGLES, reach
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import Target, Task
from failuretwin.digital_model.inverse_kinematics import usable_limits

LOOKED_AHEAD = 12
"""So many of the next targets say where a motor is parked."""


@dataclass(frozen=True)
class ParkingPlace:
    """Where to park a motor.

    Attributes:
        angle: Where [rad].
        reached: How many of the next targets the others reach then.
        targets: Of how many.
    """

    angle: float
    reached: int
    targets: int

    def told(self, motor: str) -> str:
        """Return it in words."""
        return (
            f"{motor} is parked at {np.rad2deg(self.angle):.0f} deg before it stops elsewhere: "
            f"{self.reached} of the next {self.targets} targets can be reached without it"
        )


def parking_place(
    gate: SafetyGate, motor: int, targets: Sequence[Target], stands: float
) -> ParkingPlace:
    """Return where to park a motor.

    Args:
        gate: The arm, and what is safe.
        motor: Index of the motor.
        targets: Targets that are left, in their order; at least one.
        stands: Where the motor stands [rad].
    """
    low, high = (ends[motor] for ends in usable_limits(gate.robot))
    angle = np.append(np.linspace(low, high, ANGLES + 2)[1:-1], np.clip(stands, low, high))
    name, near = gate.robot.motor_names[motor], Task(tuple(targets[:LOOKED_AHEAD]))
    reached = [int(reach(gate, near, (name, float(a))).reached.sum()) for a in angle]
    best = int(np.lexsort((np.abs(angle - stands), -np.array(reached)))[0])
    return ParkingPlace(float(angle[best]), reached[best], len(near.targets))
