"""Faults whose size holds for the whole run: encoder faults, play, loss of torque.

Each puts the motor off its healthy settled angle by a known multiple of an unknown amount.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from failuretwin.core.quadrature import log_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import magnitude_range
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.law import Law
from failuretwin.decision.hypotheses.laws.nodes import pointed, size_nodes
from failuretwin.decision.hypotheses.onsets import at_once
from failuretwin.digital_model.settling import sag


@dataclass(frozen=True)
class Amount:
    """How the magnitude of a mode turns into the amount by which it puts a motor off.

    Attributes:
        gain: Offset of the settled angle for each unit of amount, from scene and motor:
            (run, movement, alternative) [rad].
        of_size: Amount that belongs to a magnitude.
        to_size: Magnitude that belongs to an amount.
        signed: Whether magnitudes have a sign.
    """

    gain: Callable[[Scene, int], FloatArray]
    of_size: Callable[[FloatArray], FloatArray] = lambda size: size
    to_size: Callable[[FloatArray], FloatArray] = lambda amount: amount
    signed: bool = True


def _everywhere(scene: Scene, motor: int) -> FloatArray:
    return np.ones(scene.alternatives.base.shape[:3])


def _by_angle(scene: Scene, motor: int) -> FloatArray:
    return np.asarray(scene.alternatives.base[..., motor])


def _behind(scene: Scene, motor: int) -> FloatArray:
    """Half of the play, against the direction of the last travel."""
    return np.asarray(-0.5 * scene.alternatives.direction[..., motor])


def _by_sag(scene: Scene, motor: int) -> FloatArray:
    model, alternatives = scene.model, scene.alternatives
    pose = model.settle(alternatives.base, alternatives.direction, model.none_held)
    settling = model.settling
    yielding = sag(model.twin.robot, pose, np.asarray(settling.compliance), settling.payload)
    return np.asarray(yielding[..., motor])


AMOUNTS: Mapping[str, Amount] = {
    "encoder_bias": Amount(_everywhere),
    "encoder_scale": Amount(_by_angle),
    "backlash": Amount(_behind, signed=False),
    "torque_loss": Amount(
        _by_sag,
        of_size=lambda share: share / (1.0 - share),
        to_size=lambda amount: amount / (1.0 + amount),
        signed=False,
    ),
}
"""Modes of a constant magnitude, by id."""


def lasting_law(scene: Scene, motor: int, mode: str, early: float) -> Law:
    """Return the law of a fault whose magnitude is the same from its onset on.

    Args:
        scene: The runs.
        motor: Index of the motor.
        mode: Id of the mode, one of `AMOUNTS`.
        early: Probability that the fault was there before the run.
    """
    amount, profile = AMOUNTS[mode], scene.profile(motor)
    gain = amount.gain(scene, motor)
    settled = profile.beside
    best, width = pointed(profile, settled[..., 0], gain[..., 0])
    best = np.clip(best, -1e3, 1e3)
    slope = _slope(amount, best)
    size, log_size = size_nodes(
        amount.to_size(np.maximum(best, 0.0)) if not amount.signed else best,
        width / slope,
        profile.usable & (np.abs(gain[..., 0]) > 1e-9),
        magnitude_range(mode),
        amount.signed,
    )
    offset = gain[:, :, None] * amount.of_size(size)[:, None, :, None]
    stretches = at_once(scene.evidence)
    return Law(
        motor=motor,
        held=False,
        angle=settled[:, :, None] + offset,
        log_prior=log_of(stretches.weights(early))[..., None] + log_size[:, None],
        size=size,
        onsets=stretches.onsets(early),
        gain=gain,
    )


def _slope(amount: Amount, at: FloatArray) -> FloatArray:
    """Return how fast the amount grows with the magnitude."""
    if amount.signed:
        return np.ones_like(at)
    size = amount.to_size(np.maximum(at, 0.0))
    step = 1e-4
    return np.asarray((amount.of_size(size + step) - amount.of_size(size)) / step)
