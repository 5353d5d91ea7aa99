"""The emulated robot as a source, in this very process."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import takewhile

from failuretwin.connection.emulation.emulated_arm import EmulatedArm, Emulation
from failuretwin.connection.links.pace import Pace
from failuretwin.connection.links.paced import PacedSource


def emulated(
    emulation: Emulation, pace: Pace, duration_s: float = math.inf, zero_s: float = 0.0
) -> PacedSource:
    """Return an emulated robot as a source.

    Args:
        emulation: What to emulate.
        pace: How fast its time passes.
        duration_s: How long it works [s].
        zero_s: What its clock says at the start [s].

    Raises:
        InputError: If mujoco is missing.
    """
    events = takewhile(lambda event: event.time <= duration_s, EmulatedArm(emulation).events())
    stamped = (replace(event, time=event.time + zero_s) for event in events)
    return PacedSource(f"emulated {emulation.robot.name}", stamped, pace)
