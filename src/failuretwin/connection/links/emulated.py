"""The emulated robot as a source, in this very process."""

from __future__ import annotations

import math
from itertools import takewhile

from failuretwin.connection.emulation.emulated_arm import EmulatedArm, Emulation
from failuretwin.connection.links.pace import Pace
from failuretwin.connection.links.paced import PacedSource


def emulated(emulation: Emulation, pace: Pace, duration_s: float = math.inf) -> PacedSource:
    """Return an emulated robot that works for `duration_s` [s] at some pace.

    Raises:
        InputError: If mujoco is missing.
    """
    events = EmulatedArm(emulation).events()
    name = f"emulated {emulation.robot.name}"
    return PacedSource(name, takewhile(lambda event: event.time <= duration_s, events), pace)
