from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from failuretwin.inference.fault_models import size_nodes

LOW, HIGH = 0.02, 0.85
pointed = arrays(np.float64, (2, 3), elements=st.floats(-2, 2))
widths = arrays(np.float64, (2, 3), elements=st.floats(1e-4, 1))


@given(best=pointed, width=widths, usable=arrays(bool, (2, 3)))
def test_all_sizes_in_range_are_as_likely_wherever_the_nodes_are(best, width, usable):
    """The means are those of a uniform density, which straight lines are summed for exactly."""
    size, log_mass = size_nodes(best, width, usable, (LOW, HIGH), signed=True)
    mass = np.exp(log_mass)
    assert np.all((np.abs(size) >= LOW) & (np.abs(size) <= HIGH))
    np.testing.assert_allclose(mass.sum(axis=1), 1.0)
    np.testing.assert_allclose((mass * np.abs(size)).sum(axis=1), 0.5 * (LOW + HIGH), rtol=1e-9)
    np.testing.assert_allclose((mass * size).sum(axis=1), 0.0, atol=1e-9)


@given(best=pointed, width=widths, usable=arrays(bool, (2, 3)))
def test_sizes_without_a_sign_are_positive(best, width, usable):
    size, log_mass = size_nodes(best, width, usable, (LOW, HIGH), signed=False)
    assert np.all((size >= LOW) & (size <= HIGH))
    mean = (np.exp(log_mass) * size).sum(axis=1)
    np.testing.assert_allclose(mean, 0.5 * (LOW + HIGH), rtol=1e-9)


def test_nodes_crowd_where_a_movement_points():
    best, width = np.array([[0.3]]), np.array([[0.001]])
    size, _ = size_nodes(best, width, np.array([[True]]), (LOW, HIGH), signed=True)
    assert np.sum(np.abs(size - 0.3) <= 0.008 + 1e-12) >= 15
    assert size[0] == pytest.approx(np.sort(size[0]))
