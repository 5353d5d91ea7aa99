"""How well each movement agrees with a motor that settles off by a given angle, as a table.

Many faults show in settled poses as an offset of one motor: constant, in proportion to the target,
growing with time, by direction. The density is computed once for a range of offsets and looked up
for each of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence

FINE_STEPS = 1.2
"""Offsets lie this many healthy scatters apart up to `FINE_RAD`."""
FINE_RAD = 0.3
"""Largest offset that is resolved finely [rad]; beyond it errors are unmistakable."""
COARSE_STEP_RAD = 0.015
LARGEST_RAD = 1.2
"""Largest offset considered [rad]: the range of a motor of the ArmPi FPV, 70 degrees."""


@dataclass(frozen=True)
class OffsetTable:
    """Log densities of settled points over offsets of one motor.

    Attributes:
        offset: Offsets, increasing, (node,) [rad].
        log_density: (run, movement, node); 0 for movements that are not usable.
    """

    offset: FloatArray
    log_density: FloatArray

    def at(self, offset: FloatArray) -> FloatArray:
        """Return log densities at other offsets by interpolation, (run, movement, ...) both ways.

        Offsets beyond the table count as its ends.
        """
        runs, movements, nodes = self.log_density.shape
        flat = np.clip(offset, self.offset[0], self.offset[-1]).reshape(runs, movements, -1)
        right = np.clip(np.searchsorted(self.offset, flat), 1, nodes - 1)
        # A parabola through three nodes: log densities of a normal distribution are parabolas.
        middle = np.clip(np.where(self._nearer_left(flat, right), right - 1, right), 1, nodes - 2)
        x = [self.offset[middle + shift] for shift in (-1, 0, 1)]
        y = [np.take_along_axis(self.log_density, middle + shift, axis=2) for shift in (-1, 0, 1)]
        first = (y[1] - y[0]) / (x[1] - x[0])
        second = ((y[2] - y[1]) / (x[2] - x[1]) - first) / (x[2] - x[0])
        value = y[0] + (flat - x[0]) * (first + (flat - x[1]) * second)
        return value.reshape(offset.shape)

    def _nearer_left(self, flat: FloatArray, right: np.ndarray) -> np.ndarray:
        return np.asarray(flat - self.offset[right - 1] < self.offset[right] - flat)


def offset_table(
    evidence: SettledEvidence, model: HealthyModel, alternatives: Alternatives, motor: int
) -> OffsetTable:
    """Return the table of one motor.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        alternatives: What may become of each movement.
        motor: Index of the motor.
    """
    offset = offset_nodes(float(model.scatter[motor]))
    pose = model.settle(alternatives.base, alternatives.direction, model.none_held)[:, :, None]
    pose = np.repeat(pose, len(offset), axis=2)
    pose[..., motor] += offset[:, None]
    return OffsetTable(offset, model.log_density(evidence, alternatives, pose, model.none_held))


def offset_nodes(scatter: float) -> FloatArray:
    """Return the offsets of a table for a motor of that scatter, (node,) [rad]."""
    step = max(FINE_STEPS * scatter, 1e-3)
    fine = np.arange(0.0, FINE_RAD, step)
    coarse = np.arange(fine[-1] + step, LARGEST_RAD, max(COARSE_STEP_RAD, step))
    half = np.concatenate([fine, coarse])
    return np.concatenate([-half[:0:-1], half])
