"""Medians of some of the values, many at once."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray


def masked_median(values: FloatArray, kept: BoolArray) -> FloatArray:
    """Return the median of the values that are kept in each row.

    Args:
        values: (row, value).
        kept: Which of them count, same axes.

    Returns:
        (row,); 0 where none is kept.
    """
    if values.shape[1] == 0:
        return np.zeros(len(values))
    ordered = np.sort(np.where(kept, values, np.inf), axis=1)
    count = kept.sum(axis=1)
    row = np.arange(len(values))
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[1] - 1)
    middle = 0.5 * (ordered[row, low] + ordered[row, high])
    return np.where(count > 0, middle, 0.0)
