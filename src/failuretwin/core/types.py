"""Array types and helpers shared by every room of the house."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def frozen_array(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of `values`, fit for a frozen dataclass."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def as_floats(values: Any) -> FloatArray:
    """Return `values` as a float64 array, without a copy where it already is one."""
    return np.asarray(values, dtype=np.float64)
