"""Faults whose size holds for the whole run: encoder faults, play, loss of torque, drift.

Each puts the motor off its healthy settled angle by a known multiple of an unknown amount.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from failuretwin.core.quadrature import log_of, log_sum
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import magnitude_range
from failuretwin.decision.law import Law, Scene
from failuretwin.decision.laws.nodes import size_nodes
from failuretwin.decision.motor_profile import MotorProfile
from failuretwin.decision.onsets import SHARES, Stretches, at_once
from failuretwin.digital_model.settling import sag

DRIFT_RATES = 61
"""Rates of drift to sum over, on each side of zero."""
DRIFT_ONSETS = SHARES[[1, 4, 8]]
"""Onsets of a drift to sum over in each stretch, as shares of its length."""


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
    largest = amount.of_size(np.array(magnitude_range(mode)[1]))
    settled = _settled(scene, motor, np.abs(gain) * largest)
    best, width = _pointed(profile, settled[..., 0], gain[..., 0])
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
        lasting=True,
    )


def _settled(scene: Scene, motor: int, farthest: FloatArray) -> FloatArray:
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


def _pointed(
    profile: MotorProfile, settled: FloatArray, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the amount that each movement points to and its deviation, (run, movement)."""
    safe = np.where(np.abs(gain) > 1e-9, gain, 1.0)
    spread = np.sqrt(1.0 / np.maximum(profile.precision[..., 0], 1e-6) + profile.scatter**2)
    return (profile.best[..., 0] - settled) / safe, spread / np.abs(safe)


def _slope(amount: Amount, at: FloatArray) -> FloatArray:
    """Return how fast the amount grows with the magnitude."""
    if amount.signed:
        return np.ones_like(at)
    size = amount.to_size(np.maximum(at, 0.0))
    step = 1e-4
    return np.asarray((amount.of_size(size + step) - amount.of_size(size)) / step)


def drift_law(scene: Scene, motor: int, early: float) -> Law:
    """Return the law of a motor that slips away from its targets at a constant rate.

    Args:
        scene: The runs.
        motor: Index of the motor.
        early: Probability that it slips from the start of the run.
    """
    low, high = magnitude_range("drift")
    side = np.linspace(low, high, DRIFT_RATES)
    rate = np.concatenate([-side[::-1], side])
    stretches = at_once(scene.evidence)
    onset, log_onset = _drift_onsets(stretches, early)  # (run, movement, onset)
    runs, movements, onsets = onset.shape
    middle = np.nan_to_num(0.5 * (scene.evidence.begin + scene.evidence.end))
    since = np.maximum(middle[:, :, None] - onset.reshape(runs, 1, -1), 0.0)
    offset = (since[..., None] * rate).reshape(runs, movements, -1)
    # A node is an onset and a rate; each onset belongs to one movement that it spoils first.
    own = np.repeat(np.eye(movements), onsets, axis=1)
    log_first = log_of(own) + log_onset.reshape(runs, 1, -1)
    log_prior = np.repeat(log_first, len(rate), axis=2) - np.log(len(rate))

    def of_run(run: int) -> tuple[FloatArray, FloatArray]:
        return np.repeat(onset[run].reshape(1, -1, 1), len(rate), axis=1), np.ones((1, 1, 1))

    return Law(
        motor=motor,
        held=False,
        angle=scene.profile(motor).expected[:, :, None] + offset[..., None],
        log_prior=log_prior,
        size=np.tile(rate, (runs, movements * onsets)),
        onsets=of_run,
    )


def _drift_onsets(stretches: Stretches, early: float) -> tuple[FloatArray, FloatArray]:
    """Return onsets [s] and their log prior, (run, movement, onset); the first is the start."""
    begin, end = np.nan_to_num(stretches.begin), np.nan_to_num(stretches.end)
    inside = begin[..., None] + DRIFT_ONSETS * (end - begin)[..., None]
    weight = stretches.weights(early)
    late = weight.copy()
    late[:, 0] = np.maximum(late[:, 0] - early, 0.0)
    before = weight - late
    onset = np.concatenate([np.zeros_like(inside[..., :1]), inside], axis=-1)
    shares = np.concatenate(
        [before[..., None], np.repeat(late[..., None] / len(DRIFT_ONSETS), len(DRIFT_ONSETS), -1)],
        axis=-1,
    )
    log_shares = log_of(shares)
    return onset, log_shares - log_sum(log_shares, axis=(1, 2))[:, None, None]
