"""How often things go wrong by chance, from counts in healthy logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import beta

from failuretwin.connection.calibration.observations import Observations
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import LostCommand, Range

LEVEL = (0.025, 0.975)


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
        """Return it as a value of the digital model."""
        return LostCommand(self.motors, self.punctual.mean, self.late.mean)


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


def uniform_range(values: FloatArray) -> tuple[Range, Range, Range] | None:
    """Return the range of uniform draws and the 95 % intervals of its ends; None below 3 values.

    For n draws with least m and spread R the true lower end lies above m - R (p^(-1/(n-1)) - 1)
    with probability 1 - p: the ratio of the gap to R has the distribution function
    1 - (1 + t)^-(n-1).
    """
    if len(values) < 3:
        return None
    low, high = float(values.min()), float(values.max())
    spread = high - low
    reach = spread * (0.05 ** (-1.0 / (len(values) - 1)) - 1.0)
    step = spread / (len(values) - 1)
    return (low - step, high + step), (low - reach, low), (high, high + reach)
