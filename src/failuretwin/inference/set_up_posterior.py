"""What is believed of the set-up of some runs, once the ways to make it wrong are weighed.

    p(w | runs) ~ p(w) p(runs | w)

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import FloatArray
from failuretwin.inference.misfit import FITS
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.set_ups import SetUp

DOUBT, MAY_BE = 1.0 / 9.0, 0.03
"""A zero that is probable by this second share where set-ups are as likely wrong as right is never
less probable than the first: five movements off by the same angle are what a fault and a zero both
show, and only the prior tells them apart."""
NEGLIGIBLE = 0.003
"""Set-ups less probable than this are left out; it bounds what they could change."""


@dataclass(frozen=True)
class WeighedSetUp:
    """What runs say of a set-up.

    Attributes:
        set_up: The set-up.
        log_evidence: log sum over h of p(h) p(run | w, h), (run,).
        misfit: How much worse the best hypotheses explain the runs than the density of a healthy
            arm at its best, as a share of what a tool that may be anywhere would be.
        moved: Whether the sensor may stand a little elsewhere too.
    """

    set_up: SetUp
    log_evidence: FloatArray
    misfit: float
    moved: bool = False

    @property
    def log_joint(self) -> float:
        """Log of prior times evidence."""
        return float(self.set_up.log_prior + self.log_evidence.sum())

    @property
    def fits(self) -> bool:
        """Whether it explains the runs as the healthy model says."""
        return self.misfit <= FITS

    @property
    def left_as_told(self) -> WeighedSetUp:
        """The same with nothing undone: a wrong guess must not spoil what the log shows."""
        none = LogCorrection.none(len(self.set_up.correction.z))
        return replace(self, set_up=replace(self.set_up, correction=none))


@dataclass(frozen=True)
class SetUpPosterior:
    """What is believed of the set-up of some runs.

    Attributes:
        found: Set-ups that are not negligible, the most probable first.
        probability: Of each.
    """

    found: Sequence[WeighedSetUp]
    probability: FloatArray

    @classmethod
    def of(cls, weighed: Sequence[WeighedSetUp]) -> SetUpPosterior:
        """Return the posterior over set-ups that were weighed by the same runs.

        Two ways to say the same count once. Nothing is undone where the most probable does not fit.
        """
        weighed = _distinct(weighed)
        log_joint = np.array([one.log_joint for one in weighed])
        share = np.exp(log_joint - log_sum(log_joint, axis=0))
        order = [i for i in np.argsort(-share, kind="stable") if share[i] > NEGLIGIBLE]
        if not weighed[order[0]].fits:  # no verdict is had behind it
            return cls([weighed[order[0]].left_as_told], np.ones(1))
        return cls([weighed[i] for i in order], share[order] / share[order].sum())

    def beside(self, first: SetUp) -> SetUpPosterior:
        """Return the same where something else is wrong for sure."""
        both = [
            replace(w, set_up=w.set_up.beside(first) if w.set_up.what else first)
            for w in self.found
        ]
        return SetUpPosterior(both, self.probability)

    @property
    def best(self) -> WeighedSetUp:
        """The most probable set-up."""
        return self.found[0]

    @property
    def wrong(self) -> float:
        """Probability that the set-up is not as told."""
        pairs = zip(self.found, self.probability, strict=True)
        return float(sum(share for one, share in pairs if one.set_up.what))

    @property
    def fits(self) -> bool:
        """Whether the most probable set-up explains the runs."""
        return self.best.fits


def with_doubt(weighed: Sequence[WeighedSetUp], rate: float) -> list[WeighedSetUp]:
    """Return set-ups with each zero that may well be no less probable than `DOUBT`.

    Whoever believes that a set-up is as likely wrong as right may believe in it; then it is a
    matter of the prior alone, which must not make anybody sure of a fault.

    Args:
        weighed: Weighed by the same runs; nothing is wrong with one of them.
        rate: Probability of a wrong set-up that they were weighed with.
    """
    told = max((w for w in weighed if not w.set_up.what), key=lambda one: one.log_joint)
    least = told.log_joint + float(log_of(DOUBT / (1.0 - DOUBT)))
    even = float(log_of(1.0 - rate) - log_of(rate))
    found = []
    for one in weighed:
        lacks = least - one.log_joint
        may_be = one.log_joint + even - told.log_joint > np.log(MAY_BE / (1.0 - MAY_BE))
        if one.set_up.kind == "zero" and may_be and lacks > 0.0:
            set_up = replace(one.set_up, log_prior=one.set_up.log_prior + lacks)
            one = replace(one, set_up=set_up)
        found.append(one)
    return found


def _distinct(weighed: Sequence[WeighedSetUp]) -> list[WeighedSetUp]:
    """Return the set-ups with each correction once, as it was weighed best, as it fits best."""
    found: dict[bytes, WeighedSetUp] = {}
    for one in sorted(weighed, key=lambda w: -w.log_joint):
        undo = one.set_up.correction
        parts = [np.round(part, 9) + 0.0 for part in (undo.C, undo.z, undo.M, undo.t)]
        key = b"".join(part.tobytes() for part in parts)
        known = found.setdefault(key, one)
        found[key] = replace(known, misfit=min(known.misfit, one.misfit))
    return list(found.values())
