"""What chance may do to the movements of a healthy robot: late starts, commands that get lost.

    w_a(m) = p(l(a)) sum over a' that lead to a of w_a'(m-1) exp L_m-1(a') / sum over all a'

with outcomes a of a movement, and the losses l(a) that lead there. The fault mode `lost_commands`,
a motor that loses far more, is weighed in `missed_movements`.

Section: docs/inference.md#outcomes
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Annotated, TypeVar

import numpy as np
from scipy.sparse import csr_array

from failuretwin.core.movements import Movements
from failuretwin.core.numerics import log_of
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.digital_model.nonidealities import Imperfections, with_rates
from failuretwin.digital_model.robot import Robot

Values = TypeVar("Values", FloatArray, BoolArray)

# How many commands in a row each motor has missed: a chain from movement to movement.

MOST_STATES = 48
"""States of a chain beyond which no more are added; what is left out is the rarest."""


@dataclass(frozen=True)
class ConsecutiveLossHmm:
    """A chain: with each movement some motors miss one command more, the others none any longer.

    Attributes:
        missed: Commands that each motor has missed in a row in each state, (state, motor); none in
            the first.
        transition: 1 where a loss (0: of none) leads from a state to a state, (loss, state, state).
    """

    missed: IntArray
    transition: FloatArray

    @staticmethod
    def of(
        losses: BoolArray, chance: FloatArray, rare: float, most: FloatArray | None = None
    ) -> ConsecutiveLossHmm:
        """Return the chain of the states that are not too rare, single losses first.

        What is left out counts as fewer losses in a row.

        Args:
            losses: Motors that each loss hits, (loss, motor); the first hits none.
            chance: Probability of each, (loss,).
            rare: Losses in a row that are less probable, at their highest, are left out.
            most: Highest probability of each, (loss,); None: it is always the same.
        """
        states = _states(losses, chance, chance if most is None else most, rare)
        leads = np.zeros((len(losses), len(states), len(states)))
        for i, loss in enumerate(losses):
            for j, state in enumerate(states):
                leads[i, j, states.index(_known(_one_more(state, loss), states))] = 1.0
        return ConsecutiveLossHmm(np.array(states), leads)

    def forward(self, rates: FloatArray, log_likelihood: FloatArray | None = None) -> FloatArray:
        """Return the probability of each state with each movement, (run, movement, state).

        Args:
            rates: Probability of each loss, (run, movement, loss).
            log_likelihood: What was seen says of each state, (run, movement, state); each movement
                is then given all that was seen before it. None: nothing was seen.
        """
        runs, count, _ = rates.shape
        chances = np.empty((runs, count, len(self.missed)))
        state = np.zeros((runs, len(self.missed)))
        state[:, 0] = 1.0
        for m in range(count):
            pairs = rates[:, m, :, None] * state[:, None]
            chances[:, m] = state = (
                self._follows @ pairs.reshape(runs, self._follows.shape[1]).T
            ).T
            if log_likelihood is not None:
                says = np.where(state > 0.0, log_likelihood[:, m], -np.inf)
                state = state * np.exp(says - says.max(axis=-1, keepdims=True))
                state = state / state.sum(axis=-1, keepdims=True)
        return chances

    @cached_property
    def _follows(self) -> csr_array:
        """1 where a state follows a loss in a state, (state, loss and state)."""
        return csr_array(self.transition.reshape(-1, len(self.missed)).T)


def _states(
    losses: BoolArray, chance: FloatArray, most: FloatArray, rare: float
) -> list[tuple[int, ...]]:
    """Return the states that are not too rare, from few losses in a row to many.

    Where there are more than `MOST_STATES`, those stay that come up most often.
    """
    none = (0,) * losses.shape[1]
    singles = [_one_more(none, loss) for loss in losses]
    newest = dict(zip(singles, zip(chance.tolist(), most.tolist(), strict=True), strict=True))
    found = dict(newest)
    for _ in range(MOST_STATES):
        longer: dict[tuple[int, ...], tuple[float, float]] = {}
        for state, (usual, high) in newest.items():
            for loss, now, at_most in zip(losses, chance.tolist(), most.tolist(), strict=True):
                missed = _one_more(state, loss)
                if missed not in found:
                    known, top = longer.get(missed, (0.0, 0.0))
                    longer[missed] = known + usual * now, top + high * at_most
        ranked = sorted((p, q, missed) for missed, (p, q) in longer.items() if q > rare)[::-1]
        newest = {missed: (p, q) for p, q, missed in ranked[:MOST_STATES]}
        found |= newest
    others = sorted(list(found)[len(losses) :], key=lambda state: -found[state][0])
    kept = {*singles, *others[: max(MOST_STATES - len(losses), 0)]}
    return [state for state in found if state in kept]


def _one_more(missed: tuple[int, ...], loss: BoolArray) -> tuple[int, ...]:
    """Return how many commands in a row the motors have missed after one more loss."""
    return tuple(n + 1 if hit else 0 for n, hit in zip(missed, loss, strict=True))


def _known(missed: tuple[int, ...], states: list[tuple[int, ...]]) -> tuple[int, ...]:
    """Return the state of `states` that comes nearest: with fewer losses in the longest row."""
    while missed not in states:
        longest = max(missed)
        missed = tuple(n - 1 if n == longest else n for n in missed)
    return missed


@lru_cache(maxsize=128)
def _usual_chain(
    losses: tuple[tuple[bool, ...], ...], chance: tuple[float, ...], most: tuple[float, ...]
) -> ConsecutiveLossHmm:
    """Return `ConsecutiveLossHmm.of`; robots that are weighed again and again have the same."""
    return ConsecutiveLossHmm.of(np.array(losses), np.array(chance), RARE, np.array(most))


OUTLIER_RATE = 0.01
"""Share of movements after which the tool may be anywhere in its workspace [-]."""
RARE = 1e-6
"""Losses in a row that are less probable than this, even if all are late, are left out [-]: less
than one movement in twenty days of work. One left out looks like a fault."""
NEGLIGIBLE = 1e-7
"""What is less probable than this given the movements before is left to the outliers [-]."""
STALE_GOAL, CHANCE_GOAL = 1e-3, 1e-5
"""Share of reported goals that are old or spoilt, and of those that by chance are that of a command
which did not arrive [-]; assumed."""
LATE_MARGIN_S = 0.15
"""A movement that lasts this much longer than the schedule allows started late [s]."""


@dataclass(frozen=True)
class CommandOutcomes(ArrayStruct):
    """What may become of each movement: which motors lost how many commands in a row.

    Attributes:
        missed: Commands that each motor has missed in a row, (outcome, motor).
        base: Angles that the motors then go for, (run, movement, outcome, motor) [rad].
        kept: What of them is scatter of the movement before a loss, which a motor that does not
            move keeps, (run, movement, outcome, motor) [rad].
        direction: Sign of their last travel, (run, movement, outcome, motor).
        log_weight: Log probability of each and of no outlier, log w_a (1 - eps),
            (run, movement, outcome).
    """

    missed: IntArray
    base: Annotated[FloatArray, Axes("run", "movement", "outcome", "motor")]
    kept: Annotated[FloatArray, Axes("run", "movement", "outcome", "motor")]
    direction: Annotated[FloatArray, Axes("run", "movement", "outcome", "motor")]
    log_weight: Annotated[FloatArray, Axes("run", "movement", "outcome")]

    @property
    def lost(self) -> BoolArray:
        """Motors that lose their command, (outcome, motor)."""
        return np.asarray(self.missed > 0)


@dataclass(frozen=True)
class Standing(ArrayStruct):
    """How motors stood after each movement, by what was seen until then.

    Attributes:
        lost: Motors that most probably missed its command, (run, movement, motor).
        base: Angle that each of them went for last, (run, movement, motor) [rad].
        off: By how much each settled off what is expected there, (run, movement, motor) [rad].
    """

    lost: Annotated[BoolArray, Axes("run", "movement", "motor", empty=False)]
    base: Annotated[FloatArray, Axes("run", "movement", "motor")]
    off: Annotated[FloatArray, Axes("run", "movement", "motor")]


@dataclass(frozen=True)
class LostCommands:
    """Which commands get lost, and how often.

    Attributes:
        robot: The robot.
        imperfections: Rates of losses and of late starts.
    """

    robot: Robot
    imperfections: Imperfections

    def outcomes(self, movements: Movements, standing: Standing | None = None) -> CommandOutcomes:
        """Return what may become of each movement; the first is that every command arrives.

        A motor that misses a command keeps its angle: the target before, or, if it had missed that
        one too, the target before that, and so on, each with what it had settled off it. Its next
        travel begins there. Padding is filled with zeros; no evidence belongs to it.

        Args:
            movements: The movements.
            standing: How the motors stood after each; None: as commanded, without scatter.
        """
        origin, target = np.nan_to_num(movements.origin()), np.nan_to_num(movements.target)
        stood, off, rows = origin, np.zeros_like(origin), self._in_a_row
        if standing is not None:
            stood = np.where(_before(standing.lost), _before(standing.base), origin)
            off = _before(standing.off)
        travel = np.sign(target - stood)
        kept = _of_last_made(np.zeros_like(off), off, rows.missed)
        return CommandOutcomes(
            missed=rows.missed,
            base=_of_last_made(target, origin, rows.missed) + kept,
            kept=kept,
            direction=_of_last_made(travel, _before(travel), rows.missed),
            log_weight=self._log_weight(rows.forward(self._rates(self.late(movements)))),
        )

    def filtered_outcomes(
        self,
        outcomes: CommandOutcomes,
        late: FloatArray,
        log_likelihood: FloatArray,
        arrived: FloatArray | None = None,
        times: float = 1.0,
    ) -> CommandOutcomes:
        """Return outcomes with their probability given what was seen of the movements before.

        A motor that was seen to arrive has missed nothing before; one that was seen to stay has.

        Args:
            outcomes: What may have become of the movements.
            late: Probability that each started late, (run, movement).
            log_likelihood: What was seen of each movement says of each outcome, up to a
                constant, (run, movement, outcome); 0 where nothing was seen.
            arrived: Whether each motor reports to have received its command, (run, movement,
                motor), NaN where it does not tell; None: nowhere.
            times: How many times as often commands get lost.
        """
        rates = self._rates(late, times)
        if arrived is not None and np.isfinite(arrived).any():
            rates = self._given_goals(rates, arrived)
        chances = self._in_a_row.forward(rates, log_likelihood)
        chances[chances < NEGLIGIBLE] = 0.0
        return replace(outcomes, log_weight=self._log_weight(chances))

    def _rates(self, late: FloatArray, times: float = 1.0) -> FloatArray:
        """Return the probability of each loss, (run, movement, loss); the first: of none.

        Args:
            late: Probability that each movement started late, (run, movement).
            times: As of `filtered_outcomes`.
        """
        entries = (
            with_rates(self.imperfections, times) if times != 1.0 else self.imperfections
        ).lost_commands
        rates = [entry.rate + (entry.rate_when_late - entry.rate) * late for entry in entries]
        total = sum(rates, np.zeros_like(late))
        none = np.maximum(1.0 - total, 0.0)
        shares = np.stack([none, *rates], axis=-1)
        return shares / np.maximum(total, 1.0)[..., None]  # rounding may exceed one

    def _given_goals(self, rates: FloatArray, arrived: FloatArray) -> FloatArray:
        """Return the probability of each loss given what motors report to have received.

        Args:
            rates: What it is without that, (run, movement, loss).
            arrived: (run, movement, motor), NaN where a motor does not tell.
        """
        told = np.isfinite(arrived)[:, :, None]
        came = arrived[:, :, None] > 0.5
        arrives = np.where(self._losses, CHANCE_GOAL, 1.0 - STALE_GOAL)
        says = np.where(told, np.where(came, arrives, 1.0 - arrives), 1.0)
        joint = rates * says.prod(axis=-1)
        return joint / joint.sum(axis=-1, keepdims=True)

    @property
    def lost(self) -> BoolArray:
        """Motors that lose their command in each outcome, (outcome, motor)."""
        return np.asarray(self._in_a_row.missed > 0)

    @cached_property
    def _losses(self) -> BoolArray:
        """Motors that each loss hits, (loss, motor); the first hits none."""
        names, entries = self.robot.motor_names, self.imperfections.lost_commands
        return np.array([np.isin(names, m) for m in ((), *(e.motors for e in entries))])

    @cached_property
    def _in_a_row(self) -> ConsecutiveLossHmm:
        late_rate = self.imperfections.timing.late_rate
        usual = self._rates(np.array(late_rate))
        most = self._rates(np.array([0.0, float(late_rate > 0.0)])).max(axis=0)
        hits = tuple(map(tuple, self._losses.tolist()))
        return _usual_chain(hits, tuple(usual.tolist()), tuple(most.tolist()))

    @staticmethod
    def _log_weight(chances: FloatArray) -> FloatArray:
        return log_of(chances * (1.0 - OUTLIER_RATE))

    @property
    def late_after_s(self) -> float:
        """Readings that come back later than this after a command say that it started late [s]."""
        timing, readings = self.imperfections.timing, self.imperfections.readings
        between = 1.0 / readings.rate_hz if readings is not None else 0.0
        return 0.5 * timing.late_s[0] + between if timing.late_rate > 0.0 else np.inf

    def late(
        self, movements: Movements, first_reading_delay: FloatArray | None = None
    ) -> FloatArray:
        """Return the probability that each movement started late, (run, movement).

        A late start holds up the next command, so the time between commands betrays it. Of the
        last movement of a run the readings tell: they come back when a late one starts.

        Args:
            movements: The movements.
            first_reading_delay: Time from each command to the first reading after it, (run,
                movement) [s], NaN where it is not known; None: nowhere. What is not told so is the
                rate.
        """
        timing = self.imperfections.timing
        late = np.full(movements.start.shape, timing.late_rate)
        if first_reading_delay is not None and timing.late_rate > 0.0:
            late[first_reading_delay < 0.5 * timing.late_s[0]] = 0.0
            late[first_reading_delay > self.late_after_s] = 1.0
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


def _before(values: Values) -> Values:
    """Return the values of the movement before, (run, movement, ...); zero before the first."""
    return np.concatenate([np.zeros_like(values[:, :1]), values[:, :-1]], axis=1)
