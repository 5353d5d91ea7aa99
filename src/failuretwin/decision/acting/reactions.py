"""Reactions that are more than another plan, and all of them in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import BelievedArm, BelievedFault, Seen
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Reaction
from failuretwin.inference.explanation import size_words

LEAST_LOSS_RATE = 0.01
"""Share of commands taken to get lost at least, of arms whose losses are not known [-]."""
MOVED_RAD = 0.02
"""A motor that was told to move by less cannot be seen to have lost its command [rad]."""
SURPRISE_NATS = 2.0
"""A loss must explain the tool's place better by so much beside its rate [nats]."""
PROBE_RAD = 0.15
"""A held motor is told to move by so much when it is asked whether it was repaired [rad]."""


def told(believed: BelievedFault, robot: Robot) -> str:
    """Return in words what is done about a fault, before it is done."""
    unit = robot.own_unit(believed.fault.motor, believed.mode.unit)
    size = ""
    if np.isfinite(believed.size):
        size = size_words(believed.fault, believed.size, unit)
    return f"{believed.mode.plain_name(believed.fault.motor)}{size}: {believed.reaction.value}"


def lost_command(arm: BelievedArm, seen: Seen) -> list[int]:
    """Return which motors seem not to have got a command, empty if all seem to have.

        log p(e | lost) + log rate > log p(e | arrived) + 2

    A motor that is held does not count: it is not expected to move. One that sticks now and then
    may also stand on its way.

    Args:
        arm: The arm as it is believed to be.
        seen: The movement.
    """
    arrived, best, lost = arm.log_density_arrived(seen), -np.inf, list[int]()
    moved = np.abs(seen.command - seen.previous) > MOVED_RAD
    for motors, rate in _loss_sets(arm):
        if not moved[motors].any() or (len(motors) == 1 and arm.held[motors].any()):
            continue
        command = seen.command.copy()
        command[motors] = seen.previous[motors]
        says = arm.log_density_arrived(replace(seen, command=command)) + np.log(rate)
        if says > best:
            best, lost = says, motors
    fault = arm.fault
    if fault is not None and fault.obeys and moved[fault.motor]:
        says = arm.log_density_missed(seen)
        if says > best:
            best, lost = says, [fault.motor]
    return lost if best > arrived + SURPRISE_NATS else []


def _loss_sets(arm: BelievedArm) -> list[tuple[list[int], float]]:
    """Return sets of motors that may lose a command together, and how often."""
    names = arm.robot.motor_names
    found: dict[tuple[int, ...], float] = {(k,): LEAST_LOSS_RATE for k in range(len(names))}
    found[tuple(range(len(names)))] = LEAST_LOSS_RATE
    for entry in arm.model.imperfections.lost_commands:
        motors = tuple(names.index(motor) for motor in entry.motors)
        found[motors] = max(entry.rate, LEAST_LOSS_RATE)
    return [(list(motors), rate) for motors, rate in found.items()]


def probing(arm: BelievedArm, command: FloatArray) -> FloatArray | None:
    """Return a command that moves a held motor if it was repaired; None: none is held.

    Args:
        arm: The arm as it is believed to be.
        command: What was planned, (motor,) [rad].
    """
    fault = arm.fault
    if fault is None or not fault.rests or fault.reaction is not Reaction.LOCK:
        return None
    k, (low, high) = fault.motor, arm.limits
    inward = 1.0 if command[k] < 0.5 * (low[k] + high[k]) else -1.0
    probed = command.copy()
    probed[k] += inward * PROBE_RAD
    return arm.rounded(probed)
