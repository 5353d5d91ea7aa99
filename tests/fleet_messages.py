"""Messages of a small fleet of emulated arms, as a server numbers and stamps them."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np

from failuretwin.app.arms import emulation_with, known_arm
from failuretwin.app.fleet import resolver
from failuretwin.connection.emulated_arm import EmulatedFleet
from failuretwin.connection.fleet.messages import (
    ProfileMessage,
    events_binary,
    profile_json,
)
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.decision.fleet.partition import EVENTS, PROFILE, Envelope
from failuretwin.digital_model.robot import load_robot

FAULTS = ((), ("motor_3:stuck@8",), ("motor_2:steady_state_error@10-26",))
SECONDS, ZERO_S = 40, 1.8e9
PROFILE_OF = ProfileMessage("armpi_fpv")
resolve = resolver(None)


def events_json(events):
    """Return readings and commands as a gateway writes them."""
    readings = [one for one in events if isinstance(one, Reading) and np.isfinite(one.tool).all()]
    table = {
        "readings": [{"t": one.time, "tool": one.tool.tolist()} for one in readings],
        "commands": [
            {"t": one.time, "target": one.target.tolist(), "duration": one.duration.tolist()}
            for one in events
            if isinstance(one, CommandSent)
        ],
    }
    return json.dumps(table).encode()


@cache
def seconds(robots=3):
    """Return the events of each second of each arm; their clocks are 1000 s apart."""
    known = known_arm(load_robot("armpi_fpv"))
    arms = [
        (f"arm_{k}", emulation_with(FAULTS[k % len(FAULTS)], known, seed=k)) for k in range(robots)
    ]
    fleet = EmulatedFleet(arms, begin=0.0, seconds=SECONDS)
    found = []
    while (second := fleet.second()) is not None:
        found.append(
            [
                (name, [replace(one, time=one.time + 1000.0 * k) for one in events])
                for k, (name, events) in enumerate(second)
            ]
        )
    return found


def envelopes(robots=3, as_json=False):
    """Return the messages of the fleet in the order of the server."""
    packed = events_json if as_json else lambda events: events_binary(events, 4)
    found = [
        Envelope(k + 1, ZERO_S, f"arm_{k}", PROFILE, profile_json(PROFILE_OF))
        for k in range(robots)
    ]
    for number, second in enumerate(seconds(robots)):
        for k, (name, events) in enumerate(second):
            at = ZERO_S + number + 1.0 + 0.01 * k
            found.append(Envelope(len(found) + 1, at, name, EVENTS, packed(events)))
    return found


def played(partition, messages, at_once=60):
    """Return all changes of alarms while messages come some at a time."""
    found = []
    for first in range(0, len(messages), at_once):
        found += partition.take(messages[first : first + at_once])
    return found


def decided(changes):
    """Return what was decided: all but the words."""
    return sorted(
        (one.identity, one.cause, one.before, one.at, one.stream_s, one.message) for one in changes
    )
