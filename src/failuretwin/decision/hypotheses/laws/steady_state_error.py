"""A steady-state error: an unknown offset from the target, drawn anew for each movement.

How large the errors of a run are is unknown too: the run-level range of sizes is one of a few, and
the evidence is averaged over them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.quadrature import log_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.law import Law
from failuretwin.decision.hypotheses.onsets import at_movement_starts

Range = tuple[float, float]

_COUNT = np.deg2rad(0.24)
ERROR_RANGES: tuple[Range, ...] = (
    (4 * _COUNT, 20 * _COUNT),
    (7 * _COUNT, 35 * _COUNT),
    (10 * _COUNT, 50 * _COUNT),
)
"""Run-level ranges of the error's size [rad]: from just above the healthy scatter of the ArmPi FPV
to the paper's own 10 to 50 counts of 0.24 deg."""
NODES = 36
"""Sizes to sum over on each side of zero, up to the largest error considered."""


def error_law(scene: Scene, motor: int, ranges: Sequence[Range], early: float) -> Law:
    """Return the law of `motor` having a steady-state error.

    Args:
        scene: The runs.
        motor: Index of the motor.
        ranges: Run-level ranges of the error's size [rad], equally likely.
        early: Probability that it was there before the run.
    """
    offset, log_weight = offset_nodes(ranges)
    stretches = at_movement_starts(scene.evidence.movements)
    log_first = log_of(stretches.weights(early))
    return Law(
        motor=motor,
        held=False,
        angle=scene.profile(motor).beside[:, :, None] + offset[:, None],
        log_prior=np.repeat(log_first[..., None] - np.log(len(ranges)), len(ranges), axis=2),
        size=offset[None],
        onsets=stretches.onsets(early),
        redrawn=log_weight,
    )


def offset_nodes(ranges: Sequence[Range]) -> tuple[FloatArray, FloatArray]:
    """Return signed sizes (node,) [rad] and their log weights in each range (range, node)."""
    largest = max(high for _, high in ranges)
    smallest = min(low for low, _ in ranges)
    step = (largest - smallest) / (NODES - 1) if largest > smallest else 0.0
    sizes = smallest + step * np.arange(NODES if step else 1)
    edges = np.concatenate([[smallest], 0.5 * (sizes[1:] + sizes[:-1]), [largest]])
    weights = []
    for low, high in ranges:
        overlap = np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
        total = overlap.sum()
        weights.append(overlap / total if total else np.eye(1, len(sizes))[0])
    half = 0.5 * np.array(weights)
    return np.concatenate([-sizes, sizes]), log_of(np.concatenate([half, half], axis=1))
