from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.numerics import masked_median


@given(st.integers(1, 9), st.integers(0, 2**9 - 1), st.integers(0, 99))
def test_medians_are_those_of_the_values_kept(count, bits, seed):
    values = np.random.default_rng(seed).normal(size=(1, count))
    kept = np.array([[bool(bits >> k & 1) for k in range(count)]])
    expected = np.median(values[kept]) if kept.any() else 0.0
    assert masked_median(values, kept).tolist() == [expected]


def test_without_values_there_is_no_median():
    assert masked_median(np.zeros((2, 0)), np.zeros((2, 0), bool)).tolist() == [0.0, 0.0]
