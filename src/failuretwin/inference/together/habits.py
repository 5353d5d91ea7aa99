"""How far motors scatter, how noisy the sensor is and how often commands get lost, by the runs.

By expectation and maximisation with pseudo-counts, beside the theta that runs share.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.observation.healthy_model import HealthyModel

SCATTER_SPREAD = 0.3
"""Deviation of the logarithm of the scatter within a class; assumed."""
TAIL_SPREAD = 0.6
"""The same of its degrees of freedom; assumed, a factor of two, as loss rates."""
NOISE_SPREAD, KNOWN_NOISE_SPREAD = 1.2, 0.01
"""The same of the noise of a sensor that nobody has measured, as `engine.theta.OF_CLASS` has it,
and of one that somebody has."""
HEAVIEST, LIGHTEST = 1.0, 50.0
"""Degrees of freedom that scatter may have; from 50 on it counts as normal."""
UNSETTLED = 0.5
"""Step of the logarithm of the noise or of a scatter above which nothing is said of tails yet: what
a scale that is far too large leaves looks like heavy ones."""
RATE_COUNT = 30.0
"""Movements that the prior of a loss rate counts for."""


@dataclass(frozen=True)
class Habits:
    """What movements say of scatter, noise and lost commands, sums over them.

    Attributes:
        precision: Information about the logarithms of each motor's scatter, of its degrees of
            freedom and of the sensor's noise, beside those of the model that was given,
            (..., motor + 2, motor + 2).
        shift: That times the logarithms that are most probable, (..., motor + 2).
        losses: How often each set of motors has lost a command, of how many movements; punctual
            and late ones, (..., entry, 2, 2).
    """

    precision: FloatArray
    shift: FloatArray
    losses: FloatArray

    @classmethod
    def believed(
        cls,
        given: HealthyModel,
        scatter_spread: float = SCATTER_SPREAD,
        tail_spread: float = TAIL_SPREAD,
    ) -> Habits:
        """Return what is believed of a robot before any run.

        Args:
            given: Its scatter, tails, noise and rates, the most probable ones.
            scatter_spread: Deviation of the logarithm of each scatter.
            tail_spread: The same of the degrees of freedom.
        """
        motors, entries = len(given.scatter), given.imperfections.lost_commands
        rate = np.array([[e.rate, e.rate_when_late] for e in entries]).reshape(-1, 2)
        losses = RATE_COUNT * np.stack([rate, np.ones_like(rate)], axis=-1)
        noise = KNOWN_NOISE_SPREAD if given.knows_noise else NOISE_SPREAD
        spread = np.array([*[scatter_spread] * motors, tail_spread, noise])
        return cls(np.diag(spread**-2.0), np.zeros(len(spread)), losses)

    @classmethod
    def none(cls, runs: int, given: HealthyModel) -> Habits:
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

    def forget_tails(self, rows: IntArray) -> None:
        """Leave out what some of the runs say of the degrees of freedom."""
        tail = self.shift.shape[-1] - 2
        self.precision[rows, tail], self.precision[rows, :, tail] = 0.0, 0.0
        self.shift[rows, tail] = 0.0

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

    def fading(self, share: float, given: HealthyModel) -> Habits:
        """Return what is left where a share of what runs have said is remembered."""
        first = Habits.believed(given)
        return Habits(
            first.precision + share * (self.precision - first.precision),
            first.shift + share * (self.shift - first.shift),
            first.losses + share * (self.losses - first.losses),
        )

    @property
    def log_factors(self) -> FloatArray:
        """Most probable logarithms of scatter, tail and noise beside those given, (motor + 2,)."""
        return np.asarray(np.linalg.solve(self.precision, self.shift))

    def settled(self, now: HealthyModel, given: HealthyModel) -> bool:
        """Return whether scatter and noise of a robot are nearly the most probable ones.

        Args:
            now: The robot.
            given: As it was given.
        """
        step = log_factors_of(self.most_probable(given), given) - log_factors_of(now, given)
        return bool(np.abs(np.delete(step, -2)).max() < UNSETTLED)

    def most_probable(self, given: HealthyModel) -> HealthyModel:
        """Return the robot with the scatter, the noise and the rates that are most probable."""
        known = given.imperfections
        if known.settling is None:
            return given
        *motors, tail, noise = np.exp(self.log_factors).tolist()
        scatter, dof = np.multiply(known.settling.scatter, motors), known.settling.tail_dof
        if np.isfinite(dof):
            dof = float(np.clip(dof * tail, HEAVIEST, LIGHTEST))
        rates = self.losses[..., 0] / self.losses[..., 1]
        lost = tuple(
            replace(entry, rate=float(rate), rate_when_late=float(when_late))
            for entry, (rate, when_late) in zip(known.lost_commands, rates, strict=True)
        )
        settling = replace(known.settling, scatter=tuple(scatter.tolist()), tail_dof=dof)
        learned = replace(known, settling=settling, lost_commands=lost)
        return replace(given.with_noise(noise), imperfections=learned)


def log_factors_of(now: HealthyModel, given: HealthyModel) -> FloatArray:
    """Return logarithms of scatter, tail and noise beside those given, (motor + 2,)."""
    before, after = given.settling, now.settling
    tail = after.tail_dof / before.tail_dof if np.isfinite(before.tail_dof) else 1.0
    noise = now.noise_factor / given.noise_factor
    return np.log([*np.divide(after.scatter, before.scatter), tail, noise])
