"""Where a motor settles that a fault takes far from its target: it sags there as the pose asks."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.motor_profile import MotorProfile
from failuretwin.decision.scene import Scene


def settled_beside(scene: Scene, motor: int, farthest: FloatArray) -> FloatArray:
    """Return where a motor settles apart from what the fault itself adds, (..., alternative) [rad].

    It sags in the pose that it is really in, which a large fault takes far from the target: the
    load there is that of the angle that the movement points to.

    Args:
        scene: The runs.
        motor: Index of the motor.
        farthest: How far the fault may put it off, (run, movement, alternative) [rad].
    """
    model, alternatives, profile = scene.model, scene.alternatives, scene.profile(motor)
    pose = model.settle(alternatives.base, alternatives.direction, model.none_held)
    low, high = profile.expected - farthest, profile.expected + farthest
    pose[..., motor] = np.clip(profile.best, low, high)
    offset = model.settling.offset(model.twin.robot, pose, alternatives.direction)
    return np.asarray(alternatives.base[..., motor] + offset[..., motor])


def pointed(
    profile: MotorProfile, settled: FloatArray, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the amount that each movement points to and its deviation, (run, movement)."""
    safe = np.where(np.abs(gain) > 1e-9, gain, 1.0)
    spread = np.sqrt(1.0 / np.maximum(profile.precision[..., 0], 1e-6) + profile.scatter**2)
    return (profile.best[..., 0] - settled) / safe, spread / np.abs(safe)
