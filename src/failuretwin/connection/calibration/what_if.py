"""What the robot might be beside what its profile says: another sense of a motor, a payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.connection.calibration.settled_fit import fit_settling
from failuretwin.connection.calibration.settled_part import SettledPart
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import largest_load

SURE_NATS = 5.0
"""Log odds from which one description of the robot is told to be better than another."""
LEAST_SAG_RAD = 1e-3
"""Sag below which nothing is said of a payload [rad]: a quarter of a servo count."""
PAYLOADS_KG = (0.02, 0.1, 0.5, 2.0)
"""Masses at the tool point that are tried [kg]."""


def sense_remarks(part: SettledPart, robot: Robot) -> list[str]:
    """Return what the logs say of each motor's sense, in sentences.

    A motor that turns the other way sags the other way; where gravity hardly loads it, nothing can
    be said.
    """
    loaded = np.flatnonzero(largest_load(robot, 0.0) > 1e-6).tolist()
    best, odds = _best_senses(part, robot, loaded)
    remarks = []
    for k, motor in enumerate(robot.motors):
        sense = best.motors[k].sense
        if k not in odds:
            told = "cannot be told, gravity does not load it"
        elif odds[k] <= SURE_NATS:
            told = f"the logs do not tell ({odds[k]:+.1f} nats for {sense:+.0f})"
        elif sense == motor.sense:
            told = f"{sense:+.0f} as in the profile, {odds[k]:.0f} nats better than the other way"
        else:
            told = (
                f"the logs speak for {sense:+.0f} by {odds[k]:.0f} nats, the profile says "
                f"{motor.sense:+.0f}; check it"
            )
        remarks.append(f"sense of {motor.name}: {told}")
    return remarks


def _best_senses(
    part: SettledPart, robot: Robot, loaded: Sequence[int]
) -> tuple[Robot, dict[int, float]]:
    """Return the robot with the senses that fit best, and how much worse each other way is [nats].

    The sense that gains most is turned first: a wrong one bends the loads of the motors before it,
    and makes theirs look wrong too.
    """
    best, posterior = robot, part.fit.log_posterior
    while True:
        turned = {k: _refit(part, _with_turned(best, k), part.payload) for k in loaded}
        k = max(turned, key=lambda motor: turned[motor], default=None)
        if k is None or turned[k] - posterior <= SURE_NATS:
            return best, {motor: posterior - other for motor, other in turned.items()}
        best, posterior = _with_turned(best, k), turned[k]


def _with_turned(robot: Robot, index: int) -> Robot:
    motors = tuple(
        replace(motor, sense=-motor.sense) if k == index else motor
        for k, motor in enumerate(robot.motors)
    )
    return replace(robot, profile=replace(robot.profile, motors=motors))


def best_payload(part: SettledPart, robot: Robot) -> tuple[float, str]:
    """Return the payload that the logs speak for [kg] and a sentence about it.

    Compliance can take up most of what a payload does, so it is 0 unless the logs are sure.
    """
    sag = np.abs(np.asarray(part.settling.compliance) * largest_load(robot, 0.0))
    if sag.max() < LEAST_SAG_RAD:
        return 0.0, "payload: the motors do not give way, so none can be told"
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
    """Return the log posterior of another description on the very same movements."""
    seen, arrived = part.observations[part.fitted], part.arrived[part.fitted]
    return fit_settling(seen, robot, arrived, payload).log_posterior
