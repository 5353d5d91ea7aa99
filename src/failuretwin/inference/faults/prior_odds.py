"""Prior odds of hypotheses against healthy, and how the faults of a motor share its rate.

    p(h) ~ o_h = product over its faults of the odds of their modes,   p(healthy) ~ healthy_odds

Section: docs/inference.md#posterior
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.priors import Priors

UNKNOWN_ODDS = 1.0
"""Odds of `unknown` against healthy where nothing is seen; each explanation of what is seen has
odds of its own in its evidence, none has more."""


def prior_odds(hypothesis: Hypothesis) -> float:
    """Return the odds of a hypothesis against healthy; faults of several motors multiply."""
    return math.prod((MODES[fault.mode].prior_odds for fault in hypothesis.faults), start=1.0)


def log_prior(hypotheses: Sequence[Hypothesis], priors: Priors) -> FloatArray:
    """Return the log prior probability of each hypothesis, (hypothesis,)."""
    odds = np.array([prior_odds(h) if h.known else UNKNOWN_ODDS for h in hypotheses])
    odds *= [priors.factor_of(h) for h in hypotheses]
    odds[[h.is_healthy for h in hypotheses]] *= priors.healthy_odds
    return np.asarray(np.log(odds / odds.sum()))


def shares_of_motors(hypotheses: Sequence[Hypothesis]) -> FloatArray:
    """Return the share of each single fault in all faults of its motor, (hypothesis,); else 0."""
    single = [h.known and len(h.faults) == 1 for h in hypotheses]
    motors = [h.faults[0].motor if one else "" for h, one in zip(hypotheses, single, strict=True)]
    odds = np.array([prior_odds(h) for h in hypotheses]) * single
    total = np.array([odds[[m == motor for m in motors]].sum() for motor in motors])
    return np.divide(odds, total, out=np.zeros_like(odds), where=total > 0.0)
