"""How far motors scatter and how often they miss commands, as runs teach it.

By expectation and maximisation with pseudo-counts, beside the theta that runs share.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.nonidealities import Imperfections

SCATTER_SPREAD = 0.3
"""Deviation of the logarithm of the scatter within a class; assumed."""
TAIL_SPREAD = 0.6
"""The same of its degrees of freedom; assumed, a factor of two, as loss rates."""
HEAVIEST, LIGHTEST = 1.0, 50.0
"""Degrees of freedom that scatter may have; from 50 on it counts as normal."""
RATE_COUNT = 30.0
"""Movements that the prior of a loss rate counts for."""


@dataclass(frozen=True)
class Habits:
    """What movements say of scatter and lost commands, sums over them.

    Attributes:
        precision: Information about the logarithms of each motor's scatter and of its degrees of
            freedom, beside those of the model that was given, (..., motor + 1, motor + 1).
        shift: That times the logarithms that are most probable, (..., motor + 1).
        losses: How often each set of motors has lost a command, of how many movements; punctual
            and late ones, (..., entry, 2, 2).
    """

    precision: FloatArray
    shift: FloatArray
    losses: FloatArray

    @classmethod
    def believed(
        cls,
        given: Imperfections,
        scatter_spread: float = SCATTER_SPREAD,
        tail_spread: float = TAIL_SPREAD,
    ) -> Habits:
        """Return what is believed of a robot before any run.

        Args:
            given: Its scatter, tails and rates, the most probable ones.
            scatter_spread: Deviation of the logarithm of each scatter.
            tail_spread: The same of the degrees of freedom.
        """
        motors = 0 if given.settling is None else len(given.settling.scatter)
        rate = np.array([[e.rate, e.rate_when_late] for e in given.lost_commands]).reshape(-1, 2)
        losses = RATE_COUNT * np.stack([rate, np.ones_like(rate)], axis=-1)
        spread = np.array([*[scatter_spread] * motors, tail_spread])
        return cls(np.diag(spread**-2.0), np.zeros(motors + 1), losses)

    @classmethod
    def none(cls, runs: int, given: Imperfections) -> Habits:
        """Return what runs say that have said nothing yet."""
        like = cls.believed(given)
        parts = (like.precision, like.shift, like.losses)
        return cls(*(np.zeros((runs, *part.shape)) for part in parts))

    def __getitem__(self, rows: slice | IntArray) -> Habits:
        """Return what some of the runs say."""
        return Habits(self.precision[rows], self.shift[rows], self.losses[rows])

    def put(self, rows: slice | IntArray, told: Habits) -> None:
        """Write down what some of the runs say."""
        self.precision[rows], self.shift[rows] = told.precision, told.shift
        self.losses[rows] = told.losses

    def toward(self, told: Habits, share: float) -> Habits:
        """Return these, changed by a share of what they differ by from others."""
        pairs = zip(astuple(self), astuple(told), strict=True)
        return Habits(*(old + share * (new - old) for old, new in pairs))

    def plus(self, told: Habits) -> Habits:
        """Return these and those of some runs together."""
        return Habits(
            self.precision + told.precision.sum(axis=0),
            self.shift + told.shift.sum(axis=0),
            self.losses + told.losses.sum(axis=0),
        )

    def fading(self, share: float, given: Imperfections) -> Habits:
        """Return what is left where a share of what runs have said is remembered."""
        first = Habits.believed(given)
        return Habits(
            first.precision + share * (self.precision - first.precision),
            first.shift + share * (self.shift - first.shift),
            first.losses + share * (self.losses - first.losses),
        )

    @property
    def log_scatter(self) -> FloatArray:
        """Most probable logarithms of scatter and tail beside those given, (motor + 1,)."""
        return np.asarray(np.linalg.solve(self.precision, self.shift))

    def most_probable(self, given: Imperfections) -> Imperfections:
        """Return the imperfections with the scatter and the rates that are most probable."""
        if given.settling is None:
            return given
        factor = np.exp(self.log_scatter)
        scatter = np.asarray(given.settling.scatter) * factor[:-1]
        dof = given.settling.tail_dof
        if np.isfinite(dof):
            dof = float(np.clip(dof * factor[-1], HEAVIEST, LIGHTEST))
        rates = self.losses[..., 0] / self.losses[..., 1]
        lost = tuple(
            replace(entry, rate=float(rate), rate_when_late=float(when_late))
            for entry, (rate, when_late) in zip(given.lost_commands, rates, strict=True)
        )
        settling = replace(given.settling, scatter=tuple(scatter.tolist()), tail_dof=dof)
        return replace(given, settling=settling, lost_commands=lost)
