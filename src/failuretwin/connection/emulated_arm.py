"""Emulated arm: the physics engine's arm, which takes orders and works by itself, without end.

An order is carried out at once, unless the bus stalls: then readings stop, and the order waits
until the bus answers. A motor whose target does not change keeps its place. An arm at work moves at
random; its own commands keep the stamps of the time at which they were sent, as those of a program
that a stalled bus holds up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, Order, Reading
from failuretwin.connection.links.replay import AS_FAST_AS_POSSIBLE, Pace, PacedSource, Wait
from failuretwin.connection.links.stream_time import Ramp
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.disturbances import (
    Disturbances,
    draw_disturbances,
    lagged,
    sense,
    stack,
)
from failuretwin.digital_model.nonidealities import Imperfections, vary
from failuretwin.digital_model.physics.engine import LiveArms, PhysicsEngine
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.fault import INTERMITTENT, Course, EndlessEpisodes, FaultValue
from failuretwin.failure_behavior.injection import Injection, ScheduledFault
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.failure_behavior.modes import Intermittent
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES

STEP_S = 0.01
"""Step of the arm's time grid [s]."""
FIRST_COMMAND_S = 1.0
"""Time at rest before the first command of an arm at work [s]."""
MEMORY_S = 6.0
"""Length of past reference that lag and play depend on [s]; longer than any movement."""
SLICE_S, PACED_SLICE_S = 0.1, 0.05
"""Length of a slice, as fast as possible and by a clock; an order may wait this long [s]."""
UNMOVED_RAD = 1e-9
"""Largest difference of targets that count as equal [rad]."""
OPERATOR = 1
"""Number of the operator's random stream, apart from the arm's own."""


@dataclass(frozen=True)
class Emulation:
    """Settings of an emulated arm.

    Attributes:
        robot: The robot.
        imperfections: Its deviations from the twin.
        schedule: Faults with their start and end.
        seed: Seed of all random draws.
        modes: Fault modes with their distributions, by id.
        start: First targets of the motors [rad]; empty: zero.
    """

    robot: Robot
    imperfections: Imperfections
    schedule: tuple[ScheduledFault, ...] = ()
    seed: int = 0
    modes: Mapping[str, FaultMode] = field(default_factory=lambda: MODES)
    start: tuple[float, ...] = ()


@dataclass(frozen=True)
class Shifts:
    """Working hours of an arm.

    Attributes:
        movements: Random movements of a shift.
        break_s: Time from the last of them to the next shift [s]; 0: it works without a break.
        duration_s: Time after which the arm ends [s].
    """

    movements: int = 12
    break_s: float = 30.0
    duration_s: float = math.inf


class EmulatedArm(PacedSource):
    """Emulated arm; the same seed gives the same arm and the same work, whatever fails.

    Time passes in slices when the arm is polled. Disturbances are drawn per slice, so they differ
    by a clock and as fast as possible. An arm that works without a break needs no slices: they last
    from one of its commands to the next.

    Args:
        emulation: Its settings.
        pace: Clock of its time; None: as fast as possible.
        shifts: Its working hours. In the breaks it is free for the orders of others, which the
            operator does not notice. None: it moves by the orders of others alone, without end.

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(
        self, emulation: Emulation, pace: Pace | None = None, shifts: Shifts | None = None
    ) -> None:
        pace = pace or Pace(AS_FAST_AS_POSSIBLE)
        super().__init__(f"emulated {emulation.robot.name}", self._slices(), pace)
        self._emulation, self._shifts = emulation, shifts
        self._rng, self._rng_of_faults = np.random.default_rng(emulation.seed).spawn(2)
        self._rng_of_operator = np.random.default_rng([emulation.seed, OPERATOR])
        imperfections = vary(emulation.imperfections, self._rng)
        if imperfections.readings is not None:
            readings = replace(imperfections.readings, drawn_out=False)
            imperfections = replace(imperfections, readings=readings)
        self._imperfections = imperfections
        self._twin = DigitalTwin(emulation.robot)
        self._self = self._upcoming = self._draw()
        self._magnitude: dict[ScheduledFault, float] = {}
        self._episodes: dict[ScheduledFault, EndlessEpisodes] = {}
        self._index, self._next_reading = 0, 0.0
        motors = len(emulation.robot.motors)
        self._commanded = np.zeros(motors) + np.asarray(emulation.start or 0.0)
        self._goal = self._ordered = self._commanded
        self._told = (self._commanded + self._self.bias + self._self.scatter[0])[None]
        self._ramp = Ramp(0.0, self._told[-1], self._told[-1], np.zeros(motors))
        self._waiting: list[tuple[Order, float | None]] = []
        self._silent = (np.inf, np.inf)
        self._slice_s = SLICE_S if pace.speed == AS_FAST_AS_POSSIBLE else PACED_SLICE_S
        if shifts is not None and shifts.break_s == 0.0:
            self._slice_s = 0.5 * MEMORY_S
        self._made = 0
        self._work_s = math.inf if shifts is None else FIRST_COMMAND_S
        engine = PhysicsEngine(emulation.robot)
        self._arm = LiveArms(engine, self._told, STEP_S, np.atleast_1d(self._self.payload))

    @property
    def standing(self) -> FloatArray:
        """Last target of the motors, (motor,) [rad]."""
        return self._ordered

    @property
    def angle(self) -> FloatArray:
        """True angles of the motors, (motor,) [rad]; for judging results only."""
        return self._arm.angle[0]

    def send(self, order: Order) -> None:
        """Take an order; it begins with the next slice, or when the bus answers again."""
        self._take(order, None)

    def _take(self, order: Order, sent_s: float | None) -> None:
        self._waiting.append((order, sent_s))
        self._ordered = order.target

    @property
    def _now(self) -> float:
        return self._index * STEP_S

    def _slices(self) -> Iterator[Event | Wait]:
        """Yield the events of slices, each of which passes when it is due."""
        end_s = math.inf if self._shifts is None else self._shifts.duration_s
        while self._index < end_s / STEP_S - 1e-6:
            yield Wait(self._now)
            if self._now > self._work_s - 0.5 * STEP_S:
                self._work()
            yield from self._pass(end_s)

    def _work(self) -> None:
        """Order the next random movement of a shift."""
        robot, schedule = self._emulation.robot, self._imperfections.schedule
        movements = RandomMovements(count=1)
        drawn = movements.draw(robot, schedule, self._rng_of_operator, self._ordered)
        self._work_s = math.inf  # until the movement has begun
        self._take(Order(drawn.target[0, 0], drawn.ramp_duration[0, 0]), self._now)

    def _pass(self, end_s: float) -> list[Event]:
        """Let one slice of time pass, and return its events."""
        now, events = self._now, list[Event]()
        if self._waiting and not self._silent[0] <= now < self._silent[1]:
            events.append(self._begin(*self._waiting.pop(0)))
        last = min(now + self._slice_s, self._work_s, end_s)
        if self._waiting and now < self._silent[1]:
            last = min(last, self._silent[1])
        steps = max(1, round((last - now) / STEP_S))
        time = as_floats(np.arange(self._index, self._index + steps + 1) * STEP_S)
        drawn = self._draw()
        faults = self._injection(now - MEMORY_S, float(time[-1]))
        return [*events, *self._read(self._follow(time, faults), time, drawn)]

    def _begin(self, order: Order, sent_s: float | None) -> CommandSent:
        """Begin an order, with its disturbances and faults; return it as it was sent.

        `sent_s` is when the operator sent it [s]; None: it is another's, which is sent now.
        """
        now, drawn, self._upcoming = self._now, self._upcoming, self._draw()
        movement = Movements(
            self._commanded[None],
            order.target[None, None],
            order.duration[None, None],
            np.array([[now]]),
        )
        faults = self._injection(now, now + 1.0)
        faulty, lost = faults.on_movements(movement, drawn.lost[None, 1:])
        here = self._ramp.at(now)
        aim = faulty.target[0, 0] + self._self.bias + drawn.scatter[2]
        stays = lost[0, 0] | (np.abs(order.target - self._commanded) < UNMOVED_RAD)
        duration = faulty.ramp_duration[0, 0] * (1.0 - self._self.shortening)
        self._ramp = Ramp(now + float(self._self.delay), here, np.where(stays, here, aim), duration)
        self._commanded = np.where(lost[0, 0], self._commanded, order.target)
        self._goal = np.where(lost[0, 0], self._goal, order.target)
        late, period = float(self._upcoming.late[1]), self._imperfections.schedule.period_s
        if late > 0.0:
            begin = now + float(drawn.gap_start[1])
            self._silent = begin, max(begin, now + 0.5 * sum(period)) + late
        if sent_s is None:
            return CommandSent(now, order.target, order.duration)
        self._plan_work(now)
        return CommandSent(sent_s, order.target, order.duration)

    def _plan_work(self, now: float) -> None:
        """Plan the movement after one of a shift that begins now [s]."""
        assert self._shifts is not None
        period = self._rng_of_operator.uniform(*self._imperfections.schedule.period_s)
        self._work_s, self._made = now + float(period), self._made + 1
        if self._made % self._shifts.movements == 0:
            self._work_s += self._shifts.break_s

    def _read(
        self, position: FloatArray, time: FloatArray, drawn: Disturbances
    ) -> Iterator[Reading]:
        """Yield the readings of a slice, by the true angles (time, motor) [rad]."""
        local, zero = time - time[0], np.zeros((1, 1))
        chance = stack([self._with_readings(drawn, time)])
        chance = replace(chance, stalled=np.array([False]), late=zero, gap_start=zero)
        readings = self._imperfections.readings
        measured, angle = sense(self._twin, readings, position[None], local, zero, chance)
        seen = np.isfinite(angle[0]).any(axis=1) & (local > 0.0)
        seen &= ~((time >= self._silent[0]) & (time < self._silent[1]))
        for k in np.flatnonzero(seen):
            yield Reading(float(time[k]), measured[0, k], angle[0, k], self._goal)

    def _draw(self) -> Disturbances:
        """Draw the disturbances of two movements. The second is used: the first is never late."""
        timing = self._imperfections.timing
        longest = FIRST_COMMAND_S + self._imperfections.schedule.period_s[1] + timing.late_s[1]
        return draw_disturbances(self._imperfections, self._emulation.robot, 2, longest, self._rng)

    def _with_readings(self, chance: Disturbances, time: FloatArray) -> Disturbances:
        """Return the disturbances with the readings of a slice, evenly spaced across slices."""
        readings = self._imperfections.readings
        if readings is None:
            return chance
        length = float(time[-1] - time[0])
        first = self._next_reading - float(time[0])
        count = max(0, int(np.ceil((length - first) * readings.rate_hz - 1e-9)))
        self._next_reading += count / readings.rate_hz
        at = np.clip(first + chance.reading_time[:count], STEP_S, length)
        return replace(
            chance,
            reading_time=at,
            glitch=chance.glitch[:count],
            noise=chance.noise[:count],
            flicker=chance.flicker[:count],
        )

    def _injection(self, begin_s: float, end_s: float) -> Injection:
        """Return the faults that act between two times [s]."""
        robot, values = self._emulation.robot, []
        for scheduled in self._emulation.schedule:
            if scheduled.overlaps(begin_s, end_s):
                values.append(self._fault_value(scheduled, begin_s, end_s))
        return Injection([values], robot.motor_names, self._emulation.modes)

    def _fault_value(self, scheduled: ScheduledFault, begin_s: float, end_s: float) -> FaultValue:
        fault = scheduled.fault
        mode = self._emulation.modes[fault.mode]
        if isinstance(mode, Intermittent):
            return self._coming_and_going(scheduled, mode, begin_s, end_s)
        drawn = mode.draw(fault.motor, 1, end_s, self._rng_of_faults)
        magnitude = self._magnitude.setdefault(scheduled, drawn.magnitude)
        return replace(drawn, magnitude=magnitude, course=scheduled.course)

    def _coming_and_going(
        self, scheduled: ScheduledFault, mode: Intermittent, begin_s: float, end_s: float
    ) -> FaultValue:
        """Return an intermittent fault with its episodes between two times [s] up to its repair."""
        if scheduled not in self._episodes:
            rng = self._rng_of_faults.spawn(1)[0]
            share = float(rng.uniform(*mode.magnitude))
            self._episodes[scheduled] = EndlessEpisodes(
                scheduled.start_s, share, mode.episode_s, rng
            )
        endless, repaired = self._episodes[scheduled], scheduled.end_s
        episodes = endless.within(begin_s, min(end_s, repaired))
        episodes = tuple((start, min(end, repaired)) for start, end in episodes)
        course = Course(INTERMITTENT, scheduled.start_s, episodes=episodes)
        return FaultValue(scheduled.fault, endless.share, course)

    def _follow(self, time: FloatArray, faults: Injection) -> FloatArray:
        """Follow the present ramp and return the angles on its grid, (time, motor) [rad].

        Args:
            time: Grid, (time,) [s].
            faults: The faults that act.
        """
        self._index += len(time) - 1
        told = np.concatenate([self._told, self._ramp.at(time[1:])])
        self._told = told[-round(MEMORY_S / STEP_S) :]
        grid = time[-1] - np.arange(len(self._told))[::-1] * STEP_S
        lag = np.asarray(self._self.lag)[None]
        followed = faults.on_reference(lagged(self._told[None], grid, lag), as_floats(grid))
        held, weakness = faults.held(time), faults.weakness(time)
        before = self._arm.angle
        angles = self._arm.follow(
            followed[:, -(len(time) - 1) :],
            None if held is None else held[:, :-1],
            None if weakness is None else weakness[:, 1:],
        )
        return np.concatenate([before, angles[0]])


class EmulatedFleet:
    """Emulated arms that work at random, each with its own clock and seed.

    Args:
        arms: Name and settings of each arm.
        begin: Time of the robots' clocks at the start [s].
        seconds: How long they work [s].
    """

    def __init__(
        self, arms: Sequence[tuple[str, Emulation]], begin: float, seconds: float = math.inf
    ) -> None:
        shifts = Shifts(break_s=0.0, duration_s=seconds)
        self._arms = [(name, EmulatedArm(emulation, shifts=shifts)) for name, emulation in arms]
        self._next: list[Event | None] = [None] * len(arms)
        self._begin, self._now = begin, 0.0

    @property
    def names(self) -> list[str]:
        """Names of the arms."""
        return [name for name, _ in self._arms]

    def second(self) -> list[tuple[str, list[Event]]] | None:
        """Return the events of the next second of each arm; None: all have ended."""
        self._now += 1.0
        found = [(name, self._until_now(k)) for k, (name, _) in enumerate(self._arms)]
        ended = all(arm.ended for _, arm in self._arms)
        return None if ended and not any(events for _, events in found) else found

    def _until_now(self, number: int) -> list[Event]:
        arm, events = self._arms[number][1], list[Event]()
        while True:
            event = self._next[number] or arm.poll(0.0)
            self._next[number] = event
            if event is None or event.time > self._now:
                return events
            self._next[number] = None
            events.append(replace(event, time=event.time + self._begin))
