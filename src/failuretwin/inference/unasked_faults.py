"""Faults that nobody asked for: whether one of them explains a run better than what was asked.

On the way a motor that is late or slow, has play or sticks now and then looks much like one that is
stuck or off. Where only these are hypotheses, the blamed motor's other faults h' are weighed too:

    p(h') p(run | h') > 20 p(h) p(run | h)    then h is no verdict

Section: docs/inference.md#moments-on-the-way
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.engine.weighing import Weighing
from failuretwin.inference.explanation import NO_HYPOTHESIS, plain_name
from failuretwin.inference.faults.prior_odds import prior_odds
from failuretwin.inference.posterior import unlisted

OF_WAY = (Signature.TRANSIENT, Signature.MISSED)
"""Faults that show by how a motor moves; those with hysteresis do too."""
BETTER_NATS = 3.0
"""Log odds of such a fault, against the best hypothesis, from which it is told [nats]."""


def unasked_faults(weighing: Weighing) -> list[str]:
    """Return which fault of the blamed motor explains each run on the way better, or empty."""
    by_hypothesis = weighing.by_hypothesis
    best = (by_hypothesis + weighing.log_odds).argmax(axis=1)
    blamed = [_motors_of(weighing.hypotheses[h]) for h in best.tolist()]
    rows = np.flatnonzero(weighing.likelihood.evidence.on_the_way & list(map(bool, blamed)))
    others = _others(weighing, rows, set[str]().union(*(blamed[run] for run in rows.tolist())))
    found = [""] * len(best)
    if not others:
        return found
    asked = np.array([[_motors_of(h) <= blamed[run] for h in others] for run in rows.tolist()])
    says = _of_runs(weighing, rows, others, asked).evidence.by_hypothesis
    says = np.where(asked, says + _log_odds(weighing, others), -np.inf)
    known = by_hypothesis[rows, best[rows]] + _log_odds(weighing, weighing.hypotheses)[best[rows]]
    for at in np.flatnonzero(says.max(axis=1) > known + BETTER_NATS).tolist():
        likeliest = plain_name(others[int(says[at].argmax())])
        found[int(rows[at])] = f"{likeliest} explains it better and {NO_HYPOTHESIS}"
    return found


def _others(weighing: Weighing, rows: IntArray, motors: Set[str]) -> list[Hypothesis]:
    """Return faults of some motors that are no hypotheses and show on the way of some runs."""
    told = weighing.layout.moving, bool(weighing.curved[rows].any())
    some = unlisted(weighing.likelihood, weighing.hypotheses)
    return [h for h in some if _motors_of(h) <= motors and _moves(h) and has_rows(h, *told)]


def _moves(hypothesis: Hypothesis) -> bool:
    modes = [MODES[fault.mode] for fault in hypothesis.faults]
    return all(mode.signature in OF_WAY or mode.hysteresis for mode in modes)


def _motors_of(hypothesis: Hypothesis) -> set[str]:
    return {fault.motor for fault in hypothesis.faults}


def _of_runs(
    weighing: Weighing, rows: IntArray, hypotheses: Sequence[Hypothesis], asked: BoolArray
) -> Weighing:
    """Return some of the runs by other hypotheses, as asked for (run, hypothesis)."""
    return replace(
        weighing,
        likelihood=weighing.likelihood[rows],
        hypotheses=hypotheses,
        components=weighing.components.of_runs(rows),
        place=weighing.place[rows],
        asked=asked,
        known=None,
    )


def _log_odds(weighing: Weighing, hypotheses: Sequence[Hypothesis]) -> FloatArray:
    """Return the log odds of hypotheses against healthy, (hypothesis,)."""
    factor_of = weighing.priors.factor_of
    return log_of(np.array([prior_odds(h) * factor_of(h) if h.known else 1.0 for h in hypotheses]))
