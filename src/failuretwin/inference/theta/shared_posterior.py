"""The posterior over hypotheses with what is shared and unknown integrated out.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.inference.engine.registration import displaced_posterior, robot_posterior
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.engine.weighing import Weighing, assembled
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import Posterior, compute_posterior


def shared_posterior(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    in_doubt: bool,
    known: Sequence[Weighing] = (),
) -> Posterior:
    """Weigh every hypothesis by some runs, what they share integrated out.

    Where no hypothesis has rows, theta is taken as told.

    Args:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        in_doubt: Whether their sensor may be displaced.
        known: The same runs weighed by where they rest, with a sensor that is not, where they were.
    """
    moving = likelihood.evidence.on_the_way
    if moving.any() and not moving.all():
        kinds = [np.flatnonzero(moving == kind) for kind in (False, True)]
        parts = [shared_posterior(likelihood.alike(k), hypotheses, priors, in_doubt) for k in kinds]
        place = np.empty(len(moving), dtype=np.int64)
        for rows in kinds:
            place[rows] = np.arange(len(rows))
        return assembled(likelihood, parts, moving.astype(np.int64), place)
    if not any(has_rows(h) for h in hypotheses):
        return compute_posterior(likelihood, hypotheses, priors)
    if in_doubt:
        return displaced_posterior(likelihood, hypotheses, priors)
    return robot_posterior(likelihood, hypotheses, priors, known)
