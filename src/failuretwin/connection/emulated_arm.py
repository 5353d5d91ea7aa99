"""Emulated arm: the physics engine's arm with random movements and scheduled faults, without end.

A leg is the time from one command to the next. The disturbances of the next leg are drawn before
the readings of this one are made, because a stalled bus loses readings before it delays a command.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import takewhile

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.connection.links.replay import Pace, PacedSource
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.disturbances import (
    Disturbances,
    actual_movements,
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
"""Time at rest before the first command [s]."""
MEMORY_S = 6.0
"""Length of past reference that lag and play depend on [s]; longer than any movement."""


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
class _Leg:
    """One movement and the time until the next.

    Attributes:
        time: Grid from the present to the next command, (time,) [s].
        movement: The movement as commanded, as one run with one movement.
        chance: Disturbances of this run.
        late: Delay of its start [s].
        faults: The faults that act, or acted within `MEMORY_S`.
    """

    time: FloatArray
    movement: Movements
    chance: Disturbances
    late: float
    faults: Injection


class EmulatedArm:
    """Arm that moves at random without end; the same seed gives the same life, whatever fails.

    Args:
        emulation: Its settings.

    Raises:
        InputError: If mujoco is missing.
    """

    def __init__(self, emulation: Emulation) -> None:
        self._emulation = emulation
        self._rng, self._rng_of_faults = np.random.default_rng(emulation.seed).spawn(2)
        imperfections = vary(emulation.imperfections, self._rng)
        if imperfections.readings is not None:
            readings = replace(imperfections.readings, drawn_out=False)
            imperfections = replace(imperfections, readings=readings)
        self._imperfections = imperfections
        self._twin = DigitalTwin(emulation.robot)
        self._self = self._upcoming = self._draw()
        self._magnitude: dict[ScheduledFault, float] = {}
        self._episodes: dict[ScheduledFault, EndlessEpisodes] = {}
        self._index = 0
        self._start = FIRST_COMMAND_S
        self._next_reading = 0.0
        motors = len(emulation.robot.motors)
        self._commanded = np.zeros(motors) + np.asarray(emulation.start or 0.0)
        self._goal = self._commanded
        self._told = (self._commanded + self._self.bias + self._self.scatter[0])[None]
        engine = PhysicsEngine(emulation.robot)
        self._arm = LiveArms(engine, self._told, STEP_S, np.atleast_1d(self._self.payload))

    def events(self) -> Iterator[Event]:
        """Yield readings and commands in the order of their times, without end."""
        while True:
            leg = self._next_leg()
            yield from sorted(self._live_through(leg), key=lambda event: event.time)

    def _draw(self) -> Disturbances:
        """Draw the disturbances of two movements. The second is used: the first is never late."""
        timing = self._imperfections.timing
        longest = FIRST_COMMAND_S + self._imperfections.schedule.period_s[1] + timing.late_s[1]
        return draw_disturbances(self._imperfections, self._emulation.robot, 2, longest, self._rng)

    def _next_leg(self) -> _Leg:
        drawn, self._upcoming = self._upcoming, self._draw()
        schedule = self._imperfections.schedule
        late = float(drawn.late[1])
        following = self._start + late + float(self._rng.uniform(*schedule.period_s))
        time = np.arange(self._index, round(following / STEP_S) + 1) * STEP_S
        movement = RandomMovements(count=1).draw(
            self._emulation.robot, schedule, self._rng, self._commanded
        )
        movement = replace(movement, start=np.array([[self._start]]))
        self._start = following
        chance = self._chance_of(drawn, as_floats(time))
        return _Leg(
            as_floats(time),
            movement,
            chance,
            late,
            self._injection(float(time[0]) - MEMORY_S, float(time[-1])),
        )

    def _chance_of(self, drawn: Disturbances, time: FloatArray) -> Disturbances:
        """Return the disturbances of one run with one movement, by the leg's own time."""
        here = self._told[-1] - self._commanded - self._self.bias
        chance = replace(
            drawn,
            bias=self._self.bias,
            compliance=self._self.compliance,
            friction=np.zeros_like(self._self.friction),  # the gears have their own
            delay=self._self.delay,
            lag=self._self.lag,
            shortening=self._self.shortening,
            lost=drawn.lost[1:],
            scatter=np.stack([here, drawn.scatter[2]]),
            late=drawn.late[1:],
            stalled=np.asarray(self._upcoming.late[1] > 0.0),
            gap_start=drawn.gap_start[1:],
        )
        return stack([self._with_readings(chance, time)])

    def _with_readings(self, chance: Disturbances, time: FloatArray) -> Disturbances:
        """Return the disturbances with the readings of this leg, evenly spaced across legs."""
        readings = self._imperfections.readings
        if readings is None:
            return chance
        length = float(time[-1] - time[0])
        first = self._next_reading - float(time[0])
        count = max(0, int(np.ceil((length - first) * readings.rate_hz - 1e-9)))
        self._next_reading += count / readings.rate_hz
        at = np.clip(first + chance.reading_time[:count], STEP_S, length)
        return replace(
            chance, reading_time=at, glitch=chance.glitch[:count], noise=chance.noise[:count]
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

    def _live_through(self, leg: _Leg) -> list[Event]:
        before = self._goal
        position = self._move(leg)
        local = leg.time - leg.time[0]
        # The bus answers between two stalls in a row; otherwise it would be silent for minutes.
        start = leg.movement.start - leg.time[0] + leg.late
        readings = self._imperfections.readings
        measured, angle = sense(self._twin, readings, position[None], local, start, leg.chance)
        stalled = float(start[0, 0]) if leg.late > 0.0 else 0.0
        seen = np.isfinite(angle[0]).any(axis=1) & (local > 0.0) & (local >= stalled)
        movement = leg.movement
        came = leg.time >= movement.start[0, 0] + leg.late
        goal = np.where(came[:, None], self._goal, before)
        events: list[Event] = [
            Reading(float(leg.time[k]), measured[0, k], angle[0, k], goal[k])
            for k in np.flatnonzero(seen)
        ]
        command = CommandSent(
            float(movement.start[0, 0]), movement.target[0, 0], movement.ramp_duration[0, 0]
        )
        return [*events, command]

    def _move(self, leg: _Leg) -> FloatArray:
        """Move through a leg and return the angles on its grid, (time, motor) [rad]."""
        faulty, lost = leg.faults.on_movements(leg.movement, leg.chance.lost)
        told = actual_movements(faulty, replace(leg.chance, lost=lost)).reference(leg.time)[0]
        self._commanded = np.where(lost[0, 0], self._commanded, faulty.target[0, 0])
        self._goal = np.where(lost[0, 0], self._goal, leg.movement.target[0, 0])
        return self._follow(told, leg.time, leg.chance.lag, leg.faults)

    def _follow(
        self, told: FloatArray, time: FloatArray, lag: FloatArray, faults: Injection
    ) -> FloatArray:
        """Follow a reference and return the angles on its grid, (time, motor) [rad].

        Args:
            told: The reference from the present on, (time, motor) [rad].
            time: Grid, (time,) [s].
            lag: First-order lag, (1,) [s].
            faults: The faults that act.
        """
        self._index += len(time) - 1
        self._told = np.concatenate([self._told, told[1:]])[-round(MEMORY_S / STEP_S) :]
        grid = time[-1] - np.arange(len(self._told))[::-1] * STEP_S
        followed = faults.on_reference(lagged(self._told[None], grid, lag), as_floats(grid))
        held, weakness = faults.held(time), faults.weakness(time)
        before = self._arm.angle
        angles = self._arm.follow(
            followed[:, -(len(time) - 1) :],
            None if held is None else held[:, :-1],
            None if weakness is None else weakness[:, 1:],
        )
        return np.concatenate([before, angles[0]])


def emulated(
    emulation: Emulation, pace: Pace, duration_s: float = math.inf, zero_s: float = 0.0
) -> PacedSource:
    """Return an emulated robot as a source.

    Args:
        emulation: Settings of the arm.
        pace: Clock of the events.
        duration_s: Time after which it ends [s].
        zero_s: Its clock at the start [s].

    Raises:
        InputError: If mujoco is missing.
    """
    events = takewhile(lambda event: event.time <= duration_s, EmulatedArm(emulation).events())
    stamped = (replace(event, time=event.time + zero_s) for event in events)
    return PacedSource(f"emulated {emulation.robot.name}", stamped, pace)
