"""Asking while watching: an arm that stands still is told to move where that settles a suspicion.

A probe is a movement chosen by what the watch believes, then the way back to where the arm was
told to be. It is made only while a fault is suspected and not yet named, after nobody has commanded
the arm for a while, and so often at most; it takes the way that every order of `act` takes.

Section: docs/live.md#probe-movements
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Self

import numpy as np

from failuretwin.connection.links.base import OK, Answer, Commander, CommandSent, Event, Item, Order
from failuretwin.connection.links.stream_time import StreamClock
from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import CLEAR, RAISED
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.safety import SafetyGate, UnsafeOrderError
from failuretwin.decision.acting.work import OrderSequence, RestWatch, Work, would_order
from failuretwin.decision.streaming.alarm_rule import NAMED
from failuretwin.decision.streaming.monitor import Believed, FaultMonitor
from failuretwin.decision.test_motions.design import Designer
from failuretwin.decision.test_motions.outlook import Outlook, of_belief

IDLE_S = 10.0
"""Nobody has commanded an arm for so long that is asked [s]."""
NOTHING_SAFE = "no movement is safe that would settle it"
MOVE = "--move does it"


@dataclass(frozen=True)
class ProbeRules(Bounded):
    """When an arm is asked while it is watched.

    Attributes:
        most: Movements at most for a suspicion, the ways back not counted; 0: never.
        idle_s: Time since the last command of others was carried out [s].
        moves: Whether orders are really sent; else what would be ordered is told.
    """

    most: Annotated[int, Bounds()]
    idle_s: AtLeastZero = IDLE_S
    moves: bool = True


class Prober:
    """Decides when a watched arm is asked, and asks it. It is a sink of the watch.

    The arm is also the source of the watch.
    """

    trouble = ""

    def __init__(
        self,
        monitor: FaultMonitor,
        gate: SafetyGate,
        commander: Commander,
        rules: ProbeRules,
        seed: int = 0,
    ) -> None:
        self._monitor, self._gate, self._commander = monitor, gate, commander
        self._rules, self._seed = rules, seed
        self._clock = StreamClock()
        self._answer: Answer | None = None
        self._rest: RestWatch | None = None
        self._idle_from, self._now, self._still = np.inf, 0.0, False
        self._asking, self._over = False, rules.most == 0
        self._left = rules.most

    # What is heard.

    def put(self, item: Item) -> None:
        """Take what the watch sees and believes."""
        if isinstance(item, Answer):
            self._answer = item
            if item.alarm.state == CLEAR and not self._asking:
                self._left = self._rules.most
            return
        sent = isinstance(item, CommandSent)
        at = self._clock.to_stream_time(item.time, time.monotonic(), not sent)
        self._now = max(self._now, at)
        if self._asking:
            return
        if isinstance(item, CommandSent):
            self._idle_from, self._still = at + float(item.duration.max()), False
            model = self._monitor.believed.model
            self._rest = RestWatch(model, at, float(item.duration.max()), None, 0.0)
        elif self._rest is not None:
            self._still = self._rest.take(replace(item, time=at)) is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to be closed."""

    @property
    def due(self) -> bool:
        """Whether the arm is to be asked now."""
        idle = self._still and self._now - self._idle_from >= self._rules.idle_s
        return idle and not self._over and self._left > 0 and self._open

    @property
    def _open(self) -> bool:
        """Whether a fault is suspected, and which is not settled."""
        answer = self._answer
        if answer is None or answer.state != OK or answer.diagnosis is None:
            return False
        if answer.diagnosis.undecided or answer.alarm.state == CLEAR:
            return False
        return answer.alarm.state != RAISED or not _named(self._monitor.believed)

    # Asking.

    def ask(self, hear: Callable[[Event | None], object], tell: Callable[[str], None]) -> None:
        """Ask the arm while it is open what is wrong, and send it back.

        Whatever keeps it from being asked on is told, and no more is asked by this watch.
        """
        home, answer = self._commander.standing, self._answer
        self._rest, self._still = None, False  # until somebody commands the arm again
        if home is None or answer is None:
            return
        tell(f"{answer.alarm.cause} is suspected and the arm stands still: it is asked")
        orders, left = self._orders(home), self._left
        if not self._rules.moves:
            order = next(orders, None)
            tell(NOTHING_SAFE if order is None else f"{would_order(order)}, then back; {MOVE}")
            return
        sequence = OrderSequence(self._monitor.believed.model, home, orders)
        work = Work(sequence, self._gate, self._commander, home, hear)
        self._asking = True
        try:
            work.carry_out()
        except (InputError, UnsafeOrderError) as wrong:
            self._over = True
            tell(f"{wrong} It is asked no more in this watch")
        finally:
            self._asking = False
            if not np.array_equal(work.standing, home):
                tell("the arm was not sent back to where it was")
        if not self._over:
            asked = left - self._left
            made = f"asked by {counted(asked, 'movement')}, the arm is back where it was"
            tell(made if asked else NOTHING_SAFE)

    def _orders(self, home: FloatArray) -> Iterator[Order]:
        """Yield movements that ask, each with the way back."""
        while (chosen := self._choose(home)) is not None:
            yield from chosen

    def _choose(self, home: FloatArray) -> tuple[Order, Order] | None:
        """Return the movement that tells most and the way back; None: it is settled, or unsafe."""
        if not self._left or not self._open:
            return None
        believed = self._monitor.believed
        outlook = Outlook(believed.model, of_belief(believed))
        designer = Designer(self._gate, outlook, self._seed + self._left, usual=True)
        found = designer.next(home)
        if found is None:
            return None
        back = designer.movement(home, found.order.target, home)
        if back is None:
            return None
        self._left -= 1
        return found.order, back.order


def _named(believed: Believed) -> bool:
    """Return whether one fault has nearly all of the probability.

    An alarm is raised long before that: it costs more to miss a fault than to look.
    """
    faults = believed.probability[[not h.is_healthy for h in believed.hypotheses]]
    return bool(faults.max() >= NAMED)
