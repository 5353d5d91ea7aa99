"""How long a worn motor lasts: when its wear passes a limit, as a distribution.

    x(t) = v phi(t) + sqrt(q) W(t),    phi in t^1/2 .. t^3, exponential,    y_i = x(t_i) + noise
    T = first t with |x(t)| >= limit

Averaged over shapes phi and diffusions q by how well each predicted every run from those before
(a Kalman filter each); before anything was seen steady wear is the most probable. A straight line
without diffusion is sure and wrong as soon as wear speeds up. Between two steps the limit is
crossed unseen with the probability of a Brownian bridge.

Section: docs/acting.md#remaining-life
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import softmax

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

POWERS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Exponents of t that wear may follow."""
RATES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
"""Growths exp(rate t / t_now) that wear may follow."""
DIFFUSIONS = (0.0, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0, 3.0)
"""Variance of the random walk in one step, in variances of one reading."""
STEADY = 10.0
"""Steady wear is so many times as probable as any other shape, before anything was seen; assumed:
else a few jumps that happen to lie on a curve are taken for one."""
BLOCKS = 100
"""Runs are averaged to so many at most: more say nothing new of shapes."""
FASTEST = 3.0
"""By now a motor may have worn by so many limits, one standard deviation of the prior."""
LEAST_RUNS = 20
"""Of fewer runs nothing is said of the time to come."""
SAMPLES = 2000
STEPS = 160
LONGEST = 20.0
"""The time to come that is looked at, in times that were seen."""
LARGEST = 1e12
IN_SIGHT, AHEAD = 0.05, 0.5
"""An end is in sight if its probability within so many times the runs that were seen exceeds this:
a growth that nothing shows yet can always begin."""

VAGUE = 10.0
"""If the last of the likely ends lies so many times as far as the first, and is not in sight, it
cannot be told when."""


@dataclass(frozen=True)
class RemainingLife:
    """How many runs a motor has left.

    Attributes:
        runs: Equally likely numbers of runs, sorted, (sample,); infinite: beyond what is looked at.
        seen: Runs that were seen.
        level: Wear now, in the unit of the limit.
        limit: Wear at which life ends.
    """

    runs: FloatArray
    seen: int
    level: float
    limit: float

    def quantile(self, share: float) -> float:
        """Return the number of runs by which life has ended with a probability."""
        at = min(int(np.ceil(share * len(self.runs))) - 1, len(self.runs) - 1)
        return float(self.runs[max(at, 0)])

    def ended_within(self, runs: float) -> float:
        """Return the probability that life ends within so many runs."""
        return float(np.mean(self.runs <= runs))

    @property
    def in_sight(self) -> bool:
        """Whether an end may come within half as many runs as were seen."""
        return self.ended_within(AHEAD * self.seen) > IN_SIGHT

    @property
    def verdict(self) -> str:
        """One plain sentence."""
        if not self.in_sight:
            return (
                f"no end in sight: {self.ended_within(AHEAD * self.seen):.1%} that it comes within "
                f"the next {AHEAD * self.seen:.0f} runs"
            )
        low, middle, high = (self.quantile(share) for share in (0.05, 0.5, 0.95))
        if np.isinf(high):
            return f"cannot tell when it ends: at least {low:.0f} runs left (95 %)"
        if high > max(VAGUE * low, AHEAD * self.seen):
            return f"cannot tell when it ends: {low:.0f} to {high:.0f} runs left (90 %)"
        return f"about {middle:.0f} runs left (90 %: {low:.0f} to {high:.0f})"

    def to_progpy(self, event: str = "worn out") -> list[dict[str, float]]:
        """Return samples of the time of event for ``progpy.uncertain_data.UnweightedSamples``."""
        return [{event: float(value)} for value in self.runs]


def remaining_life(
    wear: FloatArray, variance: FloatArray | float, limit: float, rng: np.random.Generator
) -> RemainingLife:
    """Return how long a motor lasts.

    Args:
        wear: What each run says of it by itself, from new on, (run,); NaN: a run that says nothing.
        variance: Variance of each, (run,) or one for all.
        limit: Wear at which life ends, either way, in the same unit.
        rng: Source of chance.

    Raises:
        InputError: If there are too few runs, or the limit or a variance is not above 0.
    """
    wear = np.asarray(wear, dtype=np.float64)
    variance = np.broadcast_to(np.asarray(variance, dtype=np.float64), wear.shape)
    known = np.isfinite(wear)
    if known.sum() < LEAST_RUNS:
        raise InputError(
            f"{int(known.sum())} runs say something of the wear, expected {LEAST_RUNS} at least."
        )
    if not (limit > 0.0 and np.all(variance[known] > 0.0)):
        raise InputError("the limit and all variances must lie above 0.")
    time, mean, spread = _blocks(wear, variance)
    bank = _Filters.of(time, mean, spread, limit, float(len(wear)))
    runs = bank.lifetimes(limit, float(time[-1]), float(len(wear)), rng)
    return RemainingLife(np.sort(runs), len(wear), float(bank.weight @ bank.mean[:, 0]), limit)


def _blocks(wear: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return middle, mean and variance of blocks of runs, (block,); the level is of the middle."""
    size = max(1, int(np.ceil(len(wear) / BLOCKS)))
    time, mean, spread = [], [], []
    for first in range(0, len(wear), size):
        rows = np.flatnonzero(np.isfinite(wear[first : first + size])) + first
        if len(rows):
            weight = 1.0 / variance[rows]
            time.append(np.sum(weight * (rows + 0.5)) / weight.sum())
            mean.append(np.sum(weight * wear[rows]) / weight.sum())
            spread.append(1.0 / weight.sum())
    return np.array(time), np.array(mean), np.array(spread)


def _shapes(time: FloatArray, now: float) -> FloatArray:
    """Return phi of every shape, (shape, time); all are 0 at first and `now` now."""
    share = np.asarray(time) / now
    powers = [share**power for power in POWERS]
    with np.errstate(over="ignore"):
        growths = [np.expm1(rate * share) / np.expm1(rate) for rate in RATES]
    return np.minimum(now * np.array(powers + growths), LARGEST)


@dataclass(frozen=True)
class _Filters:
    """Kalman filters of level and rate (x, v), one for each shape and diffusion.

    Attributes:
        shape: Which shape, (filter,).
        diffusion: q, variance of the random walk in one run, (filter,).
        mean: Mean of (x, v) at the last block, (filter, 2).
        spread: Covariance of that, (filter, 2, 2).
        weight: Probability, (filter,).
    """

    shape: IntArray
    diffusion: FloatArray
    mean: FloatArray
    spread: FloatArray
    weight: FloatArray

    @classmethod
    def of(
        cls, time: FloatArray, wear: FloatArray, variance: FloatArray, limit: float, now: float
    ) -> _Filters:
        """Return the filters after all blocks; a new motor begins with level 0."""
        shapes = _shapes(np.append(0.0, time), now)
        step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
        shape = np.repeat(np.arange(len(shapes)), len(DIFFUSIONS))
        q = np.tile(np.array(DIFFUSIONS) * float(np.median(variance)) / step, len(shapes))
        mean, spread = np.zeros((len(q), 2)), np.zeros((len(q), 2, 2))
        spread[:, 1, 1] = (FASTEST * limit / now) ** 2
        move = np.tile(np.eye(2), (len(q), 1, 1))
        log_evidence = np.where(shape == POWERS.index(1.0), np.log(STEADY), 0.0)
        walked = np.diff(time, prepend=0.0)
        for i in range(len(time)):
            move[:, 0, 1] = shapes[shape, i + 1] - shapes[shape, i]
            mean = (move @ mean[..., None])[..., 0]
            spread = move @ spread @ move.mT
            spread[:, 0, 0] += q * walked[i]
            total, off = spread[:, 0, 0] + variance[i], wear[i] - mean[:, 0]
            log_evidence += -0.5 * (np.log(2.0 * np.pi * total) + off**2 / total)
            gain = spread[:, :, 0] / total[:, None]
            mean = mean + gain * off[:, None]
            spread = spread - gain[:, :, None] * spread[:, None, 0]
        return cls(shape, q, mean, spread, np.asarray(softmax(log_evidence)))

    def lifetimes(
        self, limit: float, last: float, now: float, rng: np.random.Generator
    ) -> FloatArray:
        """Return numbers of runs left, (sample,); `last` is the time of the last block."""
        pick = rng.choice(len(self.weight), SAMPLES, p=self.weight)
        q, shape, (x, v) = self.diffusion[pick], self.shape[pick], self.mean[pick].T
        root = np.sqrt(np.maximum(self.spread[pick, 0, 0], 1e-300))
        cross = self.spread[pick, 0, 1] / root
        rest = np.sqrt(np.maximum(self.spread[pick, 1, 1] - cross**2, 0.0))
        z = rng.standard_normal((2, SAMPLES))
        x, v = x + root * z[0], v + cross * z[0] + rest * z[1]
        time = np.append(last, now + np.geomspace(1.0, LONGEST * now, STEPS))
        shapes = _shapes(time, now)
        ended = np.where(np.abs(x) >= limit, 0.0, np.inf)
        for i, dt in enumerate(np.diff(time).tolist()):
            drift = v * (shapes[shape, i + 1] - shapes[shape, i])
            after = x + drift + np.sqrt(q * dt) * rng.standard_normal(SAMPLES)
            hit = np.isinf(ended) & (rng.random(SAMPLES) < _crossed(x, after, limit, q * dt))
            at = time[i] + dt * rng.random(SAMPLES) - now
            ended[hit] = np.maximum(at[hit], 0.0)
            x = after
        return ended


def _crossed(
    before: FloatArray, after: FloatArray, limit: float, variance: FloatArray
) -> FloatArray:
    """Return the probability that either limit was passed between two times.

    1 beyond it, else exp(-2 (D - x) (D - x') / variance), of the nearer side.
    """
    chance = np.zeros_like(before)
    for side in (1.0, -1.0):
        room, left = limit - side * before, limit - side * after
        product = 2.0 * np.maximum(room, 0.0) * np.maximum(left, 0.0)
        away = np.divide(product, variance, out=np.full_like(product, np.inf), where=variance > 0.0)
        inside = np.exp(-away)
        chance = np.maximum(chance, np.where((room <= 0.0) | (left <= 0.0), 1.0, inside))
    return chance


# Histories of tracked robots.


def motor_lives(
    rows: Sequence[Mapping[str, Any]], model: HealthyModel, rng: np.random.Generator
) -> dict[str, RemainingLife | None]:
    """Return the remaining life of each motor, from the bias that each run shows by itself.

    The unit of wear is the scatter of the motor. Runs with an alarm are left out. None: too few
    runs show the wear of a motor.
    """
    names = model.motor_names
    scatter = wear_unit(model)[: len(names)]
    wear, deviation = (_per_run(rows, key) / scatter for key in BIAS_ALONE)
    limit, found = WearLimits().limit, dict[str, RemainingLife | None]()
    for k, name in enumerate(names):
        enough = np.isfinite(wear[:, k]).sum() >= LEAST_RUNS
        found[name] = (
            remaining_life(wear[:, k], deviation[:, k] ** 2, limit, rng) if enough else None
        )
    return found


BIAS_ALONE = ("bias_alone", "bias_alone_deviation")
"""Keys of the bias that one run shows by itself, and of its standard deviation [rad]."""


def _per_run(rows: Sequence[Mapping[str, Any]], key: str) -> FloatArray:
    """Return the values of a key, (run, motor); NaN: no value, or a run with an alarm."""
    return np.array(
        [
            [np.nan if value is None or row["alarm"] else value for value in row[key]]
            for row in rows
        ],
        dtype=np.float64,
    )
