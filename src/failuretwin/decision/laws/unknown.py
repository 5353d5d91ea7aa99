"""What none of the known faults explains: the tool settles somewhere near, but not where it should.

Its distance from the healthy place is of an unknown scale, in any direction, anew for each
movement; some movements are as if all were well.
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.ellipsoid import log_fall, log_norm
from failuretwin.core.quadrature import Weighted, log_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.law import Estimate, Scene, Weight, posterior_of
from failuretwin.decision.onsets import at_movement_starts

SCALES = (0.03, 0.1, 0.3)
"""Scales of the distance, as shares of the arm's reach."""
DOF = 4.0
"""Degrees of freedom of the distance: heavy tails."""
SOUND = 0.2
"""Share of movements that are as if all were well."""


def weigh_unknown(scene: Scene, early: float) -> Weight:
    """Return what the runs say of a fault that is not among the known ones.

    Args:
        scene: The runs.
        early: Probability that it was there before the run.
    """
    model, alternatives = scene.model, scene.alternatives
    pose = model.settle(
        alternatives.base[:, :, 0], alternatives.direction[:, :, 0], model.none_held
    )
    away = scene.evidence.point - model.twin.path(pose)
    square = np.sum(away**2, axis=-1)
    scales = np.asarray(SCALES) * model.reach
    off = log_norm(DOF) - 3.0 * np.log(scales) + log_fall(square[..., None] / scales**2, DOF)
    healthy = scene.log_healthy[..., None]
    density = np.logaddexp(np.log(SOUND) + healthy, np.log1p(-SOUND) + off)
    density = np.where(scene.usable[..., None], density, 0.0)
    stretches = at_movement_starts(scene.evidence.movements)
    log_first = log_of(stretches.weights(early))[..., None] - np.log(len(SCALES))
    log_first = np.repeat(log_first, len(SCALES), axis=2)
    on_way = (scene.on_way, _on_way(scene)[..., None])
    found = posterior_of(scene.log_healthy, density, log_first, on_way)

    def estimate(run: int) -> Estimate:
        onset, part = stretches.samples(early, run)
        when = np.exp(found.log_share[run]).sum(axis=1)[:, None] * part
        return Estimate(
            onset=Weighted(onset.ravel(), when.ravel()),
            size=None,
            became=scene.became[run],
        )

    return Weight(found.log_evidence, found.by_movement, found.settled, estimate)


def _on_way(scene: Scene) -> FloatArray:
    """Return the log density of the readings on the way, (run, movement)."""
    if scene.transients is None:
        return scene.on_way
    astray = scene.transients.astray
    return np.logaddexp(np.log(SOUND) + scene.on_way, np.log1p(-SOUND) + astray)
