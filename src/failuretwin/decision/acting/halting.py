"""Bringing an arm to rest: it is told to stay where it is until it is seen to stand.

A network may lose an order, and a moving arm is further on than it was last read: while the motors
move, they are told again, where they were read last. This is no emergency stop.
"""

from __future__ import annotations

import time

import numpy as np

from failuretwin.connection.links.base import Commander, Event, Order, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray

FIRST_WAIT_S = 10.0
"""Longest wait for the first reading, by our clock [s]."""
HOLD_S = 0.1
"""Duration of an order to stay [s]."""
AGAIN_S = 0.5
"""Time after which a moving arm is told again [s]."""
STILL_S, STILL_RAD = 0.5, 0.01
"""An arm stands that has not moved further than that for so long [s, rad]."""
LONGEST_S = 5.0
"""Longest wait for an arm to stand [s]."""
POLL_S = 0.1

STANDS = "the arm stands"
MOVES = "the arm still moves: use its emergency stop"
SILENT = "its motors are not read any more, so it is not known whether it stands"
NOT_READ = (
    "its motors are not read, so it cannot be told where to stay: the movement under way ends by "
    "itself; use the emergency stop to end it now"
)


def angles_of(event: Event | None) -> FloatArray | None:
    """Return the angles that a reading tells of all motors, (motor,) [rad]; None: it does not."""
    if not isinstance(event, Reading) or event.position is None:
        return None
    return event.position if np.isfinite(event.position).all() else None


def bring_to_rest(arm: Commander, place: FloatArray | None = None) -> str:
    """Tell an arm to stay where it is until it stands; return what came of it, in words.

    Args:
        arm: The arm.
        place: Where its motors were read last, (motor,) [rad]; None: they are read first.

    Raises:
        InputError: If the motors are not read; nothing is sent then.
    """
    until = time.monotonic() + FIRST_WAIT_S
    while place is None:
        if time.monotonic() > until:
            raise InputError(f"{arm.name}: {NOT_READ}. Nothing was sent.")
        place = angles_of(arm.poll(POLL_S))
    _hold(arm, place)
    return _watched(arm)


def _hold(arm: Commander, place: FloatArray) -> None:
    arm.send(Order(place, np.full(len(place), HOLD_S)))


def _watched(arm: Commander) -> str:
    """Return how an arm comes to rest that was just told to stay; one that moves is told again."""
    told = moved = time.monotonic()
    until, place = told + LONGEST_S, None
    while (now := time.monotonic()) < until:
        angles = angles_of(arm.poll(POLL_S))
        if angles is None:
            continue
        if place is None or np.abs(angles - place).max() > STILL_RAD:
            place, moved = angles, now
        elif now - moved >= STILL_S:
            return STANDS
        if moved - told >= AGAIN_S:
            _hold(arm, angles)
            told = now
    return SILENT if place is None else MOVES
