"""What none of the known faults explains: nearest to one of them, yet off by much.

The robot does what some known hypothesis says, healthy included, but settles and moves off it by
many times what a healthy robot scatters, or only moves off it; how much more is unknown, the same
for the whole run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.quadrature import log_sum
from failuretwin.core.types import FloatArray
from failuretwin.decision.scene import Scene
from failuretwin.decision.weight import Estimate, Weight

BLURS = (3.0, 8.0, 25.0)
"""Factors on the scatter: just more than tails allow, to anywhere near."""
WAY_BLUR = 8.0
"""The same where the motors settle as they should, but get there in another way."""


def weigh_unknown(
    scene: Scene, known: Sequence[Callable[[Scene], Weight]], log_prior: FloatArray
) -> Weight:
    """Return what the runs say of a fault that is not among the known ones.

    Args:
        scene: The runs.
        known: What weighs each known hypothesis.
        log_prior: Their log prior probability, (hypothesis,).
    """
    blurred = [replace(scene, model=replace(scene.model, blur=blur)) for blur in BLURS]
    if scene.moving is not None:
        blurred.append(replace(scene, way_blur=WAY_BLUR))
    found = [weigh(other) for other in blurred for weigh in known]
    prior = np.tile(log_prior - np.log(len(blurred)), len(blurred))
    joint = np.stack([weight.log_evidence for weight in found], axis=1) + prior
    log_evidence = log_sum(joint, axis=1)
    best = np.argmax(joint, axis=1)

    def estimate(run: int) -> Estimate:
        nearest = found[best[run]].estimate(run)
        return replace(nearest, size=None)

    return Weight(
        log_evidence=log_evidence,
        by_movement=lambda run: found[best[run]].by_movement(run),
        settled=lambda run: found[best[run]].settled(run),
        estimate=estimate,
    )
