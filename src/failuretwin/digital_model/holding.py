"""Motors held by their gear."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray


def hold(
    position: FloatArray, held: BoolArray, time: FloatArray, speed_limit: FloatArray
) -> FloatArray:
    """Return the angles with motors frozen while they are held."""
    out = position.copy()
    for run, motor in np.argwhere(held.any(axis=1)):
        first = int(np.argmax(held[run, :, motor]))
        out[run, first:, motor] = position[run, first, motor]
    return out
