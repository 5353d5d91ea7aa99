"""How often things go wrong by chance, from counts in healthy logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import beta, binom

from failuretwin.connection.calibration.observations import TRAVEL_RAD, Observations
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.nonidealities import LostCommand, Range

LEVEL = (0.025, 0.975)
PRIOR_MOVEMENTS = 2.0
"""Late movements that the rate of the punctual ones is worth."""


@dataclass(frozen=True)
class Rate:
    """A share estimated from a count.

    Attributes:
        hits: How often it happened.
        trials: Out of how many.
    """

    hits: int
    trials: int

    @property
    def mean(self) -> float:
        """Posterior mean with the Jeffreys prior [-]."""
        return (self.hits + 0.5) / (self.trials + 1.0)

    @property
    def identified(self) -> bool:
        """Whether it was seen to happen; otherwise there is only a bound from above."""
        return self.hits > 0

    @property
    def interval(self) -> Range:
        """95 % interval [-]; it reaches 0 or 1 where nothing or everything was hit.

        What is called identified has been seen at least once, and of rare things that alone makes
        the count too high: the interval is that of a binomial count which is not 0. Half the
        probability of the count itself lies on either side (mid-P), as with the Jeffreys prior.
        """
        if self.hits == 0:
            return 0.0, 1.0 if self.trials == 0 else float(
                beta.ppf(LEVEL[1], 0.5, self.trials + 0.5)
            )
        low = 0.0 if self._below(0.0) <= LEVEL[1] else self._rate_at(LEVEL[1])
        return low, 1.0 if self.hits == self.trials else self._rate_at(LEVEL[0])

    def _below(self, rate: float) -> float:
        """Return the probability of fewer hits, and half that of as many, if there are any."""
        if rate == 0.0:
            return 0.5 if self.hits == 1 else 1.0
        none = binom.pmf(0, self.trials, rate)
        fewer = binom.cdf(self.hits - 1, self.trials, rate) - none
        return float((fewer + 0.5 * binom.pmf(self.hits, self.trials, rate)) / (1.0 - none))

    def _rate_at(self, level: float) -> float:
        return float(brentq(lambda rate: self._below(rate) - level, 1e-9, 1.0 - 1e-9))


@dataclass(frozen=True)
class LossRates:
    """How often each set of motors loses a command, in punctual and in late movements."""

    motors: tuple[str, ...]
    punctual: Rate
    late: Rate

    def entry(self) -> LostCommand:
        """Return it as a value of the digital model.

        Where few movements were late, the punctual ones say what they can.
        """
        punctual = self.punctual.mean if self.punctual.trials else 0.0
        late = (self.late.hits + PRIOR_MOVEMENTS * punctual) / (self.late.trials + PRIOR_MOVEMENTS)
        return LostCommand(self.motors, punctual, late)


def loss_rates(
    observations: Observations,
    lost: BoolArray,
    punctual: BoolArray,
    delayed: BoolArray,
    names: list[str],
) -> list[LossRates]:
    """Return the rate of each single motor, and of each set that was seen to go together.

    Args:
        observations: Settled movements.
        lost: Motors that stayed, (movement, motor).
        punctual: Movements that started on time, (run, movement).
        delayed: Movements that started late, (run, movement); what is neither does not count.
        names: Names of the motors.
    """
    at = observations.run, observations.number
    seen = {tuple(np.flatnonzero(row).tolist()) for row in lost if row.any()}
    single = {(motor,) for motor in range(len(names))}
    rates = []
    for members in sorted(seen | single, key=lambda m: (len(m), m)):
        chosen = np.array(members)
        pattern = np.isin(np.arange(len(names)), chosen)
        exactly = (lost == pattern).all(axis=1)
        # A motor that is told to stay cannot be seen to lose a command.
        travel = np.abs(observations.target - observations.origin)[:, chosen].min(axis=1)
        told = travel > TRAVEL_RAD
        counts = [
            Rate(int(np.sum(exactly & told & kind)), int(np.sum(told & kind)))
            for kind in (punctual[at], delayed[at])
        ]
        rates.append(LossRates(tuple(names[m] for m in members), counts[0], counts[1]))
    return rates


def median_interval(values: FloatArray) -> tuple[float, float, float]:
    """Return the median and its 95 % interval by order statistics, whatever the distribution.

    How many of n values lie below the median is binomial; below six values even the extremes hold
    it less often than that.
    """
    ordered, count = np.sort(values), len(values)
    rank = int(binom.ppf(LEVEL[0], count, 0.5))
    low = ordered[max(rank - 1, 0)]
    high = ordered[min(count - rank, count - 1)]
    return float(np.median(values)), float(low), float(high)


def spread_of(values: FloatArray) -> Range:
    """Return the range of uniform draws, robustly: median and twice the median deviation."""
    middle = float(np.median(values))
    half = 2.0 * float(np.median(np.abs(values - middle)))
    return middle - half, middle + half
