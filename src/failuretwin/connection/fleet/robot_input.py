"""From the messages of one robot to the samples of a stream, whatever its clock and network do.

The result depends on the messages, their order and the times at which the server took them in;
never on the clock of this computer. So a replay gives the same samples.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from failuretwin.connection.fleet.messages import Events
from failuretwin.connection.links.base import CommandSent
from failuretwin.connection.links.stream_time import LiveReference, Ramp
from failuretwin.core.types import FloatArray

AHEAD_S = 5.0
"""Largest lead of a stamp over the robot's clock, as the server sees it [s]; beyond it is wrong."""
LATE_S = 5.0
"""Largest delay of an event behind the newest reading [s]; beyond it says nothing any more."""
SET_AFTER_S = 10.0
"""Time without a stamp in order from which the robot's clock was set [s]."""
KNOWN = 256
"""Latest stamps by which doubles are known."""

LATE, DOUBLED, AHEAD, CLOCK_SET = "late", "doubled", "ahead", "clock_set"
"""What is counted: events that are left out because they are too old, are there already, or are of
the future; and how often a clock was set."""

Sample = tuple[float, FloatArray | None, FloatArray | None]
"""Time of the stream [s], references (motor,) [rad] and tool position (axis,) [m]."""


class RobotInput:
    """Clock and reference of one robot.

    Attributes:
        counts: Events that were left out, by reason.
        heard_s: When the server last heard of it [s].
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.heard_s = -np.inf
        self._offset = self._lead = 0.0
        self._newest: float | None = None
        self._in_order_s = -np.inf
        self._known: deque[tuple[float, bool]] = deque(maxlen=KNOWN)
        self._reference = LiveReference()

    def take(self, events: Events, server_s: float) -> list[Sample]:
        """Take the events of a message that the server received at a time [s]."""
        self.heard_s, samples = server_s, list[Sample]()
        times = np.concatenate([events.commands[:, 0], events.readings[:, 0]])
        commands = len(events.commands)
        motors = (events.commands.shape[1] - 1) // 2
        for k in np.argsort(times, kind="stable").tolist():  # a command before a reading
            reading = k >= commands
            at = self._stream_time(float(times[k]), server_s, reading)
            if at is None:
                continue
            if reading:
                samples += self._samples(at, events.readings[k - commands, 1:])
            else:
                row = events.commands[k]
                self._reference.add(CommandSent(at, row[1 : 1 + motors], row[1 + motors :]))
        return samples

    def _samples(self, time: float, point: FloatArray) -> list[Sample]:
        """Return the corners of the reference since the last reading, and this reading."""
        corners = self._reference.corners_to(time)
        found: list[Sample] = [(at, angles, None) for at, angles in corners if at < time]
        last = corners[-1][1] if corners else None
        return [*found, (time, last, point)]

    def _stream_time(self, stamp: float, server_s: float, reading: bool) -> float | None:
        """Return the time of an event that counts [s]; None: it is left out, and counted."""
        if self._newest is None:
            self._newest, self._offset = stamp, -stamp
            self._lead, self._in_order_s = stamp - server_s, server_s
        ahead = stamp - server_s - self._lead > AHEAD_S
        late = stamp < self._newest - LATE_S
        if (ahead or late) and server_s - self._in_order_s > SET_AFTER_S:
            self.counts[CLOCK_SET] += 1
            gone = server_s - self._in_order_s
            self._offset += self._newest + gone - stamp
            self._newest, self._lead = stamp, stamp - server_s
            self._known.clear()
        elif ahead or late:
            self.counts[AHEAD if ahead else LATE] += 1
            return None
        if (stamp, reading) in self._known:
            self.counts[DOUBLED] += 1
            return None
        self._known.append((stamp, reading))
        if reading and stamp >= self._newest:
            self._newest, self._in_order_s = stamp, server_s
            self._lead = max(self._lead, stamp - server_s)
        return stamp + self._offset

    # State.

    def state(self) -> dict[str, Any]:
        """Return all that is known, in JSON types."""
        reference = self._reference
        ramp = reference.ramp
        return {
            "counts": dict(self.counts),
            "heard_s": self.heard_s,
            "clock": [self._offset, self._lead, self._newest, self._in_order_s],
            "known": list(self._known),
            "until": reference.known_until,
            "ramp": None
            if ramp is None
            else [ramp.start, ramp.origin.tolist(), ramp.target.tolist(), ramp.duration.tolist()],
            "pending": [
                [one.time, one.target.tolist(), one.duration.tolist()] for one in reference.pending
            ],
        }

    @classmethod
    def restored(cls, state: Mapping[str, Any]) -> RobotInput:
        """Return the input that `state` was of."""
        made = cls()
        made.counts, made.heard_s = Counter(state["counts"]), state["heard_s"]
        made._offset, made._lead, made._newest, made._in_order_s = state["clock"]
        made._known.extend((stamp, reading) for stamp, reading in state["known"])
        ramp = state["ramp"]
        known = None if ramp is None else Ramp(ramp[0], *map(np.array, ramp[1:]))
        pending = [
            CommandSent(at, np.array(to), np.array(for_s)) for at, to, for_s in state["pending"]
        ]
        made._reference.resume(known, pending, state["until"])
        return made
