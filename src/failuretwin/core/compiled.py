"""Loops over single numbers, compiled to machine code at their first call.

The code is kept beside its module, or in the user's cache folder where that cannot be written.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from failuretwin.core.types import FloatArray

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function of numbers and arrays as machine code; x / 0 is infinite or NaN."""
    return cast(Callable[P, T], numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def laid_out(values: NDArray[Any]) -> FloatArray:
    """Return numbers in the layout that compiled functions take; for another they compile anew."""
    return np.require(values, np.float64, ("C", "W"))


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Return a short function for `compiled` ones, which take it in where they call it.

    A call passes every array as a dozen of numbers, which takes longer than a few sums.
    """
    decorate = numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
    return cast(Callable[P, T], decorate(function))
