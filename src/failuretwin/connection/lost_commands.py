"""What chance may do to the movements of a healthy robot: late starts, commands that get lost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.quadrature import log_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import Imperfections
from failuretwin.digital_model.robot import Robot

OUTLIER_RATE = 0.01
"""Share of movements after which the tool may be anywhere in its workspace [-]."""
RARE = 1e-3
"""Two losses in a row that are less probable than this are left to the outliers [-]."""
LATE_MARGIN_S = 0.15
"""A movement that lasts this much longer than the schedule allows started late [s]."""


@dataclass(frozen=True)
class Alternatives:
    """What may become of each movement: every set of motors that may lose its command.

    Attributes:
        lost: Motors that lose their command, (alternative, motor).
        base: Angles that the motors then go for, (run, movement, alternative, motor) [rad].
        direction: Sign of their last travel, (run, movement, alternative, motor).
        log_weight: Log probability of each, (run, movement, alternative).
    """

    lost: BoolArray
    base: FloatArray
    direction: FloatArray
    log_weight: FloatArray

    def __getitem__(self, runs: slice) -> Alternatives:
        """Return the alternatives of some of the runs."""
        return Alternatives(self.lost, self.base[runs], self.direction[runs], self.log_weight[runs])


@dataclass(frozen=True)
class LostCommands:
    """Which commands get lost, and how often.

    Attributes:
        robot: The robot.
        imperfections: Rates of losses and of late starts.
    """

    robot: Robot
    imperfections: Imperfections

    def alternatives(self, movements: Movements) -> Alternatives:
        """Return what may become of each movement; the first is that every command arrives.

        A motor that misses a command stays where it went last: at the target before, or, if it
        had missed that one too, at the target before that. Padding is filled with zeros; no
        evidence belongs to it.
        """
        origin, target = np.nan_to_num(movements.origin()), np.nan_to_num(movements.target)
        travel = np.sign(target - origin)
        lost, rates = self._losses(self.late(movements))
        again = self._in_a_row
        before = _before(rates)
        # Chance that of the motors that miss a command now, these had missed the one before too.
        chances = [before @ _meets(lost, lost[now], had) for now, had in again]
        twice = [rates[..., now] * chance for (now, _), chance in zip(again, chances, strict=True)]
        single = rates.copy()
        for (now, _), weight in zip(again, twice, strict=True):
            single[..., now] -= weight
        missing = np.array([*lost, *(lost[now] for now, _ in again)])
        had = np.array([*np.zeros_like(lost), *(had for _, had in again)])
        weights = np.stack([*np.moveaxis(single, -1, 0), *twice], axis=-1)
        return Alternatives(
            lost=missing,
            base=_choose(target, (missing, origin), (had, _before(origin))),
            direction=_choose(travel, (missing, _before(travel)), (had, _before(_before(travel)))),
            log_weight=log_of(weights * (1.0 - OUTLIER_RATE)),
        )

    def _losses(self, late: FloatArray) -> tuple[BoolArray, FloatArray]:
        """Return which motors each alternative loses, and how probable it is.

        (alternative, motor), and (run, movement, alternative). The first loses none.
        """
        entries = self.imperfections.lost_commands
        lost = np.zeros((1 + len(entries), len(self.robot.motors)), dtype=bool)
        rates = np.zeros((*late.shape, 1 + len(entries)))
        for i, entry in enumerate(entries, start=1):
            lost[i, [self.robot.motor_names.index(motor) for motor in entry.motors]] = True
            rates[..., i] = entry.rate + (entry.rate_when_late - entry.rate) * late
        rates[..., 0] = np.maximum(1.0 - rates.sum(axis=-1), 0.0)  # rounding may exceed one
        return lost, rates

    @cached_property
    def _in_a_row(self) -> list[tuple[int, BoolArray]]:
        """Losses that may well follow on another: which one, and who had missed two, (motor,)."""
        lost, rates = self._losses(np.array([[0.0, 1.0]]))
        most = rates[0].max(axis=0)
        found = []
        for now in range(1, len(lost)):
            for had in np.unique(lost[1:] & lost[now], axis=0):
                if had.any() and most[now] * (most @ _meets(lost, lost[now], had)) > RARE:
                    found.append((now, had))
        return found

    def late(self, movements: Movements) -> FloatArray:
        """Return the probability that each movement started late, (run, movement).

        A late start holds up the next command, so the time between commands betrays it; for the
        last movement of a run only the rate is known.
        """
        late = np.full(movements.start.shape, self.imperfections.timing.late_rate)
        longest = self.imperfections.schedule.period_s[1] + LATE_MARGIN_S
        known = movements.exists[:, 1:]
        lasted = np.diff(movements.start, axis=1)
        late[:, :-1] = np.where(known, lasted > longest, late[:, :-1])
        return late


def _meets(lost: BoolArray, now: BoolArray, had: BoolArray) -> FloatArray:
    """Return 1 for the losses that hit exactly `had` of the motors `now`, (alternative,)."""
    return np.asarray((lost & now == had).all(axis=1), dtype=np.float64)


def _choose(arrived: FloatArray, *missed: tuple[BoolArray, FloatArray]) -> FloatArray:
    """Return the values of each alternative, (run, movement, alternative, motor).

    Args:
        arrived: Value of a motor that got its command, (run, movement, motor).
        missed: Motors that did not, (alternative, motor), and their value, (run, movement, motor);
            the last that names a motor counts.
    """
    chosen = arrived[:, :, None]
    for mask, value in missed:
        chosen = np.where(mask, value[:, :, None], chosen)
    return np.asarray(chosen)


def _before(values: FloatArray) -> FloatArray:
    """Return the values of the movement before, (run, movement, ...); zero before the first."""
    return np.concatenate([np.zeros_like(values[:, :1]), values[:, :-1]], axis=1)
