"""Rates of faults that a fleet teaches: Gamma-Poisson over the table's priors.

    lambda ~ Gamma(w, w / lambda_0),   n | lambda ~ Poisson(lambda T)
    lambda | n ~ Gamma(w + n, w / lambda_0 + T)

with the rate of the table lambda_0, n confirmed faults in a robot time of T, and the weight w of
the table in faults. Where the age of a motor is known, the hazard is constant within bands of age:
n and T are those of its band.

Section: docs/store.md#learned-rates-of-faults
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from failuretwin.core.errors import counted
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.inference.explanation import plain_name
from failuretwin.inference.faults.prior_odds import shares_of_motors
from failuretwin.inference.together.fault_filter import RATES

if TYPE_CHECKING:
    from failuretwin.data_knowledge.records.fleet import FleetFaults

WEIGHT = 2.0
"""Faults that the table counts as; assumed. A single confirmation multiplies the odds of a fault by
1 + 1 / w = 1.5 at most."""
INTERVAL = 0.9


@dataclass(frozen=True)
class FaultRate:
    """Rate of a fault: posterior of lambda.

    Attributes:
        name: ``MOTOR:MODE``.
        table_per_h: Rate of the table lambda_0 [1/h].
        confirmed: Confirmed faults n.
        hours: Robot time T [h].
        ages_h: Lowest and highest age of the motors that these are of [h].
    """

    name: str
    table_per_h: float
    confirmed: int
    hours: float
    ages_h: tuple[float, float] = (0.0, np.inf)

    @property
    def ages(self) -> str:
        """The ages in words."""
        low, high = (age / 24.0 for age in self.ages_h)
        if np.isfinite(high):
            return f"{low:.0f} to {high:.0f} days"
        return f"from {low:.0f} days" if low else "any"

    @property
    def mean_per_h(self) -> float:
        """Posterior mean [1/h]."""
        return (WEIGHT + self.confirmed) / (WEIGHT / self.table_per_h + self.hours)

    @property
    def factor(self) -> float:
        """Posterior mean over the rate of the table."""
        return self.mean_per_h / self.table_per_h

    @property
    def interval_per_h(self) -> FloatArray:
        """Interval of 90 %, low and high [1/h]."""
        ends = 0.5 + 0.5 * INTERVAL * np.array([-1.0, 1.0])
        scale = 1.0 / (WEIGHT / self.table_per_h + self.hours)
        return np.asarray(scale * gammaincinv(WEIGHT + self.confirmed, ends))


def table_rates(hypotheses: Sequence[Hypothesis]) -> dict[str, float]:
    """Return the rate of each single fault by the table [1/h]: a motor's, shared by its modes."""
    each_per_h = RATES.faults_per_1000_h / 1000.0
    shares = zip(hypotheses, shares_of_motors(hypotheses).tolist(), strict=True)
    return {str(h): each_per_h * share for h, share in shares if share > 0.0}


@dataclass(frozen=True)
class LearnedRates:
    """Rates of faults of a kind of robot.

    Attributes:
        seen: The faults that they rest on.
        rates: The rate of each fault.
    """

    seen: FleetFaults
    rates: Sequence[FaultRate]

    @classmethod
    def of(
        cls,
        seen: FleetFaults,
        hypotheses: Sequence[Hypothesis],
        ages: Mapping[str, float] | None = None,
    ) -> LearnedRates:
        """Return the rates of the single faults among some hypotheses.

        `ages` are those of motors [h]; of others all ages count.
        """
        rates = []
        for name, per_h in table_rates(hypotheses).items():
            motor = name.partition(":")[0]
            band = seen.at_risk(motor, (ages or {}).get(motor))
            found = band.confirmed.get(name, 0), band.hours, (band.low_h, band.high_h)
            rates.append(FaultRate(name, per_h, *found))
        return cls(seen, rates)

    @property
    def factors(self) -> dict[str, float]:
        """How many times as probable each fault is as by the table."""
        return {rate.name: rate.factor for rate in self.rates}

    @property
    def line(self) -> str:
        """What they rest on, in a line: the counts of the rates themselves."""
        seen, most = self.seen, max(self.rates, key=lambda rate: rate.mean_per_h, default=None)
        used, every = sum(rate.confirmed for rate in self.rates), sum(seen.confirmed.values())
        robots = f"{counted(seen.robots, 'robot')} ({seen.kind})"
        told = f"{counted(used, 'confirmed fault')} of {robots}"
        if used < every:
            told = (
                f"{used} of {counted(every, 'confirmed fault')} of {robots}, those of motors as "
                "old as this robot's"
            )
        if most is None or not used:
            return told
        low, high = 1000.0 * most.interval_per_h
        return (
            f"{told}; most often {plain_name(Hypothesis.parse(most.name))}, "
            f"{1000.0 * most.mean_per_h:.2g} in 1000 h "
            f"({low:.2g} to {high:.2g}), {most.factor:.2g} times the assumed rate"
        )


def reweighted(posterior: Mapping[str, float], factors: Mapping[str, float]) -> dict[str, float]:
    """Return a posterior under other priors: the odds of each fault times its factor."""
    parsed = {name: Hypothesis.parse(name).faults for name in posterior}
    weight = {
        name: value * float(np.prod([factors.get(str(fault), 1.0) for fault in parsed[name]]))
        for name, value in posterior.items()
    }
    total = sum(weight.values())
    return {name: value / total for name, value in weight.items()}
