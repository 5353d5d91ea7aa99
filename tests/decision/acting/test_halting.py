"""An arm is told to stay until it stands, by a clock that moves with what the arm does."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin.connection.links.base import LinkCounts, Reading
from failuretwin.core.errors import InputError
from failuretwin.decision.acting import work
from failuretwin.decision.acting.work import (
    LONGEST_S,
    MOVES,
    SILENT,
    STANDS,
    bring_to_rest,
)

SPEED = 0.4


class Arm:
    """An arm of one motor on its way, read ten times a second; some of its orders get lost.

    Args:
        clock: What it moves by.
        lost: Orders that it does not hear, by number.
        read_s: Until when its motor is read [s].
    """

    name, ended, counts, standing = "an arm", False, LinkCounts(), np.array([9.0])

    def __init__(self, clock, lost=(), read_s=np.inf):
        self.clock, self.lost, self.read_s = clock, lost, read_s
        self.angle, self.target, self.sent = 0.0, 9.0, []

    def poll(self, timeout_s):
        self.clock.now += timeout_s
        step = np.clip(self.target - self.angle, -SPEED * timeout_s, SPEED * timeout_s)
        self.angle += step
        seen = self.clock.now < self.read_s
        return Reading(self.clock.now, position=np.array([self.angle if seen else np.nan]))

    def send(self, order):
        if len(self.sent) not in self.lost:
            self.target = float(order.target[0])
        self.sent.append(order)


class Clock:
    now = 0.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(work, "time", made)
    return made


def test_an_arm_that_hears_is_told_once(clock):
    arm = Arm(clock)
    assert bring_to_rest(arm) == STANDS
    assert len(arm.sent) == 1
    assert arm.sent[0].target == pytest.approx(arm.angle)
    assert arm.sent[0].duration.max() <= 0.1


def test_an_arm_that_did_not_hear_is_told_again_where_it_is_then(clock):
    arm = Arm(clock, lost=(0, 1))
    assert bring_to_rest(arm) == STANDS
    assert len(arm.sent) == 3
    places = [float(order.target[0]) for order in arm.sent]
    assert places == sorted(places)
    assert arm.angle == pytest.approx(places[-1], abs=1e-9)


def test_an_arm_that_never_hears_is_said_to_move(clock):
    arm = Arm(clock, lost=range(100))
    assert bring_to_rest(arm) == MOVES
    assert len(arm.sent) == pytest.approx(LONGEST_S / work.AGAIN_S, abs=2)


def test_an_arm_that_falls_silent_is_not_said_to_stand(clock):
    arm = Arm(clock, read_s=0.05)
    assert bring_to_rest(arm, np.zeros(1)) == SILENT
    assert len(arm.sent) == 1


def test_an_arm_that_is_never_read_gets_no_order(clock):
    arm = Arm(clock, read_s=0.0)
    with pytest.raises(InputError, match="emergency stop"):
        bring_to_rest(arm)
    assert arm.sent == []
