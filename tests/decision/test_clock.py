"""What movements say of a clock that is late, where some hold no reading."""

from __future__ import annotations

import numpy as np

from failuretwin.inference.set_ups.clock import Way, _together


def straight(time):
    """Return a movement of 0.1 m along x from 1 s to 2 s, with readings at some times."""
    grid = np.arange(0.0, 6.0, 0.02)
    path = np.outer(np.clip(grid - 1.0, 0.0, 1.0), [0.1, 0.0, 0.0])
    point = np.stack([np.interp(time, grid, axis) for axis in path.T], axis=-1)
    return Way(time, point, 1.0, 2.0, 4.0, grid, path)


def test_a_movement_that_no_reading_falls_into_says_nothing():
    late = np.array([-0.2, 0.0, 0.2])
    seen, unseen = straight(np.arange(0.0, 5.0, 0.05)), straight(np.array([5.0]))
    alone = _together([seen], late, 0.0, 0.001)
    both = _together([seen, unseen], late, 0.0, 0.001)
    assert np.isfinite(both).all()
    assert int(alone[0].argmax()) == 1
    np.testing.assert_allclose(both[0], alone[0])
    np.testing.assert_allclose(both[1], both[1][0])
