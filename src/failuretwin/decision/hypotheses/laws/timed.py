"""Faults that show on the way: a motor that starts late, a motor that is slow."""

from __future__ import annotations

import numpy as np

from failuretwin.core.quadrature import log_of
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.knowledge import magnitude_range
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.law import Law
from failuretwin.decision.hypotheses.onsets import at_movement_starts

NODES = 12
"""Magnitudes to sum over."""


def lag_law(scene: Scene, motor: int, early: float) -> Law:
    """Return the law of a motor that follows its reference late; it settles as a healthy one.

    Args:
        scene: The runs.
        motor: Index of the motor.
        early: Probability that the fault was there before the run.
    """
    delay = np.linspace(*magnitude_range("lag"), NODES)
    way = None
    if scene.transients is not None:
        way = scene.transients.timed(motor, np.ones(NODES), delay)
    angle = scene.profile(motor).expected[:, :, None]
    return _law(scene, motor, delay, np.repeat(angle, NODES, axis=2), way, early)


def slow_law(scene: Scene, motor: int, early: float) -> Law:
    """Return the law of a motor that has lost speed; movements that follow cut it short.

    Args:
        scene: The runs.
        motor: Index of the motor.
        early: Probability that the fault was there before the run.
    """
    share = np.linspace(*magnitude_range("slow"), NODES)
    factor = 1.0 / (1.0 - share)
    begin, end = _reached(scene, motor, factor)
    way = None
    if scene.transients is not None:
        way = scene.transients.timed(motor, factor, np.zeros(NODES), begin)
    short = end - np.nan_to_num(scene.evidence.movements.target[..., motor])[..., None]
    angle = scene.profile(motor).expected[:, :, None] + short[..., None]
    return _law(scene, motor, share, angle, way, early)


def _law(
    scene: Scene,
    motor: int,
    size: FloatArray,
    angle: FloatArray,
    way: FloatArray | None,
    early: float,
) -> Law:
    stretches = at_movement_starts(scene.evidence.movements)
    log_first = log_of(stretches.weights(early)) - np.log(NODES)
    return Law(
        motor=motor,
        held=False,
        angle=angle,
        log_prior=np.repeat(log_first[..., None], NODES, axis=2),
        size=size[None],
        onsets=stretches.onsets(early),
        on_way=way,
    )


def _reached(scene: Scene, motor: int, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where a slow motor begins and ends each movement, (run, movement, node) [rad]."""
    movements = scene.evidence.movements
    target = np.nan_to_num(movements.target[..., motor])[..., None]
    needed = np.nan_to_num(movements.ramp_duration[..., motor])[..., None] * factor
    available = (scene.evidence.end - movements.start)[..., None]
    done = np.divide(available, needed, out=np.ones_like(needed), where=needed > 0.0)
    done = np.clip(np.nan_to_num(done, nan=1.0), 0.0, 1.0)
    here = np.repeat(movements.initial[:, motor, None], len(factor), axis=1)
    begin, end = np.empty_like(needed), np.empty_like(needed)
    for m in range(target.shape[1]):
        begin[:, m] = here
        here = here + (target[:, m] - here) * done[:, m]
        end[:, m] = here
    return begin, end
