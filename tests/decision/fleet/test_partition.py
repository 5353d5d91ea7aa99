"""A partition: what it decides depends on the messages and their order alone."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from failuretwin.connection.fleet.messages import LARGEST, MAGIC, events_binary, profile_json
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.core.errors import InputError
from failuretwin.decision.fleet import partition as partition_module
from failuretwin.decision.fleet.monitor import FleetMonitor
from failuretwin.decision.fleet.partition import (
    EVENTS,
    PROFILE,
    Envelope,
    Partition,
)
from fleet_messages import PROFILE_OF, ZERO_S, decided, envelopes, played, resolve, seconds

EARLY = 3 + 3 * 26
"""Messages of 26 s, in which both faults are found."""


def first_of(alone):
    """Return what is decided of the early messages: messages are taken in one by one."""
    changes, _ = alone
    found = [one for one in changes if one.message <= EARLY]
    assert {one.cause for one in found} == {"motor_3:stuck", "motor_2:steady_state_error"}
    return found


def causes(changes):
    return {(one.robot, one.state, one.cause) for one in changes}


def test_faults_are_found_and_cleared(alone):
    changes, partition = alone
    assert causes(changes) == {
        ("arm_1", "alarm", "motor_3:stuck"),
        ("arm_2", "alarm", "motor_2:steady_state_error"),
        ("arm_2", "cleared", "motor_2:steady_state_error"),
    }
    states = {name: one["state"] for name, one in partition.health().items()}
    assert states == {"arm_0": "clear", "arm_1": "alarm", "arm_2": "clear"}
    assert not partition.counts
    first = next(one for one in changes if one.robot == "arm_1")
    assert "motor 3 stuck" in first.diagnosis["verdict"]
    assert first.identity == "arm_1.5.1.alarm"  # the fifth message was the first of its events


def test_neither_how_many_come_at_once_nor_json_changes_anything(alone):
    in_json = played(Partition(resolve), envelopes(as_json=True)[:EARLY], at_once=41)
    assert decided(in_json) == decided(first_of(alone))


def test_a_snapshot_goes_on_as_if_there_were_none(alone):
    """What is decided is the same to the bit; what is computed again, to the last digits."""
    changes, whole = alone
    messages, found = envelopes(), []
    partition = Partition(resolve)
    for first in range(0, len(messages), 60):
        found += partition.take(messages[first : first + 60])
        partition = Partition.restored(partition.snapshot(), resolve)
    assert decided(found) == decided(changes)
    ours, theirs = (next(iter(one._groups.values())).monitor.state() for one in (partition, whole))
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        np.testing.assert_allclose(value, theirs[name][: len(value)], 1e-6, 1e-9, err_msg=name)


def test_robots_in_other_partitions_change_nothing(alone):
    messages = envelopes()[:EARLY]
    apart = []
    for k in (0, 1):
        own = [one for one in messages if int(one.robot[-1]) % 2 == k]
        apart += played(Partition(resolve), own)
    assert decided(apart) == decided(first_of(alone))


def test_messages_that_are_delivered_again_change_nothing(alone):
    messages = envelopes()[:EARLY]
    partition = Partition(resolve)
    found = played(partition, messages[:60])
    found += played(partition, messages[30:])
    assert decided(found) == decided(first_of(alone))


def test_messages_that_are_sent_again_are_counted_and_change_nothing(alone):
    changes, messages = first_of(alone), envelopes()[:EARLY]
    doubled = [copy for one in messages for copy in (one, one)]
    numbered = [replace(one, number=2 * k + 1) for k, one in enumerate(doubled)]
    partition = Partition(resolve)
    found = played(partition, numbered)
    assert {(c.robot, c.episode, c.state, c.cause, c.stream_s) for c in found} == {
        (c.robot, c.episode, c.state, c.cause, c.stream_s) for c in changes
    }
    counts = partition.health()["arm_0"]["counts"]
    own = sum(
        len(events) for second in seconds()[:26] for name, events in second if name == "arm_0"
    )
    assert 0.9 * own < counts["doubled"] <= own


def test_messages_out_of_order_are_taken_in(alone):
    """Neighbouring seconds of a robot are swapped: what is late finds its place."""
    partition, messages = Partition(resolve), envelopes()[:EARLY]
    profiles, events = messages[:3], messages[3:]
    for first in range(0, len(events) - 6, 12):
        events[first : first + 6] = events[first + 3 : first + 6] + events[first : first + 3]
    found = played(partition, [replace(m, number=k + 1) for k, m in enumerate(profiles + events)])
    raised = {(c.robot, c.cause) for c in found if c.state == "alarm"}
    assert ("arm_2", "motor_2:steady_state_error") in raised
    assert not [one for one in found if one.robot == "arm_0"]


def test_a_robot_without_a_profile_is_counted_until_it_has_one():
    message = events_binary([Reading(0.0, np.zeros(3))], 4)
    partition = Partition(resolve)
    partition.take([Envelope(1, ZERO_S, "stranger", EVENTS, message)])
    assert partition.counts == {"no_profile": 1}
    assert "fleet.in.ROBOT.profile" in partition.remarks["stranger"]
    partition.take([Envelope(2, ZERO_S, "stranger", PROFILE, b'{"profile": "armpi_fpw"}')])
    partition.take([Envelope(3, ZERO_S, "stranger", EVENTS, message)])
    assert partition.counts == {"no_profile": 2, "malformed": 1}
    assert "armpi_fpw" in partition.remarks["stranger"]
    partition.take([Envelope(4, ZERO_S, "stranger", PROFILE, profile_json(PROFILE_OF))])
    partition.take([Envelope(5, ZERO_S, "stranger", EVENTS, message)])
    assert partition.counts == {"no_profile": 2, "malformed": 1} and not partition.remarks
    assert partition.health()["stranger"]["state"] == "waiting"


def test_a_clock_that_is_set_is_noticed_after_a_while():
    partition = Partition(resolve)
    partition.take([Envelope(1, ZERO_S, "arm", PROFILE, profile_json(PROFILE_OF))])
    for k in range(60):  # set back by an hour at 20 s
        stamp = k if k < 20 else k - 3600.0
        reading = events_binary([Reading(float(stamp), np.array([0.1, 0.0, 0.3]))], 4)
        partition.take([Envelope(k + 2, ZERO_S + k, "arm", EVENTS, reading)])
    counts = partition.health()["arm"]["counts"]
    assert counts == {"late": 10, "clock_set": 1}
    group = next(iter(partition._groups.values()))
    assert group.monitor.fleet.times[0] == pytest.approx(59.0)


def hostile(rng, number):
    """Return a message that nobody should send."""
    kinds = [
        b"",
        b"\x00" * 40,
        b"null",
        b"[1, 2, 3]",
        b'{"readings": 7}',
        b'{"readings": [{"t": 0, "tool": [1, 2]}]}',
        b'{"readings": [{"t": NaN, "tool": [0, 0, 0]}]}',
        b'{"t": 1e400, "tool": [0, 0, 0]}',
        b'{"t": 1, "tool": [Infinity, 0, 0]}',
        b'{"t": "now", "tool": ["a", "b", "c"]}',
        b'{"t": true, "tool": [true, false, null]}',
        b'{"t": 1, "target": [0, 0, 0, 0], "duration": [-1, 1, 1, 1]}',
        b'{"t": 1, "target": [0], "duration": [1]}',
        b"[" * 100_000,
        b'{"profile": "../../etc/passwd"}',
        b"x" * (LARGEST + 1),
        MAGIC,
        MAGIC + b"\xff" * 60,
        events_binary([Reading(1.0, np.zeros(3))], 4)[:-3],
        events_binary([Reading(5e10 + number, np.zeros(3))], 4),
        events_binary([Reading(-5e10 - number, np.zeros(3))], 4),
        events_binary([CommandSent(9e10, np.full(4, 9e5), np.full(4, 9e5))], 4),
        events_binary([Reading(1.0, np.full(3, 1e300))], 4),
        rng.randbytes(200),
    ]
    return rng.choice(kinds)


def test_hostile_messages_are_counted_and_harmless(alone):
    """A thousand, under the names of robots at work, of others, and as profiles."""
    changes = first_of(alone)
    rng, partition, mixed = random.Random(1), Partition(resolve), []
    messages = envelopes()[:EARLY]
    for one in messages:
        mixed.append(one)
        for _ in range(15 if len(mixed) > 6 else 0):
            name = rng.choice([one.robot, "stranger", "another"])
            kind = rng.choice([EVENTS, EVENTS, PROFILE, "other"])
            mixed.append(Envelope(0, one.server_s, name, kind, hostile(rng, len(mixed))))
    numbered = [replace(one, number=k + 1) for k, one in enumerate(mixed)]
    bad = len(mixed) - len(messages)
    assert bad > 1000
    found = played(partition, numbered, at_once=500)
    assert {(c.robot, c.episode, c.state, c.cause, c.stream_s) for c in found} == {
        (c.robot, c.episode, c.state, c.cause, c.stream_s) for c in changes
    }
    left_out = sum(partition.counts.values())
    left_out += sum(sum(one["counts"].values()) for one in partition.health().values())
    assert left_out == bad


def test_a_snapshot_of_another_format_is_refused(monkeypatch):
    monkeypatch.setattr(partition_module, "FORMAT", 0)
    data = Partition(resolve).snapshot()
    monkeypatch.undo()
    with pytest.raises(InputError, match="of format 0, expected"):
        Partition.restored(data, resolve)


def test_a_snapshot_is_small_and_one_that_lacks_something_is_refused(alone, monkeypatch):
    _, partition = alone
    assert len(partition.snapshot()) < 45_000 * 3
    monkeypatch.setattr(FleetMonitor, "state", lambda self: {})
    with pytest.raises(InputError, match="lacks something"):
        Partition.restored(partition.snapshot(), resolve)
