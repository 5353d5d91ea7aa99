"""Outcomes of movements that count: most of what may have become of a movement has not.

Sums over outcomes weighted by their probability leave out those that are all but impossible.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.theta.linear_response import Whitened

LEAST_WEIGHT = 1e-14
"""Outcomes of a smaller share of their movement are left out: that is below rounding."""


@dataclass(frozen=True)
class CountedOutcomes:
    """The outcomes that count, of all runs in one row.

    Attributes:
        place: Run, movement and outcome of each, sorted, (counted,).
        runs: How many runs there are.
    """

    place: tuple[IntArray, ...]
    runs: int

    @classmethod
    def of(cls, weight: FloatArray) -> CountedOutcomes:
        """Return those that count.

        Args:
            weight: Of each outcome of each movement, (run, movement, outcome).
        """
        return cls(np.nonzero(weight > LEAST_WEIGHT), len(weight))

    @property
    def run(self) -> IntArray:
        """Which run each belongs to, (counted,)."""
        return self.place[0]

    def __call__(self, array: FloatArray) -> FloatArray:
        """Return an array (run, movement, outcome, ...) for those that count, (counted, ...)."""
        return array[self.place]

    def seen(self, dense: Whitened) -> Whitened:
        """Return their residuals and columns; the leading axis is (counted,)."""
        parts = (dense.rho, dense.gamma, dense.log_norm, dense.levers)
        rho, gamma, log_norm, levers = (self(part) for part in parts)
        return replace(dense, rho=rho, gamma=gamma, log_norm=log_norm, levers=levers)

    @cached_property
    def _of_runs(self) -> csr_array:
        """Matrix that sums over the outcomes of each run, (run, counted)."""
        count = len(self.run)
        edges = np.searchsorted(self.run, np.arange(self.runs + 1))
        return csr_array((np.ones(count), np.arange(count), edges), shape=(self.runs, count))

    def total(self, values: FloatArray) -> FloatArray:
        """Return the sum of values (counted, ...) over those of each run, (run, ...)."""
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        return np.asarray(self._of_runs @ flat).reshape(self.runs, *values.shape[1:])
