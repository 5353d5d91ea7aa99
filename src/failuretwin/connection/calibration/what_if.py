"""What the robot might be beside what its profile says: another sense of a motor, a payload."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from failuretwin.connection.calibration.settled_fit import largest_load
from failuretwin.connection.calibration.settled_part import SettledPart, fit_settled_part
from failuretwin.digital_model.robot import Robot

SURE_NATS = 5.0
"""Log odds from which one description of the robot is told to be better than another."""
PAYLOADS_KG = (0.02, 0.1, 0.5, 2.0)
"""Masses at the tool point that are tried [kg]."""


def sense_remarks(part: SettledPart, robot: Robot) -> list[str]:
    """Return what the logs say of each motor's sense, in sentences.

    A motor that turns the other way sags the other way; where gravity hardly loads it, nothing can
    be said.
    """
    remarks = []
    load = largest_load(robot, 0.0)
    for k, motor in enumerate(robot.motors):
        if load[k] <= 1e-6:
            remarks.append(f"sense of {motor.name}: cannot be told, gravity does not load it")
            continue
        other = _with_sense(robot, k, -motor.sense)
        odds = part.fit.log_posterior - _refit(part, other, 0.0)
        if odds > SURE_NATS:
            remarks.append(
                f"sense of {motor.name}: {motor.sense:+.0f} as in the profile, {odds:.0f} nats "
                "better than the other way"
            )
        elif odds < -SURE_NATS:
            remarks.append(
                f"sense of {motor.name}: the logs speak for {-motor.sense:+.0f} by {-odds:.0f} "
                f"nats, the profile says {motor.sense:+.0f}; check it"
            )
        else:
            remarks.append(f"sense of {motor.name}: the logs do not tell ({odds:+.1f} nats)")
    return remarks


def _with_sense(robot: Robot, index: int, sense: float) -> Robot:
    motors = tuple(
        replace(motor, sense=sense) if k == index else motor for k, motor in enumerate(robot.motors)
    )
    return replace(robot, profile=replace(robot.profile, motors=motors))


def best_payload(part: SettledPart, robot: Robot) -> tuple[float, str]:
    """Return the payload that the logs speak for [kg] and a sentence about it.

    Compliance can take up most of what a payload does, so it is 0 unless the logs are sure.
    """
    gain = np.array([_refit(part, robot, kg) for kg in PAYLOADS_KG]) - part.fit.log_posterior
    best = int(np.argmax(gain))
    if gain[best] > SURE_NATS:
        kg = PAYLOADS_KG[best]
        return kg, f"payload: about {kg:g} kg at the tool point, {gain[best]:.0f} nats over none"
    return 0.0, (
        "payload: the logs do not tell one from a softer motor "
        f"(best {PAYLOADS_KG[best]:g} kg, {gain[best]:+.1f} nats against none); weigh it, or run "
        "the same movements with and without it"
    )


def _refit(part: SettledPart, robot: Robot, payload: float) -> float:
    return fit_settled_part(part.observations, robot, payload).fit.log_posterior
