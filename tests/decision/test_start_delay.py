from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from failuretwin.inference.observation.start_delay import StartDelay


def moments(delay, share):
    mean = np.sum(share * delay)
    return mean, np.sqrt(np.sum(share * (delay - mean) ** 2))


def test_punctual_starts_are_normal_about_the_lag():
    delay, share = StartDelay.of(0.1, (0.5, 1.5)).nodes(np.array([0.0]))
    assert share[0].sum() == pytest.approx(1.0)
    middle = delay[np.argsort(-share[0])[:3]]
    ratio = stats.norm.pdf(0.02, scale=0.018) / stats.norm.pdf(0.0, scale=0.018)
    assert sorted(middle) == pytest.approx([0.08, 0.1, 0.12])
    assert np.sort(share[0])[-2] / share[0].max() == pytest.approx(ratio)
    assert moments(delay, share[0]) == pytest.approx((0.1, 0.018), abs=0.001)


def test_late_starts_are_even_over_their_range_beside_the_lag():
    delay, share = StartDelay.of(0.1, (0.5, 1.5)).nodes(np.array([1.0, 0.25]))
    assert (delay[share[0] > 0].min(), delay.max()) == pytest.approx((0.6, 1.6))
    assert moments(delay, share[0]) == pytest.approx((1.1, 1.0 / np.sqrt(12.0)), abs=0.03)
    assert share[1, delay > 0.5].sum() == pytest.approx(0.25)


def test_nothing_moves_before_its_command():
    assert StartDelay.of(0.01, (0.5, 1.5)).punctual.delay.min() == 0.0
