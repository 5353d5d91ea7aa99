"""Have the latest runs changed as no wear does? Too fast, or too far from the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.connection.run_evidence import RunEvidence
from failuretwin.connection.wear import ROUNDS, WearLimits, WearState, information, weights
from failuretwin.core.types import FloatArray, as_floats

FREE = 30.0
"""How far a sudden change may go, a standard deviation in scatters: as good as anywhere."""
CHANCE = 4.0
"""The latest runs may lie this many standard deviations off by chance."""
FEWEST = 5
"""Runs below which nothing is said of a sudden change."""


def unlike_wear(
    window: Sequence[RunEvidence],
    references: Sequence[WearState],
    start: WearState,
    unit: FloatArray,
    limits: WearLimits,
    dof: float,
) -> tuple[int, bool] | None:
    """Return what has changed more than wear can make it; None: nothing.

    The runs are compared with the tracked state and with what it was a horizon ago: a fault that
    grows slowly drags the state along before it shows.

    Args:
        window: The latest runs, none of them learned yet.
        references: The tracked state, then earlier ones.
        start: Wear of the calibration.
        unit: Wear that moves a motor by its scatter, (2 motor,).
        limits: How fast and how far wear may go.
        dof: Degrees of freedom of the scatter.

    Returns:
        The entry of the wear that stands out, and whether it changes too fast, rather than lies
        too far from the calibration.
    """
    runs = [run for run in window if run.error.size]
    if len(runs) < FEWEST:
        return None
    change = sudden_change(references[0], runs, unit, dof)
    now = references[0].mean + change.mean

    def off(known: WearState, most: float) -> FloatArray:
        """Return by how much each entry lies off beyond `most` and chance."""
        chance = CHANCE * np.hypot(change.deviation, known.deviation)
        return np.abs(now - known.mean) - most * unit - chance

    fast = np.max([off(known, limits.reach) for known in references], axis=0)
    excess = np.maximum(fast, off(start, limits.limit))
    over = np.divide(excess, unit, out=np.zeros_like(unit), where=unit > 0.0)
    worst = int(np.argmax(over))
    return (worst, bool(fast[worst] > 0.0)) if over[worst] > 0.0 else None


def sudden_change(
    state: WearState, window: Sequence[RunEvidence], unit: FloatArray, dof: float
) -> WearState:
    """Return how far runs lie off a state if their wear is one and the same, whatever it is.

    Args:
        state: Tracked state; taken as it is.
        window: The runs.
        unit: Wear that moves a motor by its scatter, (2 motor,).
        dof: Degrees of freedom of the scatter.

    Returns:
        Difference to `state`, with the covariance that the scatter of the runs gives it.
    """
    free = FREE * unit
    full = [run for run in window if run.error.size]
    if not full:
        return WearState(np.zeros_like(free), np.diag(free**2))
    error, design = (
        np.concatenate([r.error for r in full]),
        np.concatenate([r.design for r in full]),
    )
    axes = error.shape[1]
    design = design.reshape(error.size, -1)
    off, scaled = error.reshape(-1) - design @ state.mean, design * free
    change = np.zeros_like(free)
    for _ in range(ROUNDS):
        weight = weights((off - scaled @ change).reshape(-1, axes), dof)[:, None]
        known = (scaled * weight).T @ scaled + np.eye(len(free))
        change = as_floats(np.linalg.solve(known, (scaled * weight).T @ off))
    known = information(axes, dof) * scaled.T @ scaled + np.eye(len(free))
    return WearState(change * free, np.linalg.inv(known) * np.outer(free, free))
