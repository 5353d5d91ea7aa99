from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import logsumexp

from failuretwin.core.numerics import log_of, log_sum, weighted_quantiles

logs = st.floats(-800, 800) | st.just(-np.inf)
grids = arrays(np.float64, (3, 4, 5), elements=logs)
numbers = st.floats(-100, 100)


@given(values=grids, axis=st.sampled_from([0, -1, (1, 2), (0, 1, 2)]))
def test_log_sum_is_that_of_scipy(values, axis):
    with np.errstate(divide="ignore"):
        expected = logsumexp(values, axis=axis)
    np.testing.assert_allclose(log_sum(values, axis), expected, rtol=1e-12, atol=1e-12)


def test_log_sum_of_nothing_is_minus_infinity():
    assert log_sum(np.full(3, -np.inf), 0) == -np.inf
    np.testing.assert_array_equal(
        log_sum(np.array([[-np.inf, -np.inf], [0.0, -np.inf]]), 1), [-np.inf, 0.0]
    )


def test_log_of_zero_is_minus_infinity():
    np.testing.assert_allclose(log_of([0.0, 1.0, np.e]), [-np.inf, 0.0, 1.0])


@given(values=arrays(np.int64, 9, elements=st.integers(-1000, 1000), unique=True))
def test_quantiles_of_equal_weights_are_those_of_numpy(values):
    levels = (0.05, 0.25, 0.5, 0.95)
    expected = np.quantile(values, levels, method="hazen")
    got = weighted_quantiles(values.astype(float), np.full(9, 0.3), levels)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-6)


def test_the_order_of_equal_values_does_not_matter():
    """What is there several times is a step: half of the weight at nought, the rest at 1 and 2."""
    values = np.array([0.0, 2.0, 1e-13, 1.0, -1e-13])
    weights = np.array([0.2, 0.25, 0.05, 0.25, 0.25])
    levels = (0.01, 0.3, 0.499, 0.625, 0.875)
    got = weighted_quantiles(values, weights, levels)
    np.testing.assert_allclose(got, [0.0, 0.0, 0.0, 1.0, 2.0], atol=1e-12)
    swapped = np.array([1e-13, 2.0, 0.0, 1.0, -1e-13])
    np.testing.assert_allclose(weighted_quantiles(swapped, weights, levels), got, atol=1e-12)


def test_quantiles_of_a_density_on_uneven_nodes():
    values = np.concatenate([np.linspace(-6, 0, 400), np.linspace(0.001, 6, 3000)])
    weights = np.gradient(values) * np.exp(-0.5 * values**2)
    got = weighted_quantiles(values, weights, (0.05, 0.5, 0.95))
    np.testing.assert_allclose(got, [-1.645, 0.0, 1.645], atol=0.01)


def test_values_without_weight_do_not_count():
    got = weighted_quantiles(np.array([[5.0, 1.0, 9.0]]), np.array([[0.0, 1.0, 0.0]]), (0.5,))
    np.testing.assert_allclose(got, [[1.0]])
