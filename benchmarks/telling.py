"""How benchmarks tell what they found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.scoring import Share, calibrated_error, log_score, reliability


def share(count: int, total: int) -> str:
    """Return so many of so many, with the Wilson 95 % interval."""
    told = Share(count, total)
    low, high = told.interval
    return f"{count} of {total} ({told.value:.1%}, {low:.1%} to {high:.1%})"


def per_100_hours(count: int, hours: float) -> str:
    """Return so many in so many hours as a rate in 100 hours, with the 95 % Poisson interval."""
    low = stats.chi2.ppf(0.025, 2 * count) / 2.0 if count else 0.0
    high = stats.chi2.ppf(0.975, 2 * count + 2) / 2.0
    return f"{100 * count / hours:6.1f} [{100 * low / hours:5.1f} to {100 * high / hours:5.1f}]"


def right(found: Sequence[Diagnosis]) -> BoolArray:
    """Return which diagnoses are right, (run,); one without a verdict is not."""
    return np.array([d.diagnosis == d.truth for d in found])


def nats(found: Sequence[Diagnosis]) -> FloatArray:
    """Return the log score of each run, (run,) [nats]."""
    return log_score([str(d.truth) for d in found], [d.posterior for d in found])


def calibration(found: Sequence[Diagnosis], rng: np.random.Generator) -> str:
    """Return the calibration error of those with a verdict, and what chance alone shows."""
    told = [d for d in found if d.diagnosis is not None]
    sure = np.array([d.probability for d in told])
    bins = reliability(sure, right(told))
    chance = calibrated_error(sure, rng)
    return (
        f"calibration error {bins.error:.4f} (a perfect one shows {np.mean(chance):.4f} by "
        f"chance, {np.quantile(chance, 0.95):.4f} at most in 95 %)"
    )
