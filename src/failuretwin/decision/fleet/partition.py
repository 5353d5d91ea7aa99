"""The robots of one partition: from their messages to changes of their alarms.

What comes out depends on the messages and their order alone, never on a clock of this computer or
on how many came at once. So a worker that takes over from a snapshot and replays what came after it
decides the same, and its alarms have the same identity.
"""

from __future__ import annotations

import io
import json
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from failuretwin.connection.fleet.messages import (
    ProfileMessage,
    parse_events,
    parse_profile,
)
from failuretwin.connection.fleet.robot_input import RobotInput, Sample
from failuretwin.core.config import fingerprint, from_table
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import ALL_CLEAR, RAISED, Alarm, Episode
from failuretwin.decision.fleet.monitor import FleetMonitor
from failuretwin.inference.diagnoser import BayesDiagnoser

FORMAT = 2
"""Format of a snapshot."""
FIRST_ROOM = 8
"""Robots of a kind that there is room for at first."""
PROFILE, EVENTS = "profile", "events"
"""Kinds of messages; the last part of their subjects."""
CLEARED = "cleared"
MALFORMED, UNKNOWN, REFUSED = "malformed", "no_profile", "refused"
"""What is counted: messages that make no sense, those of robots without a profile, and those of
robots that are refused."""
NO_PROFILE = "no profile is known of it, expected one on fleet.in.ROBOT.profile first."
MOST_REMARKS = 20
"""Robots of a partition of which the reason is kept."""

Resolve = Callable[[ProfileMessage], BayesDiagnoser]
"""Returns the method for robots with a profile; raises InputError where there is none."""


@dataclass(frozen=True)
class Envelope:
    """A message as the server stored it.

    Attributes:
        number: Its number in the stream of the server.
        server_s: When the server took it in [s since 1970].
        robot: Name of the robot, by its subject.
        kind: `PROFILE` or `EVENTS`.
        data: The message.
    """

    number: int
    server_s: float
    robot: str
    kind: str
    data: bytes


@dataclass(frozen=True)
class AlarmChange:
    """An alarm that was raised or cleared.

    Attributes:
        robot: Name of the robot.
        life: Number of the message with which its filter began.
        episode: Number of the episode in this life.
        state: ``alarm`` or ``cleared``.
        cause: The diagnosed hypothesis.
        before: Cause of the alarm that stood before; empty: none.
        at: When the server took in the message that decided it [s since 1970].
        stream_s: When it was by the stream of the robot [s].
        message: Number of that message.
        diagnosis: The diagnosis behind it, as a table.
    """

    robot: str
    life: int
    episode: int
    state: str
    cause: str
    before: str
    at: float
    stream_s: float
    message: int
    diagnosis: Mapping[str, Any]

    @property
    def identity(self) -> str:
        """What is the same each time that it is decided, also after a replay."""
        return f"{self.robot}.{self.life}.{self.episode}.{self.state}"


@dataclass
class _Robot:
    """A robot in its group.

    Attributes:
        kind: Key of its group.
        row: Its row there.
        life: Number of the message with which it began.
        input: Its clock and reference.
        told: The alarm as it was last told.
    """

    kind: str
    row: int
    life: int
    input: RobotInput
    told: Alarm = ALL_CLEAR


class _Group:
    """Robots of one kind; room for more is made as they come."""

    def __init__(self, diagnoser: BayesDiagnoser, budget: float) -> None:
        self.monitor = FleetMonitor(diagnoser, FIRST_ROOM, budget)
        self.names: list[str] = []
        self.pending: dict[int, deque[tuple[Sample, Envelope]]] = {}

    def join(self, name: str) -> int:
        """Add a robot and return its row."""
        old = self.monitor
        if len(self.names) == old.fleet.robots:
            self.monitor = FleetMonitor(old.diagnoser, 2 * old.fleet.robots, old.budget)
            self.monitor.restore(old.state(), old.alarms())
        self.names.append(name)
        return len(self.names) - 1

    def judgements(self) -> Iterator[dict[int, Envelope]]:
        """Take the samples that wait; yield robots that were judged, and the messages behind.

        Robots that are to be judged wait for the others, so that many are judged together.
        """
        while self.pending:
            halted: dict[int, Envelope] = {}
            while rows := [row for row in self.pending if row not in halted]:
                halted |= self._see(rows)
            if halted:
                self.monitor.judge(np.array(sorted(halted)))
                yield halted

    def _see(self, rows: list[int]) -> dict[int, Envelope]:
        """Take the next sample of some robots, and return those to be judged."""
        monitor = self.monitor
        motors = len(monitor.diagnoser.twin.robot.motors)
        time = np.full(monitor.fleet.robots, np.nan)
        command = np.full((monitor.fleet.robots, motors), np.nan)
        measured = np.full((monitor.fleet.robots, 3), np.nan)
        behind = {}
        for row in rows:
            waiting = self.pending[row]
            (time[row], reference, point), behind[row] = waiting.popleft()
            if reference is not None:
                command[row] = reference
            if point is not None:
                measured[row] = point
            if not waiting:
                del self.pending[row]
        return {row: behind[row] for row in monitor.fleet.see(time, command, measured).tolist()}


class Partition:
    """The robots of one partition.

    Attributes:
        counts: Messages that were left out, by reason.
        last: Number of the last message that was taken; 0: none.
        announced: Profiles, by robot.
        refused: Robots whose messages break the filter: they are counted and left out.
        remarks: Why a message was left out, the last one of a robot; of the first robots alone.

    Args:
        resolve: Finds the method for a profile.
        budget: False alarms in 100 hours that are allowed of each robot.
        announced: Profiles that were announced before the first message, by robot.
        last: Number of the last message before the first.
    """

    def __init__(
        self,
        resolve: Resolve,
        budget: float = 1.0,
        announced: Mapping[str, ProfileMessage] | None = None,
        last: int = 0,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.last = last
        self.announced = dict(announced or {})
        self.refused: set[str] = set()
        self.remarks: dict[str, str] = {}
        self._resolve, self._budget = resolve, budget
        self._robots: dict[str, _Robot] = {}
        self._groups: dict[str, _Group] = {}
        self._messages: dict[str, ProfileMessage] = {}

    def take(self, messages: Iterable[Envelope]) -> list[AlarmChange]:
        """Take messages in the order of the stream and return the alarms that change."""
        for message in messages:
            if message.number <= self.last:  # delivered again
                continue
            self.last = message.number
            if message.robot in self.refused:
                self.counts[REFUSED] += 1
                continue
            try:
                if message.kind == PROFILE:
                    self._announce(message)
                elif message.kind == EVENTS:
                    self._hear(message)
                else:
                    raise InputError(f"kind {message.kind!r}, expected {PROFILE} or {EVENTS}.")
            except InputError as error:
                self.counts[MALFORMED] += 1
                self._remark(message.robot, str(error))
        changes = list[AlarmChange]()
        for group in self._groups.values():
            for judged in group.judgements():
                for row, message in judged.items():
                    changes += self._changes(self._robots[message.robot], row, message)
        return changes

    def _remark(self, robot: str, text: str) -> None:
        if robot in self.remarks or len(self.remarks) < MOST_REMARKS:
            self.remarks[robot] = text

    def _announce(self, message: Envelope) -> None:
        """Take in a profile; the same once more changes nothing, another makes another robot."""
        found = parse_profile(message.data)
        self._resolve(found)
        self.announced[message.robot] = found
        self.remarks.pop(message.robot, None)
        known = self._robots.get(message.robot)
        if known is not None and known.kind != fingerprint(found):
            group = self._groups[known.kind]
            group.pending.pop(known.row, None)
            group.names[known.row] = ""
            del self._robots[message.robot]

    def _hear(self, message: Envelope) -> None:
        robot = self._robots.get(message.robot)
        if robot is None:
            if message.robot not in self.announced:
                self.counts[UNKNOWN] += 1
                self._remark(message.robot, self.remarks.get(message.robot, NO_PROFILE))
                return
            robot = self._join(message)
        group = self._groups[robot.kind]
        motors = len(group.monitor.diagnoser.twin.robot.motors)
        events = parse_events(message.data, motors)
        samples = robot.input.take(events, message.server_s)
        if samples:
            group.pending.setdefault(robot.row, deque()).extend((one, message) for one in samples)

    def _join(self, message: Envelope) -> _Robot:
        found = self.announced[message.robot]
        key = fingerprint(found)
        if key not in self._groups:
            self._groups[key] = _Group(self._resolve(found), self._budget)
            self._messages[key] = found
        row = self._groups[key].join(message.robot)
        robot = _Robot(key, row, message.number, RobotInput())
        self._robots[message.robot] = robot
        return robot

    def _changes(self, robot: _Robot, row: int, message: Envelope) -> list[AlarmChange]:
        """Return what has changed of the alarm of a robot that was judged."""
        monitor = self._groups[robot.kind].monitor
        before, now = robot.told, monitor.alarm(row)
        robot.told = now
        old = before.episode if before.state == RAISED else None
        new = now.episode if now.state == RAISED else None
        if (None if old is None else old.number) == (None if new is None else new.number):
            return []
        said = monitor.diagnosis(row) or monitor.fleet.undecided(row, "nothing is known")
        stream_s = float(monitor.fleet.times[row])

        def change(episode: Episode, state: str) -> AlarmChange:
            return AlarmChange(
                message.robot,
                robot.life,
                episode.number,
                state,
                episode.cause,
                "" if old is None else old.cause,
                message.server_s,
                stream_s,
                message.number,
                asdict(replace(said, run=message.robot)),
            )

        found = [] if old is None else [change(old, CLEARED)]
        return found if new is None else [*found, change(new, RAISED)]

    def health(self) -> dict[str, dict[str, Any]]:
        """Return the state of each robot, and what was left out of its messages."""
        found = {}
        for name, robot in self._robots.items():
            monitor = self._groups[robot.kind].monitor
            trouble, alarm = monitor.fleet.trouble(robot.row), robot.told
            judged = bool(monitor.fleet.judged[robot.row])
            state = "undecided" if trouble else alarm.state if judged else "waiting"
            found[name] = {
                "state": state,
                "cause": trouble or alarm.cause,
                "heard": robot.input.heard_s,
                "counts": dict(robot.input.counts),
            }
        return found

    # Snapshots.

    def snapshot(self) -> bytes:
        """Return all that is known, from which `restored` goes on."""
        arrays: dict[str, Any] = {}
        groups = []
        for number, (key, group) in enumerate(self._groups.items()):
            known = len(group.names)
            state = group.monitor.state()
            arrays |= {f"{number}/{name}": value[:known] for name, value in state.items()}
            groups.append(
                {
                    "key": key,
                    "profile": asdict(self._messages[key]),
                    "names": group.names,
                    "alarms": group.monitor.alarms()[:known],
                }
            )
        robots = {
            name: {
                "kind": one.kind,
                "row": one.row,
                "life": one.life,
                "input": one.input.state(),
                "told": asdict(one.told),
            }
            for name, one in self._robots.items()
        }
        header = {
            "format": FORMAT,
            "last": self.last,
            "counts": dict(self.counts),
            "announced": {name: asdict(one) for name, one in self.announced.items()},
            "refused": sorted(self.refused),
            "groups": groups,
            "robots": robots,
        }
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        return buffer.getvalue()

    @classmethod
    def restored(cls, data: bytes, resolve: Resolve, budget: float = 1.0) -> Partition:
        """Return the partition that a snapshot was of.

        Raises:
            InputError: If it is of another format.
        """
        try:
            return cls._restored(data, resolve, budget)
        except (KeyError, ValueError) as error:
            raise InputError(f"a snapshot that lacks something ({error!r:.200}).") from error

    @classmethod
    def _restored(cls, data: bytes, resolve: Resolve, budget: float) -> Partition:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        header = json.loads(arrays.pop("header").tobytes())
        if header["format"] != FORMAT:
            raise InputError(f"a snapshot of format {header['format']}, expected {FORMAT}.")
        made = cls(
            resolve, budget, {n: ProfileMessage(**p) for n, p in header["announced"].items()}
        )
        made.counts, made.last = Counter(header["counts"]), header["last"]
        made.refused = set(header["refused"])
        for number, table in enumerate(header["groups"]):
            profile = ProfileMessage(**table["profile"])
            group = _Group(resolve(profile), budget)
            room = group.monitor.fleet.robots
            while room < len(table["names"]):
                room *= 2
            group.monitor = FleetMonitor(group.monitor.diagnoser, room, budget)
            prefix = f"{number}/"
            state = {n.removeprefix(prefix): v for n, v in arrays.items() if n.startswith(prefix)}
            group.monitor.restore(state, table["alarms"])
            group.names = table["names"]
            made._groups[table["key"]], made._messages[table["key"]] = group, profile
        for name, one in header["robots"].items():
            told = from_table(Alarm, one["told"], "alarm")
            source = RobotInput.restored(one["input"])
            made._robots[name] = _Robot(one["kind"], one["row"], one["life"], source, told)
        return made
