"""Nodes of an unknown that holds for the whole run: dense where a movement may point."""

from __future__ import annotations

import numpy as np

from failuretwin.core.quadrature import log_sum, log_trapezoid_weights
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.evidence.motor_profile import MotorProfile

LOCAL_STEPS = np.array([-8, -5, -3.5, -2.5, -1.75, -1, -0.5, 0, 0.5, 1, 1.75, 2.5, 3.5, 5, 8.0])
"""Nodes around the value that a movement points to, in its own standard deviations."""
COARSE_NODES = 41
"""Nodes spread evenly over the range of sizes, on each side of zero."""


def nodes_around(
    best: FloatArray, width: FloatArray, usable: BoolArray, otherwise: float
) -> FloatArray:
    """Return nodes around the value that each movement points to, (run, node).

    Args:
        best: That value, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        otherwise: What the others give.
    """
    nodes = best[..., None] + width[..., None] * LOCAL_STEPS
    return np.where(usable[..., None], nodes, otherwise).reshape(len(best), -1)


def size_nodes(
    best: FloatArray, width: FloatArray, usable: BoolArray, sizes: tuple[float, ...], signed: bool
) -> tuple[FloatArray, FloatArray]:
    """Return magnitudes of a fault, sorted, and the log of their prior, (run, node) each.

    Args:
        best: Magnitude that each movement points to, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        sizes: Lowest and highest magnitude, all between as likely.
        signed: Whether they come with a minus too.
    """
    low, high = sizes
    grid = np.linspace(low, high, COARSE_NODES)
    if signed:
        grid = np.concatenate([-grid, grid])
    local = nodes_around(best, width, usable, low)
    coarse = np.broadcast_to(grid, (len(best), len(grid)))
    nodes = np.concatenate([local, coarse], axis=1)
    side = np.where(signed & (nodes < 0.0), -1.0, 1.0)
    nodes = np.sort(side * np.clip(side * nodes, low, high), axis=1)
    # Both sides moved together: what lies between the lowest sizes has no mass.
    mass = log_trapezoid_weights(nodes - np.sign(nodes) * low)
    return nodes, mass - log_sum(mass, axis=1)[:, None]


def pointed(
    profile: MotorProfile, settled: FloatArray, gain: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the amount that each movement points to and its deviation, (run, movement)."""
    safe = np.where(np.abs(gain) > 1e-9, gain, 1.0)
    spread = np.sqrt(1.0 / np.maximum(profile.precision[..., 0], 1e-6) + profile.scatter**2)
    return (profile.best[..., 0] - settled) / safe, spread / np.abs(safe)
