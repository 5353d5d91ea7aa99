"""How well the best member of a hypothesis fits: the best size, held angle or range of errors.

When the fault began is taken as known. What a fault draws anew for each movement is summed over,
as it is no more known beforehand to whoever knows the rest.
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.movements import Movements
from failuretwin.core.quadrature import log_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.law import Law, densities
from failuretwin.decision.hypotheses.laws.stays import MISSES, log_densities
from failuretwin.decision.hypotheses.priors import Priors
from failuretwin.decision.hypotheses.weighing import law_of, motor_of


def first_spoilt(movements: Movements, onset: FloatArray) -> BoolArray:
    """Return with which movements the effects of a fault may begin, (run, movement).

    The one under way at the onset, or the next: some faults act at once, others on the next
    command.

    Args:
        movements: Movements of the runs.
        onset: Onset of the fault, (run,) [s]; NaN or before the first movement: the first.
    """
    count = np.sum(movements.start <= np.nan_to_num(onset)[:, None], axis=1, keepdims=True)
    under_way = np.maximum(count - 1, 0)
    number = np.arange(movements.start.shape[1])
    next_one = (count > 0) & (number == under_way + 1) & movements.exists
    return np.asarray((number == under_way) | next_one)


def best_fit(scene: Scene, hypothesis: Hypothesis, priors: Priors, first: BoolArray) -> FloatArray:
    """Return the log density of each run under the best member of a hypothesis, (run,).

    Args:
        scene: The runs.
        hypothesis: Healthy or one fault.
        priors: Ranges of sizes that are considered.
        first: Movements with which the effects of the fault may begin, (run, movement).
    """
    if hypothesis.is_healthy:
        return np.asarray((scene.log_healthy + scene.on_way).sum(axis=1))
    fault = hypothesis.faults[0]
    if fault.mode in MISSES:
        whole = log_densities(scene, motor_of(scene, fault), fault.mode)[:, -1]
    else:
        whole = _by_first_and_cell(scene, law_of(scene, fault, priors))
    return np.asarray((whole + log_of(first)[..., None]).max(axis=(1, 2)))


def _by_first_and_cell(scene: Scene, law: Law) -> FloatArray:
    """Return the log density of each run, (run, first movement spoilt, cell)."""
    says = densities(scene, law)
    healthy, faulty = scene.log_healthy + scene.on_way, says.by_cell + says.way
    before = np.cumsum(healthy, axis=1) - healthy
    after = np.cumsum(faulty[:, ::-1], axis=1)[:, ::-1]
    return np.where(np.isfinite(law.log_prior), before[:, :, None] + after, -np.inf)
