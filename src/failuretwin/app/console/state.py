"""What the console shows, as values: tiles of robots, live views, traces of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from failuretwin.app.console import texts
from failuretwin.connection.links.statuses import Status
from failuretwin.core.foreign import printable
from failuretwin.core.hypothesis import CLEAR, FAULTY_STATE, Alarm, Diagnosis, Hypothesis
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.records import CHECK_DAYS
from failuretwin.data_knowledge.records.queries import RobotGlance
from failuretwin.decision.streaming.set_up_watch import is_held
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.inference.explanation import plain_name, set_up_doubt

ALARM, SUSPECTED, SET_UP, UNDECIDED, STALE, WAITING, HEALTHY = texts.STATES
WORST_FIRST = (ALARM, SUSPECTED, SET_UP, UNDECIDED, STALE, WAITING, HEALTHY)
SUSPECT = 0.05
"""Probability from which the drawn arm lets a motor differ from its command."""
STAMP = "%Y-%m-%dT%H:%M:%SZ"
"""Form of times (UTC) in texts, which pages show in the zone of their reader."""
LONGEST_TEXT = 300
"""Length to which texts from logs are cut [letters]."""


def shortened(text: str, most: int) -> str:
    """Return a text of so many letters at most; one that is cut ends with an ellipsis."""
    return text if len(text) <= most else f"{text[: most - 1].rstrip()}…"


@dataclass(frozen=True)
class Tile:
    """A robot on the wall.

    Attributes:
        name: Its name.
        kind: Name of its profile; empty: not known.
        site: The part of its name before the first dash; empty: none.
        state: One of `WORST_FIRST`.
        mode: Fault modes that are named, joined by commas.
        said: The state in words.
        heard: When it was last heard (UTC); None: never.
        set_up: Why its set-up is uncertain; empty: it is not.
    """

    name: str
    kind: str
    state: str
    mode: str
    said: str
    heard: datetime | None
    set_up: str = ""

    @property
    def site(self) -> str:
        """The part of its name before the first dash; empty: none."""
        head, dash, _ = self.name.partition("-")
        return head if dash else ""

    @property
    def states(self) -> tuple[str, ...]:
        """Its state, and `SET_UP` where its set-up is uncertain besides."""
        return (self.state, SET_UP) if self.set_up and self.state != SET_UP else (self.state,)

    def alarmed(self, faults: Mapping[str, bool]) -> Tile:
        """Return a live robot with the open episodes of the store that it does not tell itself."""
        told = open_faults({name: sure for name, sure in faults.items() if not self.tells(name)})
        if not told:
            return self
        state = ALARM if self.state in (HEALTHY, UNDECIDED, SUSPECTED, WAITING) else self.state
        return replace(self, state=state, said=texts.STILL_OPEN.format(faults=told, said=self.said))

    def tells(self, fault: str) -> bool:
        """Return whether it names a fault, ``MOTOR:MODE``."""
        return plain_name(Hypothesis.parse(fault)) in self.said

    def doubted(self, set_up: str) -> Tile:
        """Return it with what is to be said of its set-up; empty: nothing."""
        if not set_up:
            return self
        state = SET_UP if self.state in (HEALTHY, UNDECIDED) else self.state
        told = texts.SET_UP.format(said=self.said, finding=set_up)
        said = self.said if set_up in self.said else told
        return replace(self, state=state, said=said, set_up=set_up)

    @property
    def silent(self) -> Tile:
        """It as a robot that is stale: what it said is its last word."""
        return replace(self, state=STALE, said=texts.LAST_WORD.format(said=self.said))

    def record(self) -> dict[str, Any]:
        """Return it for the page."""
        return {
            "name": self.name,
            "kind": self.kind,
            "site": self.site,
            "states": self.states,
            "rank": WORST_FIRST.index(self.state),
            "mode": self.mode,
            "said": shortened(printable(self.said), LONGEST_TEXT),
            "heard": self.heard.timestamp() * 1000.0 if self.heard else None,
        }


@dataclass(frozen=True)
class Sample:
    """A reading of a live robot.

    Attributes:
        time: Time of the stream [s].
        read: When it came [s since 1970].
        command: Reference of the motors, (motor,) [rad]; None: not known.
        tool: Position of the tool, (axis,) [m].
    """

    time: float
    read: float
    command: FloatArray | None
    tool: FloatArray


@dataclass(frozen=True)
class LiveView:
    """State of a live robot.

    Attributes:
        tile: It on the wall.
        sample: The last reading; None: none yet.
        statuses: Status of the arm, then of each motor.
        diagnosis: The diagnosis; None: none yet.
        alarm: The alarm.
        changes: The last changes with their times, the newest last.
    """

    tile: Tile
    sample: Sample | None
    statuses: Sequence[Status]
    diagnosis: Diagnosis | None
    alarm: Alarm
    changes: Sequence[str]


@dataclass(frozen=True)
class Clock:
    """Time of day of a stream: `start` + `pace` t [s since 1970], with its own time t [s]."""

    start: float
    pace: float

    def stamp(self, at: float) -> str:
        """Return a time of the stream [s] as a time of day (UTC)."""
        return f"{datetime.fromtimestamp(self.start + self.pace * at, UTC):{STAMP}}"


def moment(clock: Clock | None, at: float) -> str:
    """Return a time of a stream [s] in words: the time of day where it is known."""
    return texts.STREAM_TIME.format(time=at) if clock is None else clock.stamp(at)


@dataclass(frozen=True)
class Trace:
    """Motion of a run, or of the last minutes of a live robot.

    Attributes:
        name: Name of the run.
        time: (sample,) [s].
        command: References of the motors, (sample, motor) [rad].
        measured: Tool positions, (sample, axis) [m]; NaN: no reading.
        movements: Starts of movements, (movement,) [s].
        diagnosis: Diagnosis of it; None: none.
        posterior: Times [s] and probabilities of hypotheses; empty: not followed over time.
        first: Number of the first of the movements.
        clock: Time of day of its time; None: it was recorded some time.
    """

    name: str
    time: FloatArray
    command: FloatArray
    measured: FloatArray
    movements: FloatArray
    diagnosis: Diagnosis | None
    posterior: Sequence[tuple[float, Mapping[str, float]]] = ()
    first: int = 1
    clock: Clock | None = None

    def end_of(self, movement: int) -> float | None:
        """Return the last time before the next movement, when a motor rests [s].

        None: the trace does not hold the movement, or nothing of it.
        """
        bounds = np.searchsorted(self.time, np.append(self.movements, np.inf))
        k = movement - self.first
        if not 0 <= k < len(self.movements) or bounds[k] == bounds[k + 1]:
            return None
        return float(self.time[bounds[k + 1] - 1])


def worst_first(tiles: Sequence[Tile]) -> list[Tile]:
    """Return tiles by health, then by name."""
    return sorted(tiles, key=lambda tile: (WORST_FIRST.index(tile.state), tile.name))


def modes_of(names: Sequence[str]) -> str:
    """Return the fault modes in hypotheses, joined by commas."""
    found = {fault.mode for name in names if name for fault in Hypothesis.parse(name).faults}
    return ", ".join(sorted(found))


def open_faults(faults: Mapping[str, bool]) -> str:
    """Return faults of open episodes in words, given whether each is confirmed."""
    return "; ".join(
        f"{plain_name(Hypothesis.parse(name))}{' (confirmed)' if confirmed else ''}"
        for name, confirmed in faults.items()
    )


def stored_tile(glance: RobotGlance, now: datetime) -> Tile:
    """Return a robot of the store. A robot without a run for `CHECK_DAYS` is stale."""
    said = open_faults(glance.faults) or glance.verdict
    mode = modes_of(list(glance.faults))
    if glance.at is None:
        return Tile(glance.robot, glance.kind, WAITING, mode, texts.NEVER, None)
    state = ALARM if glance.faults else STATES.get(glance.state, UNDECIDED)
    tile = Tile(glance.robot, glance.kind, state, mode, said, glance.at)
    silent = now - glance.at > timedelta(days=CHECK_DAYS)
    return (tile.silent if silent else tile).doubted(set_up_doubt(glance.remarks))


STATES = {
    **{state: state for state in WORST_FIRST},
    **{state.upper(): state for state in WORST_FIRST},
    **{"OK": HEALTHY, CLEAR: HEALTHY, FAULTY_STATE: ALARM},
}
"""State of a robot by the words of the store, of the fleet and of live statuses."""
REPORT_S = 30.0
"""Age of a report of a worker from which its robots are stale [s]."""


def fleet_tiles(status: Mapping[str, Any], kinds: Mapping[str, str], now_s: float) -> list[Tile]:
    """Return the robots of a fleet, by what its workers have reported.

    Args:
        status: What `app.fleet.read_status` returns.
        kinds: Profile of each robot, where known.
        now_s: Now [s since 1970].
    """
    tiles = []
    for part in status["partitions"].values():
        late = now_s - part["at"] > REPORT_S
        for name, one in part["robots"].items():
            state, cause = STATES.get(one["state"], UNDECIDED), str(one["cause"])
            said = cause or texts.STATES[state]
            mode = modes_of([cause]) if ":" in cause and " " not in cause else ""
            heard = datetime.fromtimestamp(one["heard"], UTC) if one["heard"] > 0 else None
            tile = Tile(name, kinds.get(name, ""), state, mode, said, heard)
            tile = tile.silent if late or state == STALE else tile
            tiles.append(tile.doubted(set_up_doubt([cause])))
    return tiles


# Poses that are drawn.


def suspected_motors(motors: Sequence[str], diagnosis: Diagnosis | None) -> BoolArray:
    """Return the motors whose fault is at least as probable as `SUSPECT`."""
    found = motor_shares(motors, diagnosis)
    return np.array([found[motor] >= SUSPECT for motor in motors])


def motor_shares(motors: Sequence[str], diagnosis: Diagnosis | None) -> dict[str, float]:
    """Return the probability of a fault of each motor."""
    shares = dict.fromkeys(motors, 0.0)
    if diagnosis is None or diagnosis.undecided:
        return shares
    for name, probability in diagnosis.posterior.items():
        for fault in Hypothesis.parse(name).faults:
            if fault.motor in shares:
                shares[fault.motor] = min(1.0, shares[fault.motor] + probability)
    return shares


def held_motor(
    motors: Sequence[str], suspects: BoolArray, diagnosis: Diagnosis | None
) -> tuple[int, float] | None:
    """Return a stuck motor and its angle [rad], if it is suspected; None: none has a known one."""
    if diagnosis is None or diagnosis.undecided or diagnosis.magnitude is None:
        return None
    for fault in Hypothesis.parse(diagnosis.diagnosis or "healthy").faults:
        motor = motors.index(fault.motor) if fault.motor in motors else None
        if is_held(str(fault)) and motor is not None and suspects[motor]:
            return motor, diagnosis.magnitude
    return None


def seen_pose(
    arm: InverseKinematics,
    command: FloatArray,
    tool: FloatArray,
    suspects: BoolArray,
    held: tuple[int, float] | None = None,
) -> FloatArray:
    """Return the pose nearest to a command that brings the tool to where it is, (motor,) [rad].

    Only suspected motors differ from the command, if there are any. A motor that is held somewhere
    stands there: while the arm moves, what the others trail behind would be taken for its angle.
    """
    if held is not None:
        pose = command.copy()
        pose[held[0]] = held[1]
        return pose
    if not np.isfinite(tool).all():
        return command
    locked = ~suspects if suspects.any() else None
    return np.asarray(arm.solve(tool[None], command[None], locked).pose[0, 0])


def residuals(arm: InverseKinematics, command: FloatArray, tool: FloatArray) -> FloatArray:
    """Return what remains of the tool error if one motor differs from its command [m].

    r_k = min over q_k of |tool - path(q)|, all other motors at their command; the last column is
    the error with all of them there. Commands are (sample, motor) [rad], the result is (sample,
    motor + 1).
    """
    motors = command.shape[-1]
    alone = [arm.solve(tool, command[:, None], np.arange(motors) != k) for k in range(motors)]
    error = np.linalg.norm(tool - arm.tool(command)[0], axis=-1)
    return np.column_stack([*(one.miss_m[:, 0] for one in alone), error])
