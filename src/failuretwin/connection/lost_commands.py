"""What chance may do to the movements of a healthy robot: late starts, commands that get lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.connection.losses_in_a_row import LossesInARow
from failuretwin.core.movements import Movements
from failuretwin.core.quadrature import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.imperfections import Imperfections
from failuretwin.digital_model.robot import Robot

OUTLIER_RATE = 0.01
"""Share of movements after which the tool may be anywhere in its workspace [-]."""
RARE = 1e-4
"""Losses in a row that are less probable than this, even if all are late, are left out [-]."""
NEGLIGIBLE = 1e-5
"""What is less probable than this given the movements before is left to the outliers [-]."""
LATE_MARGIN_S = 0.15
"""A movement that lasts this much longer than the schedule allows started late [s]."""


@dataclass(frozen=True)
class Alternatives:
    """What may become of each movement: which motors lost how many commands in a row.

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
        had missed that one too, at the target before that, and so on. Padding is filled with
        zeros; no evidence belongs to it.
        """
        origin, target = np.nan_to_num(movements.origin()), np.nan_to_num(movements.target)
        travel, rows = np.sign(target - origin), self._in_a_row
        return Alternatives(
            lost=rows.missed > 0,
            base=_of_last_made(target, origin, rows.missed),
            direction=_of_last_made(travel, _before(travel), rows.missed),
            log_weight=self._log_weight(rows.chances(self._rates(self.late(movements)))),
        )

    def given_before(
        self, alternatives: Alternatives, late: FloatArray, log_likelihood: FloatArray
    ) -> Alternatives:
        """Return alternatives with their probability given what was seen of the movements before.

        A motor that was seen to arrive has missed nothing before; one that was seen to stay has.

        Args:
            alternatives: What may have become of the movements.
            late: Probability that each started late, (run, movement).
            log_likelihood: What was seen of each movement says of each alternative, up to a
                constant, (run, movement, alternative); 0 where nothing was seen.
        """
        chances = self._in_a_row.chances(self._rates(late), log_likelihood)
        chances[chances < NEGLIGIBLE] = 0.0
        return replace(alternatives, log_weight=self._log_weight(chances))

    def _rates(self, late: FloatArray) -> FloatArray:
        """Return the probability of each loss, (run, movement, loss); the first: of none.

        Args:
            late: Probability that each movement started late, (run, movement).
        """
        entries = self.imperfections.lost_commands
        rates = [entry.rate + (entry.rate_when_late - entry.rate) * late for entry in entries]
        total = sum(rates, np.zeros_like(late))
        none = np.maximum(1.0 - total, 0.0)
        shares = np.stack([none, *rates], axis=-1)
        return shares / np.maximum(total, 1.0)[..., None]  # rounding may exceed one

    @cached_property
    def _in_a_row(self) -> LossesInARow:
        names, entries = self.robot.motor_names, self.imperfections.lost_commands
        losses = [np.isin(names, motors) for motors in ((), *(e.motors for e in entries))]
        most = self._rates(np.array([0.0, 1.0])).max(axis=0)
        return LossesInARow.of(np.array(losses), most, RARE)

    @staticmethod
    def _log_weight(chances: FloatArray) -> FloatArray:
        return log_of(chances * (1.0 - OUTLIER_RATE))

    @property
    def late_after_s(self) -> float:
        """Readings that come back later than this after a command say that it started late [s]."""
        timing, readings = self.imperfections.timing, self.imperfections.readings
        between = 1.0 / readings.rate_hz if readings is not None else 0.0
        return 0.5 * timing.late_s[0] + between if timing.late_rate > 0.0 else np.inf

    def late(self, movements: Movements, resumed: FloatArray | None = None) -> FloatArray:
        """Return the probability that each movement started late, (run, movement).

        A late start holds up the next command, so the time between commands betrays it. Of the
        last movement of a run the readings tell: they come back when a late one starts.

        Args:
            movements: The movements.
            resumed: Time from each command to the first reading after it, (run, movement) [s], NaN
                where it is not known; None: nowhere. What is not told so is the rate.
        """
        timing = self.imperfections.timing
        late = np.full(movements.start.shape, timing.late_rate)
        if resumed is not None and timing.late_rate > 0.0:
            late[resumed < 0.5 * timing.late_s[0]] = 0.0
            late[resumed > self.late_after_s] = 1.0
        longest = self.imperfections.schedule.period_s[1] + LATE_MARGIN_S
        known = movements.exists[:, 1:]
        lasted = np.diff(movements.start, axis=1)
        late[:, :-1] = np.where(known, lasted > longest, late[:, :-1])
        return late


def _of_last_made(values: FloatArray, after: FloatArray, missed: IntArray) -> FloatArray:
    """Return what belongs to the last movement that a motor made, (run, movement, state, motor).

    Args:
        values: What belongs to each movement, (run, movement, motor).
        after: What belongs to the movement before each, (run, movement, motor).
        missed: Commands that each motor has missed in a row, (state, motor).
    """
    earlier = [values, after]
    while len(earlier) <= missed.max():
        earlier.append(_before(earlier[-1]))
    chosen = np.stack(earlier)[missed, :, :, np.arange(missed.shape[1])]
    return np.moveaxis(chosen, (0, 1), (2, 3)).copy()


def _before(values: FloatArray) -> FloatArray:
    """Return the values of the movement before, (run, movement, ...); zero before the first."""
    return np.concatenate([np.zeros_like(values[:, :1]), values[:, :-1]], axis=1)
