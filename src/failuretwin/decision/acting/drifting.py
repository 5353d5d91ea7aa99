"""A drift that is believed, followed: rate and beginning from what its motor is off by.

    o_i = J_k' S_k^-1 e_i / (J_k' S_k^-1 J_k),    o_i = rate (t_i - since) + noise

with e the miss of the tool at rest, S_k its scatter by all motors. The latest few movements alone
would show a constant error, for what has slipped stays slipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import HALF_90, BelievedArm, BelievedFault, Seen
from failuretwin.inference.observation.healthy_model import HealthyModel

LEAST_MOVEMENTS = 3
"""Of fewer movements no line is drawn."""
FAR = 3.0
"""A movement so many deviations off the line counts half; lost commands are such."""
ROUNDS = 5


def followed(
    model: HealthyModel, believed: BelievedFault, history: Sequence[Seen]
) -> BelievedFault:
    """Return a drift with the rate and beginning that movements since it began say.

    Args:
        model: The healthy robot.
        believed: The drift.
        history: Movements.
    """
    since = [s for s in history if s.point is not None and s.rest_s > believed.since_s]
    if len(since) < LEAST_MOVEMENTS:
        return believed
    offset, deviation = np.array([_offset(model, believed.motor, seen) for seen in since]).T
    time = np.array([seen.rest_s for seen in since])
    last = time[-1]
    share, (rate, now), covariance = np.ones_like(time), np.zeros(2), np.eye(2)
    for _ in range(ROUNDS):
        weight = np.sqrt(share) / deviation
        (rate, now), covariance = np.polyfit(time - last, offset, 1, w=weight, cov="unscaled")
        away = (offset - now - rate * (time - last)) / (FAR * deviation)
        share = 1.0 / (1.0 + away**2)
    if now * rate <= 0.0:
        return believed
    grown_s = float(now / rate)
    return replace(
        believed,
        size=float(rate),
        spread=HALF_90 * float(np.sqrt(covariance[1, 1])) / grown_s,
        since_s=float(last - grown_s),
    )


def _offset(model: HealthyModel, motor: int, seen: Seen) -> tuple[float, float]:
    """Return by how much one motor is off, were all others healthy, and its deviation [rad]."""
    arm = BelievedArm(model)
    pose = arm.settle(seen.command, seen.previous, seen.rest_s)
    assert seen.point is not None
    found, variance = 0.0, np.inf
    for _ in range(3):
        turned = pose.copy()
        turned[motor] += found
        error, jacobian, spread = model.residual(seen.point, turned, model.scatter)
        column: FloatArray = jacobian[:, motor]
        pull = spread.solve(column)
        variance = 1.0 / max(float(column @ pull), 1e-12)
        found += variance * float(pull @ error)
    return found, float(np.sqrt(variance))
