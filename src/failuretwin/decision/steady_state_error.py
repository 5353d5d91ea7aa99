"""Evidence for a steady-state error: an unknown offset drawn anew for each movement.

How large the errors of a run are is unknown too: the run-level range of sizes is one of a few, and
the evidence is averaged over them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.quadrature import log_of, log_sum
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence

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


@dataclass(frozen=True)
class ErrorEvidence:
    """What the runs say of one motor having a steady-state error.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement given all others, (run, movement).
        offset: Posterior mean of the error of each movement, (run, movement) [rad].
        size: Quantiles 5, 50, 95 % of the rms error over movements, (run, 3) [rad].
    """

    log_evidence: FloatArray
    by_movement: FloatArray
    offset: FloatArray
    size: FloatArray


def error_evidence(
    evidence: SettledEvidence,
    model: HealthyModel,
    alternatives: Alternatives,
    motor: int,
    ranges: Sequence[Range],
) -> ErrorEvidence:
    """Weigh the hypothesis that `motor` has a steady-state error, for every run.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        alternatives: What may become of each movement.
        motor: Index of the motor.
        ranges: Run-level ranges of the error's size [rad], equally likely.
    """
    offset, log_weight = _offset_nodes(ranges)
    density = _log_density(evidence, model, alternatives, motor, offset)
    terms = density[:, :, None] + log_weight  # (run, movement, range, offset)
    by_movement = log_sum(terms, axis=-1)
    by_range = by_movement.sum(axis=1) - np.log(len(ranges))
    log_evidence = log_sum(by_range, axis=1)
    share = np.exp(by_range - log_evidence[:, None])
    posterior = np.exp(terms - by_movement[..., None])
    without = log_sum(by_range[:, None] - by_movement, axis=2)
    return ErrorEvidence(
        log_evidence=log_evidence,
        by_movement=log_evidence[:, None] - without,
        offset=np.einsum("rmgo,o,rg->rm", posterior, offset, share),
        size=_size(evidence, offset, posterior, share),
    )


def _offset_nodes(ranges: Sequence[Range]) -> tuple[FloatArray, FloatArray]:
    """Return signed sizes (offset,) [rad] and their log weights in each range (range, offset)."""
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


def _log_density(
    evidence: SettledEvidence,
    model: HealthyModel,
    alternatives: Alternatives,
    motor: int,
    offset: FloatArray,
) -> FloatArray:
    """Return log densities with `motor` off by `offset`, (run, movement, offset)."""
    pose = model.settle(alternatives.base, alternatives.direction, model.none_held)[:, :, None]
    pose = np.repeat(pose, len(offset), axis=2)
    pose[..., motor] += offset[:, None]
    return model.log_density(evidence, alternatives, pose, model.none_held)


def _size(
    evidence: SettledEvidence, offset: FloatArray, posterior: FloatArray, share: FloatArray
) -> FloatArray:
    """Return quantiles of the rms error over all movements, seen or not, (run, 3) [rad].

    The mean square is a sum of independent terms; it is taken as normal with their mean and
    variance.
    """
    moments = []
    exists = evidence.movements.exists[..., None]
    count = np.maximum(exists.sum(axis=1), 1)
    for power in (2, 4):
        moments.append(np.einsum("rmgo,o->rmg", posterior, offset**power) * exists)
    mean = moments[0].sum(axis=1) / count
    variance = (moments[1] - moments[0] ** 2).sum(axis=1) / count**2
    total = np.sum(share * mean, axis=1)
    spread = np.sqrt(np.maximum(np.sum(share * (variance + mean**2), axis=1) - total**2, 0.0))
    squares = total[:, None] + spread[:, None] * np.array([-1.645, 0.0, 1.645])
    return np.sqrt(np.maximum(squares, 0.0))
