"""A task carried out on an arm: orders out, readings in, a gate and a dead man between.

And how an arm is brought to rest: it is told to stay where it is until it is seen to stand.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from failuretwin.connection.links.base import Commander, CommandSent, Event, Order, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import BelievedArm, Seen
from failuretwin.decision.acting.planner import Standing
from failuretwin.decision.acting.safety import SafetyGate, UnsafeOrderError
from failuretwin.inference.observation.evidence import SETTLING_S
from failuretwin.inference.observation.healthy_model import HealthyModel

FIRST_WAIT_S = 10.0
"""Longest wait for the first reading, by our clock [s]."""
HOLD_S = 0.1
"""Duration of an order to stay [s]."""
AGAIN_S = 0.5
"""Time after which a moving arm is told again [s]."""
STILL_S, STILL_RAD = 0.5, 0.01
"""An arm stands that has not moved further than that for so long [s, rad]."""
LONGEST_S = 5.0
"""Longest wait for an arm to stand [s]."""
POLL_S = 0.1
PATIENCE_S = 12.0
"""A tool that has not come to rest so long after a ramp is not seen at rest, by its clock [s]."""
SILENCE_S = 15.0
"""An arm that says nothing for so long, by our clock, is given up [s]."""
OURS_RAD = 1e-3
"""A command that differs by more from ours is somebody else's [rad]."""
QUIET_S = 0.5
"""Time without motion that counts as rest [s]."""
LEAST_READINGS = 3
"""Readings that rest needs at least."""
LATE_S = 0.3
"""Extra time for a late start, beyond what arms of this kind need [s]."""
MOVED_FACTOR = 2.0
"""Expected travel from which a late start is waited for, in spreads that tell motion from rest."""


class Halted(InputError):  # noqa: N818 - it is no error of the user
    """Work was stopped before the task was over; nothing more is sent."""


def would_order(order: Order) -> str:
    """Return an order that is not sent, in words."""
    angles = " ".join(f"{angle:.1f}" for angle in np.rad2deg(order.target))
    return f"would order {angles} deg in {order.duration.max():.2f} s"


class Worker(Protocol):
    """Source of orders that depend on what was seen: an `Actor` or an `OrderSequence`."""

    model: HealthyModel
    """The healthy arm."""

    def standing(self) -> Standing:
        """Return the believed position of the arm."""
        ...

    def next(self) -> Order | None:
        """Return the next order; None: there is none."""
        ...

    def see(self, point: FloatArray | None, start_s: float, rest_s: float) -> None:
        """Take where the tool came to rest after the last order, (3,) [m]; None: not seen."""
        ...


@dataclass
class OrderSequence:
    """Orders from an iterator for an arm that is taken for healthy.

    Attributes:
        model: The healthy arm.
        command: Last command, (motor,) [rad].
        orders: The orders; advanced after the movement before was seen.
        seen: Movements so far.
    """

    model: HealthyModel
    command: FloatArray
    orders: Iterator[Order]
    seen: list[Seen] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._previous = self.command
        self._order: Order | None = None

    def standing(self) -> Standing:
        """Return the position of the arm if it is healthy."""
        pose = BelievedArm(self.model).settle(self.command, self._previous, 0.0)
        return Standing(pose, self.command, 0.0)

    def next(self) -> Order | None:
        """Return the next order; None: there is none."""
        self._order = next(self.orders, None)
        if self._order is not None:
            self._previous, self.command = self.command, self._order.target
        return self._order

    def see(self, point: FloatArray | None, start_s: float, rest_s: float) -> None:
        """Add where the tool came to rest after the last order, (3,) [m]; None: not seen."""
        assert self._order is not None
        told = (self.command, self._previous, self._order.duration)
        self.seen.append(Seen(*told, start_s, rest_s, point))


@dataclass
class RestWatch:
    """Waits for the tool to come to rest after one order.

    Attributes:
        model: The arm: what tells rest from motion, how late it may start.
        sent_s: When the order was sent [s].
        ramp_s: Its longest ramp [s].
        before: Where the tool rested before, (3,) [m]; None: not known.
        travel_m: How far the tool is expected to go [m].
    """

    model: HealthyModel
    sent_s: float
    ramp_s: float
    before: FloatArray | None
    travel_m: float

    def __post_init__(self) -> None:
        self._recent: deque[Reading] = deque()

    def take(self, reading: Reading) -> FloatArray | None:
        """Take a reading; return where the tool is at rest, (3,) [m]; None: not yet."""
        if not np.isfinite(reading.tool).all():
            return None
        self._recent.append(reading)
        while reading.time - self._recent[0].time > QUIET_S + 1e-6:
            self._recent.popleft()
        since = reading.time - self.sent_s
        if since < self.ramp_s + SETTLING_S + self.model.lag_s or not self._long_enough():
            return None
        points = np.array([each.tool for each in self._recent])
        middle = np.median(points, axis=0)
        away = np.linalg.norm(points - middle, axis=1)
        if np.max(away) > self.model.settings.moving_spread_m + 4.0 * self.model.path_noise:
            return None
        if self._may_not_have_begun(middle, since):
            return None
        return np.asarray(middle)

    def _long_enough(self) -> bool:
        span = self._recent[-1].time - self._recent[0].time
        return len(self._recent) >= LEAST_READINGS and span >= 0.8 * QUIET_S

    def _may_not_have_begun(self, point: FloatArray, since: float) -> bool:
        """Return whether a tool that is where it was may yet start, late."""
        if self.before is None:
            return False
        near = self.model.settings.moving_spread_m * MOVED_FACTOR
        if np.linalg.norm(point - self.before) > near or self.travel_m < near:
            return False
        latest = self.ramp_s + SETTLING_S + self.model.imperfections.timing.late_s[1] + LATE_S
        return since < latest + QUIET_S


@dataclass
class Work:
    """One task on one arm.

    Attributes:
        actor: Says what to do next.
        gate: Looks at each order again before it is sent.
        commander: The arm.
        standing: What its motors were told last, (motor,) [rad].
        hear: Called with each event before it counts; None: nothing came just now.
        seen: Called after each movement that was seen.
    """

    actor: Worker
    gate: SafetyGate
    commander: Commander
    standing: FloatArray
    hear: Callable[[Event | None], object] = lambda event: None
    seen: Callable[[], object] = lambda: None

    def __post_init__(self) -> None:
        self._now = 0.0
        self._heard = time.monotonic()
        self._point: FloatArray | None = None
        self._sent: list[tuple[FloatArray, FloatArray]] = []

    def carry_out(self) -> None:
        """Carry the task out."""
        while (order := self.actor.next()) is not None:
            self._send(order)
            start = self._now
            point = self._rest(order, start)
            self.actor.see(point, start, self._now)
            self.seen()

    # Sending.

    def _send(self, order: Order) -> None:
        """Send an order once the arm has been heard lately and the gate lets it through."""
        wrong = self.gate.wrong(order, [(self.standing, order.target)])
        if wrong:
            raise UnsafeOrderError(f"{wrong}; nothing was sent.")
        self._await_reading()
        self._sent.append((self.standing, order.target))
        self.commander.send(order)
        self.standing = order.target

    def _await_reading(self) -> None:
        """Wait until the tool has just been read: the dead man."""
        silent_since = self._now
        while True:
            event = self._next_event()
            if isinstance(event, Reading) and np.isfinite(event.tool).all():
                return
            if self._now - silent_since > PATIENCE_S:
                raise Halted(f"the tool is not read for {PATIENCE_S:g} s; nothing more is sent.")

    # Listening.

    def _rest(self, order: Order, start: float) -> FloatArray | None:
        """Return where the tool comes to rest after an order, (3,) [m]; None: it is not seen to."""
        actor, ramp = self.actor, float(order.duration.max())
        expected = actor.model.twin.path(actor.standing().pose)
        travel = 0.0 if self._point is None else float(np.linalg.norm(expected - self._point))
        watch = RestWatch(actor.model, start, ramp, self._point, travel)
        while self._now - start < ramp + PATIENCE_S:
            event = self._next_event()
            if not isinstance(event, Reading):
                continue
            point = watch.take(event)
            if point is not None:
                self._point = point
                return point
        return None

    def _next_event(self) -> Event | None:
        """Return what the arm says next; None: nothing just now."""
        event = self.commander.poll(POLL_S)
        self.hear(event)
        if event is None:
            if self.commander.ended:
                raise Halted("the arm has ended; nothing more is sent.")
            if time.monotonic() - self._heard > SILENCE_S:
                raise Halted(f"the arm says nothing for {SILENCE_S:g} s; nothing more is sent.")
            return None
        self._heard = time.monotonic()
        self._now = max(self._now, event.time)
        if isinstance(event, CommandSent) and not self._is_ours(event):
            raise Halted("somebody else commands the arm; nothing more is sent.")
        return event

    def _is_ours(self, command: CommandSent) -> bool:
        """Return whether a command is one of the latest orders, or lies on the way of one."""
        for start, end in self._sent[-3:]:
            low, high = np.minimum(start, end) - OURS_RAD, np.maximum(start, end) + OURS_RAD
            if np.all((command.target >= low) & (command.target <= high)):
                return True
        return False


def first_standing(commander: Commander) -> FloatArray:
    """Return what the motors of an arm were told last, (motor,) [rad].

    Where no command has been heard, where they are read to stand.
    """
    until = time.monotonic() + FIRST_WAIT_S
    while time.monotonic() < until:
        event = commander.poll(POLL_S)
        found = angles_of(event) if commander.standing is None else commander.standing
        if found is not None:
            return found
    raise InputError(
        f"{commander.name}: neither a command nor the angles of the motors are heard within "
        f"{FIRST_WAIT_S:g} s, so it is not known where the arm stands. Move it once by hand or by "
        "its own programs, or let it publish its joint states."
    )


# Bringing an arm to rest. A network may lose an order, and a moving arm is further on than it was
# last read: while the motors move, they are told again, where they were read last. This is no
# emergency stop.

STANDS = "the arm stands"
MOVES = "the arm still moves: use its emergency stop"
SILENT = "its motors are not read any more, so it is not known whether it stands"
NOT_READ = (
    "its motors are not read, so it cannot be told where to stay: the movement under way ends by "
    "itself; use the emergency stop to end it now"
)


def angles_of(event: Event | None) -> FloatArray | None:
    """Return the angles that a reading tells of all motors, (motor,) [rad]; None: it does not."""
    if not isinstance(event, Reading) or event.position is None:
        return None
    return event.position if np.isfinite(event.position).all() else None


def bring_to_rest(arm: Commander, place: FloatArray | None = None) -> str:
    """Tell an arm to stay where it is until it stands; return what came of it, in words.

    Args:
        arm: The arm.
        place: Where its motors were read last, (motor,) [rad]; None: they are read first.

    Raises:
        InputError: If the motors are not read; nothing is sent then.
    """
    until = time.monotonic() + FIRST_WAIT_S
    while place is None:
        if time.monotonic() > until:
            raise InputError(f"{arm.name}: {NOT_READ}. Nothing was sent.")
        place = angles_of(arm.poll(POLL_S))
    _hold(arm, place)
    return _watched(arm)


def _hold(arm: Commander, place: FloatArray) -> None:
    arm.send(Order(place, np.full(len(place), HOLD_S)))


def _watched(arm: Commander) -> str:
    """Return how an arm comes to rest that was just told to stay; one that moves is told again."""
    told = moved = time.monotonic()
    until, place = told + LONGEST_S, None
    while (now := time.monotonic()) < until:
        angles = angles_of(arm.poll(POLL_S))
        if angles is None:
            continue
        if place is None or np.abs(angles - place).max() > STILL_RAD:
            place, moved = angles, now
        elif now - moved >= STILL_S:
            return STANDS
        if moved - told >= AGAIN_S:
            _hold(arm, angles)
            told = now
    return SILENT if place is None else MOVES
