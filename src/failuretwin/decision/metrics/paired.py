"""Which of two methods is better on the same runs?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray

DRAWS = 10_000
"""Bootstrap samples."""
CHUNK = 1_000_000
"""Runs drawn at a time, so that memory stays small."""


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of two methods on the same runs (McNemar, Psychometrika 1947).

    Attributes:
        both: Runs that both got right.
        first_only: Runs that only the first got right.
        second_only: Runs that only the second got right.
        neither: Runs that both got wrong.
        p: Two-sided chance of a split of the runs on which they differ at least as uneven, if both
            methods were equally good (binomial with one half).
    """

    both: int
    first_only: int
    second_only: int
    neither: int
    p: float


@dataclass(frozen=True)
class LogScoreGain:
    """Nats a run that the second method saves; positive: the second is better.

    Attributes:
        mean: Mean over all runs of first minus second [nats a run]; infinite where one method
            alone ruled out a truth, NaN where each ruled out one that the other did not.
        finite_mean: The same over the runs whose truth neither ruled out; NaN if there are none.
        interval: 95 % bootstrap interval of `finite_mean` (percentiles; Efron 1979).
        runs: Runs behind `finite_mean`.
        first_impossible: Runs whose truth only the first method ruled out.
        second_impossible: Runs whose truth only the second ruled out.
        both_impossible: Runs whose truth both ruled out: no difference there.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    first_impossible: int
    second_impossible: int
    both_impossible: int


def mcnemar(first: BoolArray, second: BoolArray) -> McNemar:
    """Compare which runs two methods got right.

    Args:
        first: Whether the first method was right, (run,).
        second: The same of the second, on the same runs, (run,).

    Raises:
        InputError: If they do not have the same runs.
    """
    from scipy.stats import binomtest

    _check_same_runs(first, second)
    only = int((first & ~second).sum()), int((second & ~first).sum())
    p = float(binomtest(only[0], sum(only)).pvalue) if sum(only) else 1.0
    return McNemar(int((first & second).sum()), *only, int((~first & ~second).sum()), p)


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> LogScoreGain:
    """Compare the log scores of two methods run by run.

    Args:
        first: Log score of each run by the first method, (run,) [nats]; may be infinite.
        second: The same by the second method, on the same runs, (run,) [nats].
        rng: Source of chance.
        draws: Bootstrap samples.

    Raises:
        InputError: If they do not have the same runs.
    """
    _check_same_runs(first, second)
    lost_first, lost_second = np.isinf(first), np.isinf(second)
    kept = ~(lost_first | lost_second)
    gain = first[kept] - second[kept]
    finite_mean = float(gain.mean()) if gain.size else float("nan")
    alone = int((lost_first & ~lost_second).sum()), int((lost_second & ~lost_first).sum())
    return LogScoreGain(
        mean=_mean(alone, float(gain.sum()) / len(first)),
        finite_mean=finite_mean,
        interval=_bootstrap_interval(gain, rng, draws),
        runs=int(gain.size),
        first_impossible=alone[0],
        second_impossible=alone[1],
        both_impossible=int((lost_first & lost_second).sum()),
    )


def _mean(alone: tuple[int, int], finite: float) -> float:
    if alone[0] and alone[1]:
        return float("nan")
    if alone[0] or alone[1]:
        return float("inf") if alone[0] else float("-inf")
    return finite


def _bootstrap_interval(
    values: FloatArray, rng: np.random.Generator, draws: int
) -> tuple[float, float]:
    if values.size == 0:
        return float("nan"), float("nan")
    step = max(1, CHUNK // values.size)
    means = [
        values[rng.integers(0, values.size, (min(step, draws - i), values.size))].mean(axis=1)
        for i in range(0, draws, step)
    ]
    low, high = np.quantile(np.concatenate(means), [0.025, 0.975])
    return float(low), float(high)


def _check_same_runs(first: BoolArray | FloatArray, second: BoolArray | FloatArray) -> None:
    if first.shape != second.shape or first.ndim != 1 or first.size == 0:
        raise InputError(
            f"two methods are compared on the same runs; got {first.shape} and {second.shape}."
        )
