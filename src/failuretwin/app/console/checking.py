"""A check that runs while the console is open, and what stops it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event, Thread

from failuretwin.app.console import texts
from failuretwin.connection.links import base
from failuretwin.connection.links.base import Commander, Order
from failuretwin.core.errors import FailureTwinError
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.work import NOT_READ, Halted, angles_of, bring_to_rest
from failuretwin.decision.test_motions.health_check import Checking, CheckResult

HANGS_S = 5.0
"""A server or page that does not beat for so long hangs, and the arm is stopped [s]."""


@dataclass
class Stoppable(Commander):
    """An arm whose orders end when somebody stops it.

    Attributes:
        arm: The arm.
        why: Returns why it must stop; empty: it may go on.
        position: Angles that were read last, (motor,) [rad]; None: none were.
        moved: Whether an order was sent.
    """

    arm: Commander
    why: Callable[[], str]
    position: FloatArray | None = None
    moved: bool = False

    @property
    def name(self) -> str:
        """Name of the arm."""
        return self.arm.name

    @property
    def ended(self) -> bool:
        """Whether the arm has ended."""
        return self.arm.ended

    @property
    def counts(self) -> base.LinkCounts:
        """Counters of the link."""
        return self.arm.counts

    @property
    def standing(self) -> FloatArray | None:
        """Last target of the motors, (motor,) [rad]; None: not known."""
        return self.arm.standing

    def send(self, order: Order) -> None:
        """Send an order, unless the arm must stop.

        Raises:
            Halted: If it must, as `poll` does.
        """
        self._stop_if_told()
        self.moved = True
        self.arm.send(order)

    def poll(self, timeout_s: float) -> base.Event | None:
        """Return what the arm says next.

        Raises:
            Halted: If the arm must stop; it is first told to stay where it is, until it stands.
        """
        self._stop_if_told()
        event = self.arm.poll(timeout_s)
        angles = angles_of(event)
        self.position = self.position if angles is None else angles
        return event

    def _stop_if_told(self) -> None:
        why = self.why()
        if not why:
            return
        if self.position is None and not self.moved:
            raise Halted(f"{why}; nothing was sent.")
        came = NOT_READ if self.position is None else bring_to_rest(self.arm, self.position)
        raise Halted(f"{why}; {came}. Nothing more is sent.")


@dataclass
class CheckRun:
    """A check in a thread of its own.

    Attributes:
        robot: Name of the robot.
        checking: The settings.
        open_arm: Opens the arm on a stack.
        hangs: Returns why the console cannot stop it any more; empty: it can.
        lines: What happened.
        result: What was found; None: not yet.
    """

    robot: str
    checking: Checking
    open_arm: Callable[[ExitStack], Commander]
    hangs: Callable[[], str]
    finished: Callable[[CheckResult], None]
    lines: list[str] = field(default_factory=list)
    result: CheckResult | None = None
    _told: str = ""
    _over: Event = field(default_factory=Event)

    @property
    def running(self) -> bool:
        """Whether it goes on."""
        return not self._over.is_set()

    def start(self, seconds: float) -> None:
        """Design the movements, and make them."""
        Thread(target=self._run, args=(seconds,), name="check", daemon=True).start()

    def stop(self, why: str) -> None:
        """Stop the arm where it is."""
        self._told = self._told or why

    def _run(self, seconds: float) -> None:
        self.lines.append(texts.STARTED.format(robot=self.robot))
        try:
            with ExitStack() as stack:
                motions = self.checking.motions(seconds)
                arm = Stoppable(self.open_arm(stack), lambda: self._told or self.hangs())
                result = self.checking.carry_out(motions, 0, arm, self.lines.append)
            self.finished(result)
            self.result = result
            self.lines.append(texts.FINISHED)
        except FailureTwinError as error:
            self.lines.append(str(error))
        finally:
            self._over.set()


def beat_watch(server_s: Callable[[], float], page_s: Callable[[], float]) -> Callable[[], str]:
    """Return what tells why a check must stop by itself: the server hangs, or the page does.

    Both are given by the time of their last beat, by the monotonic clock [s].
    """

    def why() -> str:
        late_s = time.monotonic() - HANGS_S
        if server_s() < late_s:
            return texts.HANG
        return texts.GONE if page_s() < late_s else ""

    return why
