"""How much worse runs are explained than a healthy arm would explain them at its best.

    misfit = sum(highest - says) / sum(highest - outlier)        over movements

with the log density of a movement as it is explained, of a healthy arm at its best, and of a tool
that may be anywhere.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.movements import Stretches
from failuretwin.core.types import FloatArray
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import Posterior

FITS = 0.3
"""Misfit up to which a set-up explains runs, as a share of that of a tool that may be anywhere.
Runs of real arms with faults stay below 0.35 each and below 0.25 in the mean; with a motor
reversed all but those in which it is stuck are above 0.4."""


def highest_and_outlier(likelihood: RunLikelihood) -> tuple[FloatArray, FloatArray]:
    """Return log densities of a healthy arm at its best, and of a tool that may be anywhere.

    Args:
        likelihood: Runs by their settled positions.

    Returns:
        (run, movement) each; 0 where a movement is not usable.
    """
    model, evidence = likelihood.model, likelihood.evidence
    healthy = likelihood.healthy_pose
    scatter = model.scatter_at(Stretches.of(evidence.movements))
    _, _, spread = model.residual(evidence.point, healthy, scatter)
    highest = np.where(likelihood.usable, spread.log_norm(model.settling.tail_dof), 0.0)
    return highest, np.where(likelihood.usable, model.outlier_log_density, 0.0)


def run_misfit(posterior: Posterior, run: int) -> float:
    """Return the misfit of one run under its most probable hypothesis, see above."""
    best = int(np.argmax(posterior.log_posterior[run]))
    return misfit(posterior.likelihood[run], posterior.weights[best].settled(run))


def misfit(likelihood: RunLikelihood, says: FloatArray) -> float:
    """Return the misfit of one run, see above.

    Args:
        likelihood: The run.
        says: Log density of each movement as it is explained, (movement,); those that are not
            finite do not count.
    """
    counts = likelihood.usable[0] & np.isfinite(says)
    highest, outlier = (values[0, counts] for values in highest_and_outlier(likelihood))
    lost, most = (highest - says[counts]).sum(), (highest - outlier).sum()
    return float(lost / max(most, 1.0))
