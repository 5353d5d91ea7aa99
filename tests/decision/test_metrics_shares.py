from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from failuretwin.decision.proportions import Share, wilson_interval


@given(trials=st.integers(1, 4000), share=st.floats(0, 1))
def test_wilson_interval_is_that_of_scipy(trials, share):
    successes = round(share * trials)
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson_interval(successes, trials), expected, rtol=1e-9, atol=1e-12)
    assert Share(successes, trials).interval == wilson_interval(successes, trials)
    assert Share(successes, trials).value == successes / trials


def test_a_share_of_nothing_is_not_known():
    assert wilson_interval(0, 0) == Share(0, 0).interval == (0.0, 1.0)
    assert np.isnan(Share(0, 0).value)
