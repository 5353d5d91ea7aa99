from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import integrate

from failuretwin.inference.faults.fault_sizes import redrawn_nodes, size_nodes

LOW, HIGH = 0.02, 0.85
pointed = arrays(np.float64, (2, 3), elements=st.floats(-2, 2))
widths = arrays(np.float64, (2, 3), elements=st.floats(1e-4, 1))


@given(best=pointed, width=widths, usable=arrays(bool, (2, 3)))
def test_all_sizes_in_range_are_as_likely_wherever_the_nodes_are(best, width, usable):
    """The means are those of a uniform density, which straight lines are summed for exactly."""
    size, log_mass = size_nodes(best, width, usable, [(LOW, HIGH)], signed=True)
    mass = np.exp(log_mass[:, 0])
    assert np.all((np.abs(size) >= LOW) & (np.abs(size) <= HIGH))
    np.testing.assert_allclose(mass.sum(axis=1), 1.0)
    np.testing.assert_allclose((mass * np.abs(size)).sum(axis=1), 0.5 * (LOW + HIGH), rtol=1e-9)
    np.testing.assert_allclose((mass * size).sum(axis=1), 0.0, atol=1e-9)


@given(best=pointed, width=widths, usable=arrays(bool, (2, 3)))
def test_sizes_without_a_sign_are_positive(best, width, usable):
    size, log_mass = size_nodes(best, width, usable, [(LOW, HIGH)], signed=False)
    assert np.all((size >= LOW) & (size <= HIGH))
    mean = (np.exp(log_mass[:, 0]) * size).sum(axis=1)
    np.testing.assert_allclose(mean, 0.5 * (LOW + HIGH), rtol=1e-9)


def test_nodes_crowd_where_a_movement_points():
    best, width = np.array([[0.3]]), np.array([[0.001]])
    size, _ = size_nodes(best, width, np.array([[True]]), [(LOW, HIGH)], signed=True)
    assert np.sum(np.abs(size - 0.3) <= 0.008 + 1e-12) >= 15
    assert size[0] == pytest.approx(np.sort(size[0]))


def bell(at, width, dof):
    """The likelihood of an offset, that of a position in space as one motor moves."""
    return (1.0 + (at / width) ** 2 / dof) ** (-0.5 * (dof + 3.0))


WIDE = ((5e-4, 2.5e-3), (2e-3, 0.01), (8e-3, 0.04), (0.03, 0.15), (0.12, 0.6))
"""From 0.03 to 34 degrees [rad]."""


@pytest.mark.parametrize("dof", [4.0, 30.0])
@pytest.mark.parametrize("width", [3e-4, 2e-3, 0.02, 0.1])
@pytest.mark.parametrize("offset", [0.0, 7e-4, -3e-3, 0.0123, -0.0605, 0.31])
@pytest.mark.parametrize("redrawn", [True, False])
def test_sums_over_nodes_are_integrals(dof, width, offset, redrawn):
    """Narrow and wide likelihoods over sizes of three orders of magnitude, by brute force."""
    at, spread, usable = np.array([[offset]]), np.array([[width]]), np.array([[True]])
    if redrawn:
        size, log_mass = (x[0] for x in redrawn_nodes(at, spread, usable, WIDE, width))
    else:
        size, log_mass = size_nodes(at, spread, usable, WIDE, signed=True)
    found = np.exp(log_mass[0]) @ bell(size[0] - offset, width, dof)
    for (low, high), said in zip(WIDE, found, strict=True):
        grid = np.linspace(low, high, 200_001)
        both = bell(grid - offset, width, dof) + bell(-grid - offset, width, dof)
        expected = 0.5 * integrate.trapezoid(both, grid) / (high - low)
        if expected > 1e-2 * found.max():
            assert said == pytest.approx(expected, rel=0.05), (low, high)
