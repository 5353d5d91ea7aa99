"""Which joints can move the tool point, and how far it gets: by trying poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray, frozen_array
from failuretwin.digital_model.chain import SerialChain

POSES = 256
SEED = 0
"""The poses are the same each time, so that a report can be repeated."""

CANNOT_MOVE = 1e-9
"""A lever arm below this at every pose is rounding, not motion [m/rad or m/m]."""

FREE_RANGE = np.pi
"""Range tried on either side of zero for a joint without limits [rad or m]."""

ASCENT_STEPS = 100


@dataclass(frozen=True)
class Mobility:
    """What the joints of a chain do to its tool point.

    Attributes:
        lever: Largest speed of the tool for unit speed of each joint over all poses tried,
            (joint,) [m/rad or m/m].
        reach: Farthest distance of the tool from the base frame's origin that was found [m].
    """

    lever: FloatArray
    reach: float

    @property
    def moves(self) -> list[bool]:
        """Whether each joint can move the tool point."""
        return [bool(lever >= CANNOT_MOVE) for lever in self.lever]


def mobility(chain: SerialChain) -> Mobility:
    """Return what the joints of `chain` do to its tool point at random poses in their limits."""
    low, high, poses = _poses(chain)
    return Mobility(frozen_array(levers(chain)), _reach(chain, poses, low, high))


def levers(chain: SerialChain) -> FloatArray:
    """Return the largest speed of the tool for unit speed of each joint, (joint,) [m/rad, m/m]."""
    _, jacobian = chain.position_and_jacobian(_poses(chain)[2])
    return np.linalg.norm(jacobian, axis=-2).max(axis=0)


def _poses(chain: SerialChain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lowest and highest joint values (joint,) and random poses between (pose, joint)."""
    low, high = np.array([free_range(joint.low, joint.high) for joint in chain.joints]).T
    return low, high, np.random.default_rng(SEED).uniform(low, high, (POSES, len(low)))


def has_range(low: float, high: float) -> bool:
    """Return whether limits are a range; exporters write 0 and 0 for ones they do not know."""
    return bool(np.isfinite(low) and np.isfinite(high) and low < high)


def free_range(low: float, high: float) -> tuple[float, float]:
    """Return the limits where they are a range, a range about zero where they are not."""
    return (low, high) if has_range(low, high) else (-FREE_RANGE, FREE_RANGE)


def _reach(chain: SerialChain, poses: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Climb from all poses at once in the direction that takes the tool away from the base."""
    point, jacobian = chain.position_and_jacobian(poses)
    scale = float(np.linalg.norm(point, axis=-1).max()) or 1.0
    farthest = 0.0
    for step in np.linspace(1.0, 0.01, ASCENT_STEPS):
        distance = np.linalg.norm(point, axis=-1)
        farthest = max(farthest, float(distance.max()))
        outward = point / np.maximum(distance, 1e-12)[:, None]
        slope = np.einsum("pa,paj->pj", outward, jacobian)
        poses = np.clip(poses + step * slope / scale, low, high)
        point, jacobian = chain.position_and_jacobian(poses)
    return farthest
