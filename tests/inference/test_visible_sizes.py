"""Sizes of errors that a moment on the way shows too little of."""

import numpy as np
import pytest

from failuretwin.inference.faults.fault_sizes import SizePrior
from failuretwin.inference.faults.priors import LEAST_ERROR, WITHIN_A_DAY, shares_above

RANGES = ((0.001, 0.005), (0.0025, 0.0125), (0.00625, 0.03125), (0.015, 0.075))


def test_what_the_way_hides_is_nearly_ruled_out():
    sizes = SizePrior(RANGES, (0.25,) * 4, visible=True)
    still, moving = shares_above(sizes, np.array([0.0, 0.004 / LEAST_ERROR]))
    np.testing.assert_array_equal(still, 0.25)
    hidden = [WITHIN_A_DAY / 2] * 2
    np.testing.assert_allclose(moving, [*hidden, *[(1.0 - WITHIN_A_DAY) / 2] * 2])


@pytest.mark.parametrize("visible", [False, True])
def test_what_somebody_said_stands(visible):
    """And so do sizes of which all are hidden."""
    sizes = SizePrior(RANGES, (0.1, 0.2, 0.3, 0.4), visible)
    off = np.array([1.0 if visible else 0.02])
    np.testing.assert_allclose(shares_above(sizes, off), [[0.1, 0.2, 0.3, 0.4]])
