"""What none of the known faults explains: the best of many other explanations.

Faults that the set leaves out, one motor or two that are off in any regular way or none, and, for
what is nothing of that kind, any hypothesis of the set with far more scatter. Each has odds of its
own, and the best counts alone: many poor explanations are no good one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.quadrature import log_sum
from failuretwin.core.types import FloatArray
from failuretwin.decision.laws.off_anyhow import weigh_off_anyhow
from failuretwin.decision.scene import Scene
from failuretwin.decision.weight import Estimate, Weight

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
    known: Sequence[Callable[[Scene], Weight]],
    log_prior: FloatArray,
    left_out: Sequence[tuple[float, Weight]],
) -> Weight:
    """Return what the runs say of a fault that is not among the known ones, times its odds.

    Args:
        scene: The runs.
        known: What weighs each known hypothesis.
        log_prior: Their log prior probability, (hypothesis,).
        left_out: Faults that are not among them: odds against healthy and what the runs say.
    """
    found = [(LEFT_OUT * odds, weight) for odds, weight in left_out]
    found.append((BLURRED_ODDS, _blurred(scene, known, log_prior)))
    anyhow = weigh_off_anyhow(scene)
    if anyhow is not None:
        found.append((OFF_ODDS, anyhow))
    return _best([weight for _, weight in found], np.log([odds for odds, _ in found]))


def _blurred(
    scene: Scene, known: Sequence[Callable[[Scene], Weight]], log_prior: FloatArray
) -> Weight:
    """Return what the runs say of the known hypotheses with far more scatter, settled or moving."""
    blurred = [replace(scene, model=replace(scene.model, blur=blur)) for blur in BLURS]
    if scene.moving is not None:
        blurred.append(replace(scene, way_blur=WAY_BLUR))
    weights = [weigh(other) for other in blurred for weigh in known]
    prior = np.tile(log_prior - np.log(len(blurred)), len(blurred))
    joint = np.stack([weight.log_evidence for weight in weights], axis=1) + prior
    return replace(_best(weights, prior), log_evidence=log_sum(joint, axis=1))


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
