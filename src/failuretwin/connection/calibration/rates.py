"""How often things go wrong by chance, from counts in healthy logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, binom

from failuretwin.connection.calibration.observations import Observations
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import LostCommand, Range

LEVEL = (0.025, 0.975)
PRIOR_MOVEMENTS = 2.0
"""Late movements that the rate of the punctual ones is worth."""


@dataclass(frozen=True)
class Rate:
    """A share estimated from a count, with the Jeffreys prior.

    Attributes:
        hits: How often it happened.
        trials: Out of how many.
    """

    hits: int
    trials: int

    @property
    def mean(self) -> float:
        """Posterior mean [-]."""
        return (self.hits + 0.5) / (self.trials + 1.0)

    @property
    def interval(self) -> Range:
        """95 % interval [-]; it reaches 0 or 1 where nothing or everything was hit."""
        low, high = (
            float(beta.ppf(level, self.hits + 0.5, self.trials - self.hits + 0.5))
            for level in LEVEL
        )
        return (
            0.0 if self.hits == 0 else low,
            1.0 if self.hits == self.trials else high,
        )

    @property
    def log_deviation(self) -> float:
        """Standard deviation of its logarithm, roughly."""
        return float(1.0 / np.sqrt(self.hits + 0.5))


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
    observations: Observations, lost: BoolArray, late: BoolArray, names: list[str]
) -> list[LossRates]:
    """Return the rate of each single motor, and of each set that was seen to go together.

    Args:
        observations: Settled movements.
        lost: Motors that stayed, (movement, motor).
        late: Movements that started late, (movement,).
        names: Names of the motors.
    """
    seen = {tuple(np.flatnonzero(row).tolist()) for row in lost if row.any()}
    single = {(motor,) for motor in range(len(names))}
    rates = []
    for members in sorted(seen | single, key=lambda m: (len(m), m)):
        chosen = np.array(members)
        pattern = np.isin(np.arange(len(names)), chosen)
        exactly = (lost == pattern).all(axis=1)
        # A motor that is told to stay cannot be seen to lose a command.
        told = np.abs(observations.target - observations.origin)[:, chosen].min(axis=1) > 0.1
        counts = [
            Rate(int(np.sum(exactly & told & kind)), int(np.sum(told & kind)))
            for kind in (~late, late)
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
