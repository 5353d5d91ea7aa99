"""What none of the known faults explains: the best of many other explanations.

Faults that the set leaves out, one motor or two that are off in any regular way or none, and, for
what is nothing of that kind, a healthy robot with far more scatter. Each has odds of its own, and
the best counts alone: many poor explanations are no good one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.laws.off_anyhow import weigh_off_anyhow
from failuretwin.decision.hypotheses.weight import Estimate, Weight

BLURS = (3.0, 8.0, 25.0)
"""Factors on the scatter: just more than tails allow, to anywhere near."""
WAY_BLUR = 8.0
"""The same where the motors settle as they should, but get there in another way."""
BLURRED_ODDS = 0.5
"""Odds, against healthy, of far more scatter, in any of these ways."""
OFF_ODDS = 1.0
"""The same of one motor or two being off anyhow."""
LEFT_OUT = 0.5
"""Factor on the odds of a fault that the set leaves out. All three were chosen on simulated runs,
for no more than 2 % of the known runs lost (docs/diagnosis.md)."""


def weigh_unknown(
    scene: Scene,
    healthy: Callable[[Scene], Weight],
    left_out: Sequence[tuple[float, Weight]],
    known: Sequence[Hypothesis],
) -> Weight:
    """Return what the runs say of a fault that is not among the known ones, times its odds.

    Args:
        scene: The runs.
        healthy: What weighs a healthy robot.
        left_out: Faults that are not among the known ones: their odds against healthy, and what
            the runs say of them.
        known: The known hypotheses; two motors that are off as one of them says are no unknown.
    """
    found = [(LEFT_OUT * odds, weight) for odds, weight in left_out]
    blurred = _blurred(scene)
    found += [(BLURRED_ODDS / len(blurred), healthy(other)) for other in blurred]
    anyhow = weigh_off_anyhow(scene, known)
    if anyhow is not None:
        found.append((OFF_ODDS, anyhow))
    return _best([weight for _, weight in found], np.log([odds for odds, _ in found]))


def _blurred(scene: Scene) -> list[Scene]:
    """Return the runs as they look to who expects far more scatter, settled or moving."""
    blurred = [replace(scene, model=replace(scene.model, blur=blur)) for blur in BLURS]
    if scene.moving is not None:
        blurred.append(replace(scene, way_blur=WAY_BLUR))
    return blurred


def _best(weights: Sequence[Weight], log_prior: FloatArray) -> Weight:
    """Return what the runs say of the best explanation of each, without a size."""
    joint = np.stack([weight.log_evidence for weight in weights], axis=1) + log_prior
    best = np.argmax(joint, axis=1)

    def estimate(run: int) -> Estimate:
        return replace(weights[best[run]].estimate(run), size=None)

    return Weight(
        log_evidence=joint[np.arange(len(best)), best],
        by_movement=lambda run: weights[best[run]].by_movement(run),
        settled=lambda run: weights[best[run]].settled(run),
        estimate=estimate,
    )
