from __future__ import annotations

import numpy as np
from scipy.stats import norm

from failuretwin.decision.proportions import Coverage, IntervalCase, Share, coverage_by_mode


def test_truths_are_counted_on_either_side():
    cases = [
        IntervalCase("stuck", "onset", 1.0, 2.0, truth) for truth in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
    ]
    cases.append(IntervalCase("drift", "onset", 0.0, 0.0, 0.0))
    assert coverage_by_mode(cases) == [
        Coverage("stuck", "onset", Share(3, 6), below=1, above=2, points=0),
        Coverage("drift", "onset", Share(1, 1), below=0, above=0, points=1),
    ]


def test_intervals_of_an_exact_posterior_cover_what_they_say():
    """Also where runs were chosen by what the data say, as a diagnosis chooses them."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=20_000)
    mean = (truth + rng.normal(size=20_000)) / 2
    half = norm.ppf(0.95) * np.sqrt(0.5)
    chosen = mean > 0.3
    cases = [
        IntervalCase("stuck", "magnitude", m - half, m + half, t)
        for m, t in zip(mean[chosen], truth[chosen], strict=True)
    ]
    (coverage,) = coverage_by_mode(cases)
    low, high = coverage.inside.interval
    assert low < 0.9 < high
    assert high - low < 0.02
